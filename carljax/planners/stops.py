"""Where to halt by the rules: lights that are not green and stop signs not yet honoured."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.planners.way import Stretch, Way
from carljax.sim import situation
from carljax.sim.bicycle import VehicleParams
from carljax.sim.road_map import RoadMap
from carljax.sim.types import (
    LIGHT_RED,
    LIGHT_YELLOW,
    STOP_LIGHT,
    STOP_SIGN,
    SimState,
)

FIRM_BRAKING = 3.72  # m/s^2 with which yellow is still stopped for. source: PDM-Lite, its IDM
SIGN_REACH = 1.0  # m past a line up to which the ego still minds its sign. source: ours


def lights(
    sim: SimState, found: Stretch, way: Way, road_map: RoadMap, car: VehicleParams
) -> jax.Array:
    """() m from the front bumper to the first line that must not be crossed now; else infinity.

    A red light is crossed with the tail: as long as the car can halt before that it does.
    """
    gap = way.stop_distance - 0.5 * car.length
    shown = situation.stop_lights(road_map, found.route, sim.lights)
    braking_distance = sim.ego.speed**2 / 2.0
    red = (shown == LIGHT_RED) & (gap + 0.8 * car.length > braking_distance / car.brake_max)
    yellow = (shown == LIGHT_YELLOW) & (gap > braking_distance / FIRM_BRAKING)
    closed = (found.route.stop_kind == STOP_LIGHT) & (red | yellow)
    return jnp.where(closed & (gap > -0.8 * car.length), gap, jnp.inf).min()


def signs(sim: SimState, found: Stretch, way: Way, car: VehicleParams) -> jax.Array:
    """() m from the front bumper to the first stop sign's line not yet honoured; else infinity."""
    gap = way.stop_distance - 0.5 * car.length
    unmet = (found.route.stop_kind == STOP_SIGN) & ~sim.reward_state.stop_satisfied
    return jnp.where(unmet & (gap > -SIGN_REACH), gap, jnp.inf).min()
