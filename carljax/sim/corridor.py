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
    """What may be in the way, (F,).

    Attributes:
      valid: bool.
      x, y: m.
      cos, sin: of the heading.
      speed: m/s.
      moves: m that it will have gone in `FORESIGHT`, 0 for the ego.
      half_length, half_width: m.
    """

    valid: jax.Array
    x: jax.Array
    y: jax.Array
    cos: jax.Array
    sin: jax.Array
    speed: jax.Array
    moves: jax.Array
    half_length: jax.Array
    half_width: jax.Array


def obstacles(others: Agents, ego: EgoState, ego_length: jax.Array) -> Obstacles:
    """The ego and others."""

    def rows(of_ego: jax.Array, of_others: jax.Array) -> jax.Array:
        return jnp.concatenate([of_ego[None], of_others])

    yaw = rows(ego.yaw, others.yaw)
    return Obstacles(
        valid=rows(jnp.ones((), bool), others.valid),
        x=rows(ego.xy[0], others.xy[:, 0]),
        y=rows(ego.xy[1], others.xy[:, 1]),
        cos=jnp.cos(yaw),
        sin=jnp.sin(yaw),
        speed=rows(ego.speed, others.speed),
        moves=rows(jnp.zeros(()), FORESIGHT * jnp.maximum(others.speed, 0.0)),
        half_length=0.5 * rows(ego_length, others.length),
        half_width=0.5 * rows(jnp.float32(EGO_WIDTH), others.width),
    )


class Piece(struct.PyTreeNode):
    """A straight piece of an agent's way, (P, N).

    Attributes:
      x, y: m, where it begins.
      cos, sin: of its heading.
      least, most: m from its beginning between which an obstacle's middle is in the way.
      half_width: m, half of the agent's width and what is kept beside it.
      gap: m from the front bumper to its beginning; negative for the first one.
    """

    x: jax.Array
    y: jax.Array
    cos: jax.Array
    sin: jax.Array
    least: jax.Array
    most: jax.Array
    half_width: jax.Array
    gap: jax.Array


def gaps(agents: Agents, seen: Obstacles, road_map: RoadMap) -> tuple[jax.Array, jax.Array]:
    """Gap to the nearest obstacle in each agent's way, and its speed along that way.

    Each is looked at twice: where it is and where it will be.

    Args:
      agents: (N,) vehicles on lanes.
      seen: (F,) obstacles.
      road_map: the map.

    Returns:
      (N,) m between bumper and obstacle, FAR where there is none; (N,) m/s.
    """
    # Numbers for one of a pair are all made before those for pairs, of which there are F P N.
    way = once(_pieces(agents, road_map))
    seen = jax.tree.map(lambda x: x[:, None, None], once(seen))
    x, y = seen.x - way.x, seen.y - way.y
    ahead, left = way.cos * x + way.sin * y, way.cos * y - way.sin * x
    cos, sin = way.cos * seen.cos + way.sin * seen.sin, way.cos * seen.sin - way.sin * seen.cos
    along = seen.half_length * jnp.abs(cos) + seen.half_width * jnp.abs(sin)
    across = seen.half_length * jnp.abs(sin) + seen.half_width * jnp.abs(cos) + way.half_width

    def near(ahead: jax.Array, left: jax.Array) -> jax.Array:
        in_way = seen.valid & (jnp.abs(left) < across) & (ahead > way.least) & (ahead < way.most)
        return jnp.where(in_way, ahead, FAR)

    now, then = near(ahead, left), near(ahead + seen.moves * cos, left + seen.moves * sin)
    gap = jnp.minimum(now, then) - along  # (F, P, N)
    gap, speed = _nearest(gap, seen.speed * jnp.maximum(cos, 0.0))
    gap, speed = _nearest(gap + way.gap, speed)
    return jnp.where(gap < 0.5 * FAR, gap, FAR), jnp.where(gap < 0.5 * FAR, speed, 0.0)


def _nearest(gap: jax.Array, speed: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the smallest gap of the first axis and its speed, the highest of equals."""
    nearest = gap.min(axis=0)
    return nearest, jnp.where(gap == nearest, speed, 0.0).max(axis=0)


def _pieces(agents: Agents, road_map: RoadMap) -> Piece:
    """The way of each agent in straight pieces."""
    points, along = _way(agents, road_map)  # (N, P + 1, 2), (N, P + 1)
    piece = points[:, 1:] - points[:, :-1]
    length = jnp.sqrt(jnp.maximum((piece**2).sum(axis=-1), 1e-6))
    along = along[:, :-1]
    size = agents.length[:, None]
    pieces = Piece(
        x=points[:, :-1, 0],
        y=points[:, :-1, 1],
        cos=piece[..., 0] / length,
        sin=piece[..., 1] / length,
        least=jnp.maximum(0.3 * size - along, -0.5),
        most=length + 0.5,
        half_width=jnp.broadcast_to(0.5 * agents.width[:, None] + SIDE, along.shape),
        gap=along - 0.5 * size,
    )
    return jax.tree.map(jnp.transpose, pieces)


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
