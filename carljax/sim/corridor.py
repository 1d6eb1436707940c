"""Who is in a vehicle's way off the lanes: pedestrians, obstacles, bicycles that cross, the ego.

The way is a band along the plan, through bends too, as far as the vehicle needs to stop. Whoever is
in it, or will have stepped into it in a moment, is kept a distance to.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from carljax.sim.once import once
from carljax.sim.right_of_way import BRAKING, FAR, ahead_of
from carljax.sim.road_map import RoadMap, row_at
from carljax.sim.types import Agents, EgoState

PIECES = 4  # straight pieces that stand for the way
REACH, REACH_TIME = 6.0, 1.0  # m, and s of driving, beyond the way to stop. source: ours
FORESIGHT = 1.5  # s in which somebody may step into the way. source: ours, a driver's look ahead
EGO_WIDTH = 1.836  # m. source: CARLA's Lincoln MKZ
SIDE = 0.5  # m kept to either side. source: ours


class Obstacles(struct.PyTreeNode):
    """What may be in the way, (F,): valid bool; x, y m; yaw rad; speed m/s; length, width m."""

    valid: jax.Array
    x: jax.Array
    y: jax.Array
    yaw: jax.Array
    speed: jax.Array
    length: jax.Array
    width: jax.Array


def obstacles(others: Agents, ego: EgoState, ego_length: jax.Array) -> Obstacles:
    """The ego, others where they are, and others where they will be in `FORESIGHT`."""
    ahead = jnp.stack([jnp.cos(others.yaw), jnp.sin(others.yaw)], axis=-1)
    then = others.xy + (FORESIGHT * others.speed)[:, None] * ahead

    def rows(of_ego: jax.Array, now: jax.Array, then: jax.Array) -> jax.Array:
        return jnp.concatenate([of_ego[None], now, then])

    moves = others.valid & (others.speed > 0.0)
    return Obstacles(
        valid=rows(jnp.ones((), bool), others.valid, moves),
        x=rows(ego.xy[0], others.xy[:, 0], then[:, 0]),
        y=rows(ego.xy[1], others.xy[:, 1], then[:, 1]),
        yaw=rows(ego.yaw, others.yaw, others.yaw),
        speed=rows(ego.speed, others.speed, others.speed),
        length=rows(ego_length, others.length, others.length),
        width=rows(jnp.float32(EGO_WIDTH), others.width, others.width),
    )


def gaps(agents: Agents, seen: Obstacles, road_map: RoadMap) -> tuple[jax.Array, jax.Array]:
    """Gap to the nearest obstacle in each agent's way, and its speed along that way.

    Args:
      agents: (N,) vehicles on lanes.
      seen: (F,) obstacles.
      road_map: the map.

    Returns:
      (N,) m between bumper and obstacle, FAR where there is none; (N,) m/s.
    """
    points, along = _way(agents, road_map)  # (N, P + 1, 2), (N, P + 1)
    piece = points[:, 1:] - points[:, :-1]
    length = jnp.sqrt(jnp.maximum((piece**2).sum(axis=-1), 1e-6))
    cos, sin = piece[..., 0] / length, piece[..., 1] / length  # (N, P)
    pieces = (points[:, :-1, 0], points[:, :-1, 1], cos, sin, length, along[:, :-1])
    from_x, from_y, cos, sin, length, along = (x[..., None] for x in once(pieces))
    cos_seen, sin_seen, seen = once((jnp.cos(seen.yaw), jnp.sin(seen.yaw), seen))
    x, y = seen.x - from_x, seen.y - from_y  # (N, P, F)
    ahead, side = cos * x + sin * y, jnp.abs(cos * y - sin * x)
    cos_to = cos * cos_seen + sin * sin_seen
    sin_to = jnp.abs(sin * cos_seen - cos * sin_seen)
    half_along = 0.5 * (seen.length * jnp.abs(cos_to) + seen.width * sin_to)
    half_across = 0.5 * (seen.length * sin_to + seen.width * jnp.abs(cos_to))
    across = half_across + (0.5 * agents.width + SIDE)[:, None, None]
    distance = along + ahead
    in_way = seen.valid & (side < across) & (distance > 0.3 * agents.length[:, None, None])
    in_way &= (ahead > -0.5) & (ahead < length + 0.5)
    gap = distance - half_along - 0.5 * agents.length[:, None, None]
    gap = jnp.where(in_way, gap, FAR).reshape(agents.length.shape[0], -1)
    speed = (seen.speed * jnp.maximum(cos_to, 0.0)).reshape(gap.shape)
    nearest = gap.min(axis=1)
    return nearest, jnp.where(gap == nearest[:, None], speed, 0.0).max(axis=1)


def _way(agents: Agents, road_map: RoadMap) -> tuple[jax.Array, jax.Array]:
    """Points of each agent's way from its middle on: (N, P + 1, 2) m, and how far on (N, P + 1)."""
    plan = ahead_of(agents, road_map)
    reach = REACH + REACH_TIME * agents.speed + agents.speed**2 / (2 * BRAKING)
    reach = reach + 0.5 * agents.length
    parts = jnp.arange(1, PIECES + 1, dtype=jnp.float32) / PIECES
    along = reach[:, None] * parts
    number = (along[..., None] > plan.begin[:, None, 1:]) & plan.exists[:, None, 1:]
    number = number.sum(axis=-1)  # (N, P) which lane of the plan
    lane = jnp.take_along_axis(plan.lane, number, axis=1)
    s = along - jnp.take_along_axis(plan.begin, number, axis=1)
    row = row_at(road_map, lane, s)
    points = jnp.concatenate([agents.xy[:, None], road_map.point_xy[row]], axis=1)
    return points, jnp.pad(along, ((0, 0), (1, 0)))
