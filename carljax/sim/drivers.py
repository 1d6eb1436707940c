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

from carljax.sim import cars_ahead, corridor, idm, lane_shift, priority, vehicles
from carljax.sim.cars_ahead import CarsAhead, leaders
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
    half = 0.5 * agents.length
    focus, movers = once(priority.focus_of(agents, road_map, free.limit)), once(movers)
    along = cars_ahead.look(agents, movers, road_map)
    room = priority.has_room(focus, half, along)
    may_go = movers.can_go & jnp.append(room & ~_is_in_queue(along, movers), True)
    others = once(priority.crossers(agents, movers, may_go, road_map, free.limit))
    pair = priority.pairs(agents, focus, others, road_map)
    joined = priority.joined_gaps(pair)
    gap, leader_speed = _nearer(leaders(along.gap, along.speed), leaders(joined, pair.others.speed))
    waits = priority.gated(pair) | (~room & (focus.front < priority.ENTERED))
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


def _is_in_queue(along: CarsAhead, movers: Mover) -> jax.Array:
    """(N,) bool, stands behind one that stands: to let it go first could be to wait for ever."""
    to_queue = jnp.where(along.is_queued, along.gap, FAR).min(axis=0)
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


def _nearer(
    one: tuple[jax.Array, jax.Array], other: tuple[jax.Array, jax.Array]
) -> tuple[jax.Array, jax.Array]:
    """The nearer of two leaders, each as from `leaders`; of two equally near the faster."""
    gap = jnp.minimum(one[0], other[0])
    return gap, jnp.maximum(*(jnp.where(near == gap, speed, 0.0) for near, speed in (one, other)))
