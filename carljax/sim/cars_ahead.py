"""Whom an agent follows: the cars ahead on its plan, across the ends of lanes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from carljax.sim import order
from carljax.sim.once import once
from carljax.sim.right_of_way import FAR, Mover, ahead_of
from carljax.sim.road_map import RoadMap
from carljax.sim.types import Agents

# Cars on each lane of its plan, which an agent looks at of many. source: ours; of 256 cars in the
# training towns no decision differed
NEXT = 8


class CarsAhead(struct.PyTreeNode):
    """Others (rows) as each agent (columns) has them ahead.

    The rows are everybody, or of each column some: see `look`.

    Attributes:
      gap: (R, N) m between bumpers; FAR to all who are not ahead.
      speed: (R, 1) or (R, N) m/s.
      half_length: the same, m.
      is_queued: the same, bool, stands and doesn't set off.
    """

    gap: jax.Array
    speed: jax.Array
    half_length: jax.Array
    is_queued: jax.Array


def look(agents: Agents, movers: Mover, road_map: RoadMap) -> CarsAhead:
    """Finds the cars on the three lanes of each plan; of more than `order.MANY` the next on each.

    Args:
      agents: (N,) vehicles.
      movers: (M,) everybody, the ego last.
      road_map: the map.
    """
    if movers.lane.shape[0] > order.MANY:
        return _next(agents, movers, road_map)
    return _all(agents, movers, road_map)


def _all(agents: Agents, movers: Mover, road_map: RoadMap) -> CarsAhead:
    """Everybody, M rows."""
    lanes, begin = once((list(agents.lanes.T), list(ahead_of(agents, road_map).begin.T)))
    other, other_s = movers.lane[:, None], movers.s[:, None]
    ahead = other_s + begin[0]
    gap = jnp.where((other == lanes[0]) & (ahead > 0.0), ahead, FAR)
    gap = jnp.minimum(gap, jnp.where(other == lanes[1], other_s + begin[1], FAR))
    gap = jnp.minimum(gap, jnp.where(other == lanes[2], other_s + begin[2], FAR))
    half = movers.half_length[:, None]
    gap = jnp.where((other >= 0) & (gap < FAR), gap - (half + 0.5 * agents.length), FAR)
    return CarsAhead(gap, movers.speed[:, None], half, movers.is_queued[:, None])


def _next(agents: Agents, movers: Mover, road_map: RoadMap) -> CarsAhead:
    """The next on each lane, 3 NEXT rows."""
    lanes, begin = agents.lanes.T, ahead_of(agents, road_map).begin.T  # (3, N)
    seen = (movers.s, movers.speed, movers.half_length, movers.is_queued)
    length = road_map.lane_length
    all_cars = order.sort(movers.lane, movers.s, seen, length.shape[0], length.max())
    start = jnp.maximum(-begin, 0.0)  # where it is on its own lane, the beginnings of the others
    (s, speed, half, is_queued), on_lane = order.following(all_cars, lanes, start, NEXT)
    gap = jnp.where(on_lane & (s + begin > 0.0), s + begin - (half + 0.5 * agents.length), FAR)
    rows = once((gap, speed, half, is_queued))  # (NEXT, 3, N)
    return CarsAhead(*(x.reshape(3 * NEXT, -1) for x in rows))


def leaders(gaps: jax.Array, speed: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Bumper gap to, and speed of, the nearest car ahead: (N,) m, (N,) m/s.

    Args:
      gaps: (R, N) m to others.
      speed: (R, 1) or (R, N) m/s of those.
    """
    nearest = gaps.min(axis=0)
    # No search by index, which would cost more than all of the above.
    return nearest, jnp.where(gaps == nearest, speed, 0.0).max(axis=0)
