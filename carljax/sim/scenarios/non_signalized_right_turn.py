"""NonSignalizedJunctionRightTurn: the ego turns right, without lights, into cars from the left."""

from __future__ import annotations

import numpy as np

from carljax.sim.scenarios import junction_flow
from carljax.sim.scenarios.script import Scenario
from carljax.sim.scenarios.site import Site


def place(site: Site, rng: np.random.Generator) -> Scenario | None:
    """See `junction_flow.place`."""
    return junction_flow.place(site, rng, junction_flow.FROM_LEFT, is_signalized=False)
