"""Where everybody will be: the ego along its way, cars along their lanes, all others straight on.

Others keep their acceleration. A car goes the way it indicates and halts at a red light or a sign
where it still can, so what it does next is known as to an attentive driver.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from carljax.planners import pace
from carljax.planners import way as way_module
from carljax.planners.way import Way
from carljax.reward import collision
from carljax.sim import geometry, right_of_way
from carljax.sim.bicycle import VehicleParams
from carljax.sim.population import Population, rows
from carljax.sim.road_map import RoadMap, pose_at
from carljax.sim.types import (
    LIGHT_GREEN,
    STOP_LIGHT,
    STOP_SIGN,
    STOP_YIELD,
    Agents,
    EgoState,
    LightClock,
)

STEP = 0.2  # s. source: ours; a car at 80 km/h moves by less than its length
# Accelerations that last, m/s^2. source: PDM-Lite forecasts a braking car with -4.95
ACCEL_MIN, ACCEL_MAX = -4.95, 1.5
# m/s^2 that a halt at a line may still take of whoever does not brake yet, to be trusted to halt;
# and of whoever brakes, with this fraction of what it takes. source: ours; a car at 50 km/h brakes
# from 40 m on, and one at 10 m/s that has not begun 20 m before the line does not mean to
TRUSTED_BRAKING, FIRM_BRAKING = 2.5, 5.0
BRAKES_FRAC = 0.6
Z_GAP = 3.0  # m in height that keep two apart. source: as for collisions


class Forecast(struct.PyTreeNode):
    """Poses of the others at T moments: xy (T, N, 2) m, yaw (T, N) rad."""

    xy: jax.Array
    yaw: jax.Array


class Hits(struct.PyTreeNode):
    """Whom the ego would meet.

    Attributes:
      gap: (N,) m that it may move along its way before; infinity where it would not.
      time: (N,) s until then; infinity likewise.
      speed: (N,) m/s of the other along the ego's way, not negative.
    """

    gap: jax.Array
    time: jax.Array
    speed: jax.Array


def moments(num: int) -> jax.Array:
    """(T,) s, the moments looked at; none is now."""
    return STEP * jnp.arange(1, num + 1, dtype=jnp.float32)


def others(
    agents: Agents, population: Population, road_map: RoadMap, clock: LightClock, num: int
) -> Forecast:
    """Forecasts all others.

    Args:
      agents: (N,) now.
      population: which rows drive on lanes.
      road_map: the map.
      clock: of the lights.
      num: T.

    Returns:
      Their poses at `moments(num)`.
    """
    time = moments(num)[:, None]
    cars = rows(agents, population.vehicles)
    rest = rows(agents, slice(population.num_vehicles, None))
    way = jnp.minimum(_travelled(cars, time), _room(cars, road_map, clock))
    on_lanes = _along_lanes(cars, way, road_map)
    heading = jnp.stack([jnp.cos(rest.yaw), jnp.sin(rest.yaw)], axis=-1)
    straight = Forecast(
        xy=rest.xy + (rest.speed * time)[..., None] * heading,
        yaw=jnp.broadcast_to(rest.yaw, (num, *rest.yaw.shape)),
    )
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b], axis=1), on_lanes, straight)


def _travelled(agents: Agents, time: jax.Array) -> jax.Array:
    """(T, N) m after (T, 1) s: whoever brakes stands still in the end."""
    accel = jnp.clip(agents.accel, ACCEL_MIN, ACCEL_MAX)
    halt = jnp.where(accel < -0.1, agents.speed / jnp.maximum(-accel, 0.1), jnp.inf)
    moving = jnp.minimum(time, halt)
    return agents.speed * moving + 0.5 * accel * moving**2


def _room(agents: Agents, road_map: RoadMap, clock: LightClock) -> jax.Array:
    """(N,) m to the line at which a car will halt, infinity where there is none."""
    stop = right_of_way.stop_ahead(agents, road_map, clock)
    needed = agents.speed**2 / (2.0 * jnp.maximum(stop.distance, 0.1))
    brakes = (needed < FIRM_BRAKING) & (-agents.accel > BRAKES_FRAC * needed)
    can_halt = (needed < TRUSTED_BRAKING) | brakes
    closed = (stop.kind == STOP_LIGHT) & (stop.light != LIGHT_GREEN)
    closed |= (stop.kind == STOP_SIGN) & ~agents.has_stopped
    closed |= (stop.kind == STOP_YIELD) & (agents.speed > 0.5)
    halts = closed & can_halt & (stop.distance > 0.0)
    return jnp.where(halts, stop.distance, jnp.inf)


def _along_lanes(agents: Agents, travelled: jax.Array, road_map: RoadMap) -> Forecast:
    """Poses of cars (T, N) m further along the lanes that they mean to take."""
    lanes = [right_of_way.planned_lane(agents, number) for number in range(3)]
    length = [road_map.lane_length[lane] for lane in lanes]
    s = agents.lane_s + travelled
    is_second = (s > length[0]) & (agents.lanes[:, 1] >= 0)
    s_second = s - length[0]
    is_third = is_second & (s_second > length[1]) & (agents.lanes[:, 2] >= 0)
    lane = jnp.where(is_third, lanes[2], jnp.where(is_second, lanes[1], lanes[0]))
    s = jnp.where(is_third, s_second - length[1], jnp.where(is_second, s_second, s))
    pose = pose_at(road_map, lane, s)
    left = jnp.stack([-jnp.sin(pose.yaw), jnp.cos(pose.yaw)], axis=-1)
    return Forecast(xy=pose.xy + agents.lateral[:, None] * left, yaw=pose.yaw)


def ego_distances(speed: jax.Array, desired: jax.Array, accel: float, num: int) -> jax.Array:
    """(T,) m along its way, if the ego goes on as fast as it wants to.

    Args:
      speed: () m/s, now.
      desired: (K,) m/s along the way.
      accel: m/s^2 it gains and, at most, loses speed with.
      num: T.
    """

    def step(carry: tuple[jax.Array, jax.Array], _: None) -> tuple[Any, jax.Array]:
        speed, distance = carry
        new = jnp.clip(pace.at(desired, distance), speed - accel * STEP, speed + accel * STEP)
        distance = distance + 0.5 * (speed + new) * STEP
        return (new, distance), distance

    start = (speed, jnp.zeros_like(speed))
    distances: jax.Array = jax.lax.scan(step, start, None, length=num)[1]
    return distances


def hits(
    ego: EgoState,
    agents: Agents,
    cast: Forecast,
    way: Way,
    distances: jax.Array,
    car: VehicleParams,
    margin: tuple[jax.Array, jax.Array],
) -> Hits:
    """Finds whom the ego would meet on its way.

    Args:
      ego: the ego.
      agents: (N,) the others now.
      cast: where they will be at T moments.
      way: the ego's way.
      distances: (T,) m, how far on it the ego will be.
      car: the ego's box.
      margin: m added to the others' length and width, each () or (N,).

    Returns:
      (N,) hits.
    """
    xy, yaw = way_module.pose(way, distances)
    overlap = geometry.boxes_overlap(
        xy[:, None],
        yaw[:, None],
        car.length,
        car.width,
        cast.xy,
        cast.yaw,
        agents.length + margin[0],
        agents.width + margin[1],
    )
    overlap &= collision.is_near_in_height(ego, agents, Z_GAP) & ~_follows(ego, agents, way, car)
    first = jnp.argmax(overlap, axis=0)
    meets = overlap.any(axis=0)
    before = jnp.where(first > 0, distances[jnp.maximum(first - 1, 0)], 0.0)
    turned = jnp.take_along_axis(cast.yaw, first[None], axis=0)[0] - yaw[first]
    return Hits(
        gap=jnp.where(meets, before, jnp.inf),
        time=jnp.where(meets, STEP * (first + 1), jnp.inf),
        speed=jnp.maximum(agents.speed * jnp.cos(turned), 0.0),
    )


def _follows(ego: EgoState, agents: Agents, way: Way, car: VehicleParams) -> jax.Array:
    """(N,) bool, it is behind the ego in its lane: to brake for it would not help."""
    at = geometry.to_frame(agents.xy, ego.xy, ego.yaw)
    is_behind = (at[:, 0] < -0.5 * car.length) & (jnp.cos(agents.yaw - ego.yaw) > 0.5)
    return is_behind & (agents.lanes == way.lane[0]).any(axis=1)
