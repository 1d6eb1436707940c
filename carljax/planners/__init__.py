"""Rule-based drivers, to calibrate the world by: is it fair to a careful driver?"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from carljax.planners import idm, pdm_lite
from carljax.sim.env import DrivingEnv
from carljax.sim.types import SimState


class Planner(NamedTuple):
    """A driver that sees the whole state; pure functions, unbatched.

    Attributes:
      init: its memory at the start of a route.
      act: (env, state, memory) to the action (2,) float32 in [-1, 1] and the next memory.
    """

    init: Callable[[DrivingEnv], Any]
    act: Callable[[DrivingEnv, SimState, Any], tuple[jax.Array, Any]]


PLANNERS: dict[str, Planner] = {
    "idm": Planner(idm.init, idm.act),
    "pdm-lite": Planner(pdm_lite.init, pdm_lite.act),
}
