"""What the policy and the critic see: the kinds of observation by name, and which one is drawn.

Each kind is a file of its own; this one only chooses.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from carljax.sim import (
    observation_carla,
    observation_nuplan,
    observation_roach,
    raster_canvas,
    raster_nuplan,
    raster_roach,
)
from carljax.sim.observation_carla import (
    NUM_SCALARS,
    NUM_VALUE_SCALARS,
    scalars,
    value_scalars,
)
from carljax.sim.raster_canvas import RasterConfig
from carljax.sim.types import Observation, PastMotion, SimState, Trail

if TYPE_CHECKING:
    from carljax.sim.env import DrivingEnv

__all__ = [
    "KINDS",
    "NUM_SCALARS",
    "NUM_VALUE_SCALARS",
    "begin",
    "observe",
    "remember",
    "scalars",
    "value_scalars",
]


class Kind(NamedTuple):
    """One kind of observation.

    Attributes:
      channels: names of the image's channels.
      levels: {channel: the values other than 0 that it takes}, for those that take few.
      raster: the size that its authors gave the image.
      observe: (env, sim) to the observation.
      begin: (env, sim) to what the first state of an episode leaves to remember.
      remember: (env, before, after) to the same after a step.
    """

    channels: tuple[str, ...]
    levels: dict[str, tuple[int, ...]]
    raster: RasterConfig
    observe: Callable[[Any, SimState], Observation]
    begin: Callable[[Any, SimState], Trail | PastMotion | None]
    remember: Callable[[Any, SimState, SimState], Trail | PastMotion | None]


KINDS = {
    "carla": Kind(
        raster_canvas.CHANNELS,
        raster_canvas.LEVELS,
        RasterConfig(),
        observation_carla.observe,
        lambda env, sim: None,
        lambda env, before, after: None,
    ),
    "roach": Kind(
        raster_roach.CHANNELS,
        raster_roach.LEVELS,
        raster_roach.RASTER,
        observation_roach.observe,
        observation_roach.begin,
        observation_roach.remember,
    ),
    "nuplan": Kind(
        raster_nuplan.CHANNELS,
        raster_nuplan.LEVELS,
        raster_nuplan.RASTER,
        observation_nuplan.observe,
        observation_nuplan.begin,
        observation_nuplan.remember,
    ),
}


def observe(env: DrivingEnv, sim: SimState) -> Observation:
    """Draws the image and collects the numbers of one state.

    Args:
      env: gives towns, routes, the kind of observation and the image's size.
      sim: the state.

    Returns:
      The observation.
    """
    return KINDS[env.config.observation].observe(env, sim)


def begin(env: DrivingEnv, sim: SimState) -> SimState:
    """The first state of an episode with what its observation remembers."""
    return sim.replace(past=KINDS[env.config.observation].begin(env, sim))


def remember(env: DrivingEnv, before: SimState, after: SimState) -> SimState:
    """The state after a step with what its observation remembers of this one and earlier ones."""
    return after.replace(past=KINDS[env.config.observation].remember(env, before, after))
