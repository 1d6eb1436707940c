"""How a car moves from one lane to the next, and how others see it meanwhile.

From the first moment of a lane change the car is on its new lane, with an offset (`lateral`) that
goes to zero. Until it is clear of the lane it leaves it counts as a car on both, and minds the cars
ahead on both.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.sim.right_of_way import Mover
from carljax.sim.road_map import RoadMap
from carljax.sim.types import Agents

AT_ONCE = 4  # lane changes that go on at once around the ego. source: ours, enough for 32 cars
LATERAL_SPEED = 1.6  # m/s at most: 3.5 m take 3.5 s. source: ours, drivers take 3 to 6 s
LATERAL_SLOPE = 0.25  # of the forward speed at most. source: ours, 14 degrees
LANE_WIDTH = 3.5  # m, the usual way across
EASE = 0.15  # part of the slope at either end of the way
CLEAR = 0.6  # m from the new lane's middle at which the old lane is free
FAR = 1e3  # m, a gap that changes nothing


def slope(agents: Agents) -> jax.Array:
    """(N,) metres to the left for each metre along the lane; steepest half-way across."""
    part = jnp.clip(jnp.abs(agents.lateral) / LANE_WIDTH, 0.0, 1.0)
    steepest = jnp.minimum(LATERAL_SLOPE, LATERAL_SPEED / jnp.maximum(agents.speed, 0.1))
    return -jnp.sign(agents.lateral) * steepest * (EASE + (1 - EASE) * 4 * part * (1 - part))


def move(agents: Agents, travelled: jax.Array, road_map: RoadMap) -> Agents:
    """Brings cars nearer to the middle of their lanes.

    Args:
      agents: (N,) vehicles.
      travelled: (N,) m along the lane in this step.
      road_map: the map.
    """
    lateral = agents.lateral + slope(agents) * travelled
    lateral = jnp.where(lateral * agents.lateral > 0.0, lateral, 0.0)
    from_s = agents.from_s + travelled
    leaves = (agents.from_lane >= 0) & (jnp.abs(lateral) > CLEAR)
    leaves &= from_s < road_map.lane_length[jnp.maximum(agents.from_lane, 0)]
    return agents.replace(
        lateral=lateral,
        from_lane=jnp.where(leaves, agents.from_lane, -1),
        from_s=jnp.where(leaves, from_s, 0.0),
    )


def changing(agents: Agents) -> tuple[jax.Array, jax.Array]:
    """(AT_ONCE,) int32 rows of cars that change lanes, (AT_ONCE,) bool those in use."""
    changes = agents.from_lane >= 0
    number = jnp.cumsum(changes) - 1
    match = changes & (number == jnp.arange(AT_ONCE)[:, None])
    return jnp.argmax(match, axis=1), match.any(axis=1)


def with_leaving(movers: Mover, agents: Agents) -> Mover:
    """The movers, and behind them AT_ONCE rows of cars once more, on the lanes that they leave."""
    row, is_used = changing(agents)
    lane = jnp.where(is_used, agents.from_lane[row], -1)
    more = movers.replace(
        lane=lane,
        next_lane=jnp.full_like(lane, -1),
        s=agents.from_s[row],
        entry=jnp.full(lane.shape, FAR, jnp.float32),
        speed=agents.speed[row],
        half_length=0.5 * agents.length[row],
        can_go=jnp.zeros(lane.shape, bool),
        is_queued=jnp.zeros(lane.shape, bool),
    )
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), movers, more)


def leaders(agents: Agents, movers: Mover, road_map: RoadMap) -> tuple[jax.Array, jax.Array]:
    """Leaders that are so because of a lane change: bumper gap (N,) m, speed (N,) m/s.

    To everybody the cars that still leave its lane or its next one; and to those who leave a lane
    the cars ahead on it.

    Args:
      agents: (N,) vehicles.
      movers: (N + 1,) everybody.
      road_map: the map.
    """
    row, is_used = changing(agents)
    half = 0.5 * agents.length
    # Everybody behind those who leave: (AT_ONCE, N).
    left = jnp.where(is_used, agents.from_lane[row], -2)[:, None]
    left_s, left_half = agents.from_s[row][:, None], half[row][:, None]
    on_first, on_next = agents.lanes[:, 0] == left, agents.lanes[:, 1] == left
    to_next = road_map.lane_length[jnp.maximum(agents.lanes[:, 0], 0)] - agents.lane_s
    offset = left_s - agents.lane_s
    ahead = jnp.where(on_first & (offset > 0.0), offset, FAR)
    ahead = jnp.minimum(ahead, jnp.where(on_next, to_next + left_s, FAR))
    ahead = ahead - half - left_half
    # Those who leave behind everybody, others who leave the same lane too: (N + ..., AT_ONCE).
    seen = jax.tree.map(lambda x: x[:, None], with_leaving(movers, agents))
    offset = seen.s - left_s[:, 0]
    gap = jnp.where((seen.lane == left[:, 0]) & (offset > 0.0), offset, FAR)
    gap = gap - half[row] - seen.half_length
    nearest = gap.min(axis=0)
    speed = jnp.where(gap == nearest, seen.speed, 0.0).max(axis=0)
    is_mine = (jnp.arange(agents.lane_s.shape[0]) == row[:, None]) & is_used[:, None]
    both = jnp.concatenate([ahead, jnp.where(is_mine, nearest[:, None], FAR)])  # (2 AT_ONCE, N)
    speeds = jnp.concatenate([agents.speed[row], speed])[:, None]
    least = both.min(axis=0)
    return least, jnp.where(both == least, speeds, 0.0).max(axis=0)
