"""The kinds of scenarios by the names that CARLA's leaderboard gives them.

`Scenario.kind` is a place in `KINDS`. A kind is a module with a function `place(site, rng)` that
returns a `Scenario` of NumPy arrays, its trigger at the site, or None where the site does not suit
it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from carljax.sim.scenarios.script import Scenario
from carljax.sim.scenarios.site import Site

Place = Callable[[Site, np.random.Generator], Scenario | None]

PLACE: dict[str, Place] = {}
KINDS = tuple(PLACE)
