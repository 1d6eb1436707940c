"""What drivers do: IDM towards everything that lies ahead on their way.

All that a driver reacts to is a gap along its plan: the car ahead, also across the ends of lanes
and where lanes part or join; the line of a light that is not green, or of a stop sign at which it
has not halted; the entry of a junction in which others go first, or behind which there is no room;
and whoever stands or steps in its way. It takes the hardest braking of all.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from carljax.sim import corridor, idm, lane_shift, priority, vehicles
from carljax.sim.corridor import Obstacles
from carljax.sim.idm import IDMParams
from carljax.sim.lane_table import CURVE_BRAKING
from carljax.sim.once import once
from carljax.sim.right_of_way import FAR, Mover, StopAhead, ahead_of, must_stop
from carljax.sim.road_map import RoadMap, row_at
from carljax.sim.types import Agents

STOP_MARGIN = 1.0  # m kept to a line and to a junction's entry. source: ours
STRETCH_MARGIN = 0.5  # m kept to a stretch on which another car is. source: ours
SLOWEST = 1.0  # m/s, the least free speed
QUEUE_GAP = 6.0  # m between cars of a queue, at most. source: ours, three times IDM's gap at rest


class Free(struct.PyTreeNode):
    """How fast an agent would drive alone, (N,): limit and temper m/s; bends included m/s."""

    limit: jax.Array
    speed: jax.Array


def accelerations(
    agents: Agents,
    free: Free,
    stop: StopAhead,
    movers: Mover,
    seen: Obstacles,
    road_map: RoadMap,
    params: IDMParams,
) -> jax.Array:
    """(N,) m/s^2: the hardest braking that any leader, line, junction or obstacle asks for.

    Args:
      agents: (N,) vehicles on lanes.
      free: how fast they would like to drive.
      stop: the line before each.
      movers: (N + 1,) everybody, the ego last.
      seen: (F,) obstacles, the ego first.
      road_map: the map.
      params: of a car's driver.
    """
    focus = priority.focus_of(agents, road_map, free.limit)
    others = priority.crossers(agents, movers, road_map, free.limit)
    focus = once(focus)
    others, movers = once((others, movers))
    pair = priority.pairs(agents, focus, others, road_map)
    along = lane_gaps(agents, movers, road_map)
    joined = priority.joined_gaps(pair)
    gap, leader_speed = _nearer(
        leaders(along, movers.speed[:, None]), leaders(joined, pair.others.speed)
    )
    half = 0.5 * agents.length
    room = priority.has_room(focus, half, along, movers)
    may_go = movers.can_go & jnp.append(room & ~_is_in_queue(along, movers), True)
    may_go = once(may_go | others.is_lawless)
    waits = priority.gated(pair, may_go) | (~room & (focus.front < priority.ENTERED))
    waits &= focus.lane >= 0
    lane_end = road_map.lane_end[jnp.maximum(agents.lanes[:, 0], 0)] - agents.lane_s - half
    ends = jnp.where(agents.lanes[:, 1] < 0, lane_end, FAR)
    lawful = jnp.stack(
        [
            jnp.where(must_stop(agents, stop), stop.distance - STOP_MARGIN, FAR),
            jnp.where(waits, -focus.front - STOP_MARGIN, FAR),
            priority.stretch_gaps(pair) - STRETCH_MARGIN,
        ]
    ).min(axis=0)
    still = jnp.minimum(jnp.where(agents.is_lawless, FAR, lawful), ends - STOP_MARGIN)
    change_gap, change_speed = lane_shift.leaders(agents, movers, road_map)
    way_gap, way_speed = corridor.gaps(agents, seen, road_map)
    way_gap = jnp.where(agents.is_lawless, FAR, way_gap)
    driver = vehicles.driver(agents.model, params)
    ahead = [(gap, leader_speed), (change_gap, change_speed), (way_gap, way_speed)]

    def respond(gap: jax.Array, leader_speed: jax.Array) -> jax.Array:
        return idm.acceleration(agents.speed, gap, leader_speed, free.speed, driver)

    # All searches are over before anybody responds: the compiler would do both in one slow loop.
    ahead, still = once((ahead, still))
    accel = respond(still, jnp.zeros_like(still))
    for gap, leader_speed in ahead:
        accel = jnp.minimum(accel, respond(gap, leader_speed))
    accel = jnp.where(agents.is_braking_hard, -driver.brake_max, accel)
    return jnp.where(agents.valid, accel, 0.0)


def _is_in_queue(along: jax.Array, movers: Mover) -> jax.Array:
    """(N,) bool, stands behind one that stands: to let it go first could be to wait for ever."""
    to_queue = jnp.where(movers.is_queued[:, None], along, FAR).min(axis=0)
    return movers.is_queued[:-1] & (to_queue < QUEUE_GAP)


def free_speed(agents: Agents, road_map: RoadMap) -> Free:
    """The limit, or what a scenario asks for; slower in bends and early enough before them.

    Lawless drivers drive as a scenario asks and mind neither limits nor bends.
    """
    plan = ahead_of(agents, road_map)
    asked = agents.cruise_speed > 0.0
    cap = jnp.where(asked, agents.cruise_speed, vehicles.speed_cap(agents.model))
    lawful = road_map.lane_speed_limit[plan.lane] * agents.desired_speed_frac[:, None]
    limit = jnp.minimum(lawful, cap[:, None])  # (N, 3)
    here = road_map.point_speed[row_at(road_map, plan.lane[:, 0], agents.lane_s)]
    there = road_map.point_speed[road_map.lane_start[plan.lane[:, 1:]]]
    there = jnp.minimum(there, limit[:, 1:])
    left = jnp.maximum(plan.begin[:, 1:], 0.0)
    slowed = jnp.sqrt(there**2 + 2 * CURVE_BRAKING * left)
    slowed = jnp.where(plan.exists[:, 1:], slowed, FAR).min(axis=1)
    speed = jnp.maximum(jnp.minimum(limit[:, 0], jnp.minimum(here, slowed)), SLOWEST)
    is_scripted = agents.is_lawless & asked
    return Free(
        limit=jnp.where(is_scripted, cap, limit[:, 0]),
        speed=jnp.where(is_scripted, cap, speed),
    )


def lane_gaps(agents: Agents, movers: Mover, road_map: RoadMap) -> jax.Array:
    """(M, N) m, bumper gap to every car ahead on an agent's plan; FAR to all others.

    Args:
      agents: (N,) vehicles.
      movers: (M,) everybody, the ego last.
      road_map: the map.
    """
    lanes, begin = once((list(agents.lanes.T), list(ahead_of(agents, road_map).begin.T)))
    other, other_s = movers.lane[:, None], movers.s[:, None]
    ahead = other_s + begin[0]
    gap = jnp.where((other == lanes[0]) & (ahead > 0.0), ahead, FAR)
    gap = jnp.minimum(gap, jnp.where(other == lanes[1], other_s + begin[1], FAR))
    gap = jnp.minimum(gap, jnp.where(other == lanes[2], other_s + begin[2], FAR))
    room = movers.half_length[:, None] + 0.5 * agents.length
    return jnp.where((other >= 0) & (gap < FAR), gap - room, FAR)


def leaders(gaps: jax.Array, speed: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Bumper gap to, and speed of, the nearest car ahead: (N,) m, (N,) m/s.

    Args:
      gaps: (R, N) m to others.
      speed: (R, 1) or (R, N) m/s of those.
    """
    nearest = gaps.min(axis=0)
    # No search by index, which would cost more than all of the above.
    return nearest, jnp.where(gaps == nearest, speed, 0.0).max(axis=0)


def _nearer(
    one: tuple[jax.Array, jax.Array], other: tuple[jax.Array, jax.Array]
) -> tuple[jax.Array, jax.Array]:
    """The nearer of two leaders, each as from `leaders`; of two equally near the faster."""
    gap = jnp.minimum(one[0], other[0])
    return gap, jnp.maximum(*(jnp.where(near == gap, speed, 0.0) for near, speed in (one, other)))
