"""Lane changes of traffic: whether one pays and is safe.

The decision is MOBIL's: what the car gains in acceleration, and what it costs the two cars behind.
source: Kesting, Treiber, Helbing, General lane-changing model MOBIL for car-following models
(2007). A car whose lane ends changes as soon as that is safe. In each step a few cars look to one
side and at most one begins to change, so that two never take the same gap. `lane_shift` then moves
it across.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from carljax.sim import geometry, idm, lane_gaps, vehicles
from carljax.sim.idm import IDMParams
from carljax.sim.lane_gaps import Gaps
from carljax.sim.lane_plan import plan
from carljax.sim.lane_shift import AT_ONCE, FAR
from carljax.sim.right_of_way import Mover, planned_lane
from carljax.sim.road_map import RoadMap
from carljax.sim.types import Agents

POLITENESS = 0.2  # weight of the others' loss. source: Kesting et al.: realistic from 0.2 to 0.5
THRESHOLD = 0.2  # m/s^2 to be gained. source: Treiber's page on MOBIL; 0.1 in the paper
# m/s^2, hardest braking that the new follower is put to, and the car itself. source: Kesting et al.
SAFE_BRAKING = 4.0
# m/s^2 for the sake of a better lane only. source: ours, so that nobody is cut off without need
POLITE_BRAKING = 2.0
MIN_GAP = 1.5  # m to either side. source: ours
PULL_OUT = 12.0  # m behind a standing car from which one gets past it. source: ours, by the slope

TRIES = 8  # cars that look beside in a step: each one about twice a second. source: ours
LEAVES_FROM = 10.0  # m after a lane's beginning: no changes on the way out of a junction
ROOM, ROOM_TIME = 20.0, 3.5  # m and s at the present speed that a change needs before a junction
LANE_ENDS = 150.0  # m before its end a lane is left. source: ours, about where signs warn


class Change(struct.PyTreeNode):
    """Where cars would come by a change: lanes (M, 3) int32, s (M,) m, lateral (M,) m."""

    lanes: jax.Array
    s: jax.Array
    lateral: jax.Array
    possible: jax.Array


def begin(
    agents: Agents,
    movers: Mover,
    desired: jax.Array,
    road_map: RoadMap,
    params: IDMParams,
    key: jax.Array,
) -> Agents:
    """Lets at most one car begin to change lanes.

    Args:
      agents: (N,) vehicles.
      movers: (N + 1,) the same as others see them, and the ego.
      desired: (N,) m/s, free speed of each.
      road_map: the map.
      params: of a car's driver.
      key: PRNG key.

    Returns:
      The agents; one of them may be on the lane beside, its body where it was.
    """
    num = agents.lane_s.shape[0]
    key_row, key_side, key_plan = jax.random.split(key, 3)
    tries = min(TRIES, num)
    rows = (jax.random.randint(key_row, (), 0, num) + jnp.arange(tries)) % num
    cars = jax.tree.map(lambda x: x[rows], agents)
    to_left = jax.random.bernoulli(key_side, shape=(tries,))
    change = beside(cars, to_left, road_map, key_plan)
    gain, safe = judge(rows, change, agents, movers, desired, road_map, params)
    must = _ends(cars.lanes, cars.lane_s, road_map)
    worse = _ends(change.lanes, change.s, road_map) & ~must
    wanted = change.possible & ~worse & (must | (gain > THRESHOLD)) & safe
    wanted &= (agents.from_lane >= 0).sum() < AT_ONCE
    best = jnp.argmax(jnp.where(wanted, gain + jnp.where(must, 100.0, 0.0), -FAR))
    is_row = (jnp.arange(num) == rows[best]) & wanted[best]
    return agents.replace(
        lanes=jnp.where(is_row[:, None], change.lanes[best], agents.lanes),
        lane_s=jnp.where(is_row, change.s[best], agents.lane_s),
        lateral=jnp.where(is_row, change.lateral[best], agents.lateral),
        from_lane=jnp.where(is_row, agents.lanes[:, 0], agents.from_lane),
        from_s=jnp.where(is_row, agents.lane_s, agents.from_s),
    )


def beside(cars: Agents, to_left: jax.Array, road_map: RoadMap, key: jax.Array) -> Change:
    """The place beside each car, and whether a change may begin there.

    Args:
      cars: (M,) vehicles.
      to_left: (M,) bool.
      road_map: the map.
      key: PRNG key, of the new plans.
    """
    lane = planned_lane(cars, 0)
    spacing = road_map.lane_length[lane] / (road_map.lane_num_points[lane] - 1)
    number = jnp.round(cars.lane_s / spacing).astype(jnp.int32)
    point = road_map.lane_start[lane] + jnp.clip(number, 0, road_map.lane_num_points[lane] - 1)
    there = jnp.where(to_left, road_map.point_left[point], road_map.point_right[point])
    exists = there >= 0
    there = jnp.maximum(there, 0)
    new_lane = road_map.point_lane[there]
    offset = geometry.to_frame(cars.xy, road_map.point_xy[there], road_map.point_yaw[there])
    new_spacing = road_map.lane_length[new_lane] / (road_map.lane_num_points[new_lane] - 1)
    s = (there - road_map.lane_start[new_lane]) * new_spacing + offset[:, 0]
    lanes = plan(new_lane, cars.model, road_map, key)
    # Whoever has a part in a scenario keeps its lane.
    plays = cars.is_lawless | cars.is_braking_hard | (cars.cruise_speed > 0.0)
    free = cars.valid & ~plays & (cars.from_lane < 0)
    room = jnp.maximum(ROOM, ROOM_TIME * cars.speed)
    here = _has_room(cars.lanes, cars.lane_s, room, road_map)
    return Change(
        lanes=lanes,
        s=s,
        lateral=offset[:, 1],
        possible=exists & free & here & _has_room(lanes, s, room, road_map),
    )


def _has_room(lanes: jax.Array, s: jax.Array, room: jax.Array, road_map: RoadMap) -> jax.Array:
    """(M,) bool: neither a lane's end, if it goes on there, nor a stop line is near."""
    lane = jnp.maximum(lanes[:, 0], 0)
    left = road_map.lane_length[lane] - s
    line = road_map.lane_stop_s[lane] - s
    at_line = (road_map.lane_stop_kind[lane] > 0) & (line > 0.0) & (line < room)
    return (s > LEAVES_FROM) & ((left > room) | (lanes[:, 1] < 0)) & ~at_line


def _ends(lanes: jax.Array, s: jax.Array, road_map: RoadMap) -> jax.Array:
    """(M,) bool: the way ends within LANE_ENDS."""
    lengths = road_map.lane_length[jnp.maximum(lanes[:, :2], 0)]
    left = lengths[:, 0] - s
    left = left + jnp.where(lanes[:, 1] >= 0, lengths[:, 1], 0.0)
    return (lanes[:, 1:] < 0).any(axis=1) & (left < LANE_ENDS)


def judge(
    rows: jax.Array,
    change: Change,
    agents: Agents,
    movers: Mover,
    desired: jax.Array,
    road_map: RoadMap,
    params: IDMParams,
) -> tuple[jax.Array, jax.Array]:
    """MOBIL's two criteria.

    Args:
      rows: (M,) int32, those that think of a change.
      change: (M,) where they would come.
      agents: (N,) all vehicles.
      movers: (N + 1,) the same as others see them, and the ego.
      desired: (N,) m/s, free speed of each.
      road_map: the map.
      params: of a car's driver.

    Returns:
      (M,) m/s^2 gained by the car, and in part by those behind it; (M,) bool, nobody has to brake
      too hard for it.
    """
    cars = jax.tree.map(lambda x: x[rows], agents)
    everybody = lane_gaps.others(agents, movers, desired, road_map, params)
    length = cars.length
    old = lane_gaps.gaps(cars.lanes, cars.lane_s, length, rows, everybody, road_map)
    new = lane_gaps.gaps(change.lanes, change.s, length, rows, everybody, road_map)
    own = vehicles.driver(cars.model, params)
    faster = road_map.lane_speed_limit[jnp.maximum(change.lanes[:, 0], 0)]
    faster = faster / road_map.lane_speed_limit[planned_lane(cars, 0)]
    free = desired[rows]
    stays = idm.acceleration(cars.speed, old.ahead, old.leader_speed, free, own)
    goes = idm.acceleration(cars.speed, new.ahead, new.leader_speed, free * faster, own)

    behind_then = lane_gaps.follows(new, new.behind, cars.speed)
    gain = goes - stays + POLITENESS * _gain_behind(old, new, cars)
    must = _ends(cars.lanes, cars.lane_s, road_map)
    bound = -jnp.where(must, SAFE_BRAKING, POLITE_BRAKING)
    safe = (new.ahead > MIN_GAP) & (new.behind > MIN_GAP) & (goes > bound)
    # Nobody stands so near ahead that there is no way around.
    safe &= old.ahead + ROOM_TIME * old.leader_speed > PULL_OUT
    safe &= (behind_then > bound) | jnp.isinf(new.behind)
    return gain, safe


def _gain_behind(old: Gaps, new: Gaps, cars: Agents) -> jax.Array:
    """(M,) m/s^2 that the old and the new follower gain together."""
    whole = new.behind + cars.length + new.ahead
    behind = lane_gaps.follows(new, new.behind, cars.speed)
    behind = behind - lane_gaps.follows(new, whole, new.leader_speed)
    whole = old.behind + cars.length + old.ahead
    left = lane_gaps.follows(old, whole, old.leader_speed)
    left = left - lane_gaps.follows(old, old.behind, cars.speed)
    gain = jnp.where(jnp.isinf(new.behind), 0.0, behind)
    return gain + jnp.where(jnp.isinf(old.behind), 0.0, left)
