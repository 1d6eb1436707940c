"""Giving way: whether to enter a junction in which the ego has to mind others.

The map says from where on along each lane others have to be minded. The ego goes there only if, by
the forecast, nobody meets it while it passes; else it halts just before.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.planners import forecast
from carljax.planners.forecast import Forecast
from carljax.planners.way import SAMPLES, Way
from carljax.sim.bicycle import VehicleParams
from carljax.sim.road_map import RoadMap
from carljax.sim.types import Agents, EgoState

HORIZON = 25  # moments of forecast, 5 s: what a turn from rest takes. source: ours
# of the car's full braking, with which it halts before if it has to; with less room it goes on.
# source: ours
BRAKING_FRAC = 0.9
CLEARANCE_S = 0.8  # s between others and the ego at first. source: ours
LEAST_CLEARANCE_S = 0.3  # s, after long waiting. source: ours
PATIENCE_S = 20.0  # s of waiting after which the least clearance is enough. source: ours
SIDE_MARGIN = 0.3  # m on either side of others. source: ours
HALT_MARGIN = 0.5  # m kept to the place from which others are in the way. source: ours
# m past that place up to which it still waits there: it can't halt on the spot. source: ours
OVERSHOOT = 0.5


def next_gate(way: Way, road_map: RoadMap, car: VehicleParams) -> jax.Array:
    """() m from the front bumper to where others have to be minded next; else infinity.

    Args:
      way: the ego's way.
      road_map: the map.
      car: its box.
    """
    minds = way.in_junction & (way.lane_s >= road_map.lane_yield_s[way.lane])
    front = 0.5 * car.length
    distance = jnp.arange(SAMPLES, dtype=jnp.float32)
    begins = minds & ~jnp.roll(minds, 1) & (distance > front - OVERSHOOT) & (distance > 0.0)
    # Samples are 1 m apart: the place lies somewhat before the first one beyond it.
    beyond = jnp.clip(way.lane_s - road_map.lane_yield_s[way.lane], 0.0, 1.0)
    return jnp.where(begins, distance - beyond, jnp.inf).min() - front


def gap(
    ego: EgoState,
    agents: Agents,
    cast: Forecast,
    way: Way,
    distances: jax.Array,
    is_leader: jax.Array,
    waited_s: jax.Array,
    road_map: RoadMap,
    car: VehicleParams,
) -> jax.Array:
    """() m that the ego may move before it has to wait for others; infinity if it may go.

    Args:
      ego: the ego.
      agents: (N,) the others.
      cast: where they will be, at `HORIZON` moments.
      way: the ego's way.
      distances: (HORIZON,) m, how far on it the ego would be.
      is_leader: (N,) bool, those that it only follows.
      waited_s: () s it has stood already.
      road_map: the map.
      car: the ego's box.
    """
    at_gate = next_gate(way, road_map, car)
    room = at_gate - HALT_MARGIN
    patience = jnp.clip(waited_s / PATIENCE_S, 0.0, 1.0)
    clearance = CLEARANCE_S + patience * (LEAST_CLEARANCE_S - CLEARANCE_S)
    margin = (2.0 * clearance * agents.speed, jnp.float32(2.0 * SIDE_MARGIN))
    met = forecast.hits(ego, agents, cast, way, distances, car, margin)
    beyond = (met.gap > room - 2.0) & (met.gap < jnp.inf) & (agents.speed > 0.3) & ~is_leader
    braking = ego.speed**2 / (2.0 * BRAKING_FRAC * car.brake_max)
    can_halt = at_gate + OVERSHOOT > braking
    return jnp.where(beyond.any() & can_halt, jnp.maximum(room, 0.0), jnp.inf)
