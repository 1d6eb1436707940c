"""Background activity: cars that are left behind come back where the ego will meet them.

Ahead on the ego's route or beside it, behind, oncoming, and at the arms of the next junctions, or
anywhere around: out of sight, where there is room. source: CARLA leaderboard 2.0 keeps background
vehicles in the same places (ahead and behind in each lane, opposite lanes, junction sources); how
many there are follows here from the number of rows.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from carljax.sim import geometry, traffic
from carljax.sim.right_of_way import BRAKING, FAR, planned_lane
from carljax.sim.road_map import RoadMap, grid_cell, pose_at, row_at
from carljax.sim.route import Route
from carljax.sim.spawn import END_CLEARANCE
from carljax.sim.types import Agents, EgoState

VIEW_FRONT, VIEW_BACK, VIEW_SIDE = 80.0, 52.0, 66.0  # m, just beyond CaRL's image
HALF_BUS = 4.0  # m beyond that, so that no part of a long vehicle is seen to appear
GONE = 150.0  # m from the ego, beyond which an agent is used again
LEAVING = 100.0  # m from the ego, beyond which one is that drives away from it. source: ours
SPAWN_GAP = 14.0  # m kept to other cars. source: CARLA's background activity, 15 m
STANDSTILL = 10.0  # m between the middles of two that have stopped, one of them a bus
BRISK = 0.9  # of the speed limit. source: ours
AHEAD = (86.0, 135.0)  # m along the route, of cars ahead, oncoming and of junctions
BEHIND = (58.0, 80.0)  # m
ARM = (8.0, 60.0)  # m before a junction. source: CARLA's junction sources stand 40 m before it
REACHES = (AHEAD, BEHIND, ARM)
END_OF_LANE = 8.0  # m before a dead end in which a car has come to it
# Where the next car appears: ahead, behind, oncoming, junction arm, anywhere. source: ours, from
# how often each of them finds room
SHARES = (0.25, 0.2, 0.25, 0.2, 0.1)


class Place(struct.PyTreeNode):
    """A place on a lane: lane () int32, -1 for none; s () m."""

    lane: jax.Array
    s: jax.Array


def respawn(
    agents: Agents,
    others: Agents,
    ego: EgoState,
    routes: Route,
    episode_idx: jax.Array,
    route_idx: jax.Array,
    road_map: RoadMap,
    key: jax.Array,
    cell_size: float,
) -> Agents:
    """Moves at most one agent that has been left behind to a place where the ego will meet it.

    Args:
      agents: (N,) agents.
      others: vehicles of scenarios, whose places are taken too.
      ego: the ego.
      routes: the bank's, leading axis S.
      episode_idx: () int32, its row of them.
      route_idx: () int32, last passed point.
      road_map: the map.
      key: PRNG key.
      cell_size: m, of the respawn grid.

    Returns:
      The agents; the moved one is another vehicle, with a new plan and the speed of its lane.
    """
    key_place, key_car = jax.random.split(key)
    place = _draw(ego, routes, episode_idx, route_idx, road_map, key_place, cell_size)
    lane = jnp.maximum(place.lane, 0)
    pose = pose_at(road_map, lane, place.s)
    speed, is_clear = _fit_in(lane, place.s, pose.xy, agents, others, road_map)
    can = is_clear & _is_hidden(pose.xy, ego) & (place.lane >= 0)
    away = geometry.squared_distance(agents.xy, ego.xy)
    gone = _is_gone(agents, ego, away, road_map)
    chosen = jnp.argmax(jnp.where(gone, away + 1.0, 0.0))
    moves = (jnp.arange(gone.shape[0]) == chosen) & gone & can
    fresh = traffic.initial(lane[None], place.s[None], speed[None], road_map, key_car)

    def choose(new: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.where(moves.reshape(-1, *[1] * (old.ndim - 1)), new, old)

    return jax.tree.map(choose, fresh, agents)


def _is_hidden(xy: jax.Array, ego: EgoState) -> jax.Array:
    """(...) bool: places (..., 2) that the ego does not see."""
    seen = geometry.to_frame(xy, ego.xy, ego.yaw)
    outside = (seen[..., 0] > VIEW_FRONT + HALF_BUS) | (seen[..., 0] < -VIEW_BACK - HALF_BUS)
    return outside | (jnp.abs(seen[..., 1]) > VIEW_SIDE + HALF_BUS)


def _is_gone(agents: Agents, ego: EgoState, away: jax.Array, road_map: RoadMap) -> jax.Array:
    """(N,) bool: agents that the ego will not meet again; `away` is the squared distance, m^2."""
    at_end = agents.lane_s > road_map.lane_length[planned_lane(agents, 0)] - END_OF_LANE
    ended = (agents.lanes[:, 1] < 0) & at_end
    along = jnp.stack([jnp.cos(agents.yaw), jnp.sin(agents.yaw)], axis=-1)
    own = ego.speed * jnp.stack([jnp.cos(ego.yaw), jnp.sin(ego.yaw)])
    closing = -((agents.xy - ego.xy) * (agents.speed[:, None] * along - own)).sum(axis=1)
    leaves = (away > LEAVING**2) & (closing < 0.0)
    unseen = _is_hidden(agents.xy, ego)
    return agents.valid & ((away > GONE**2) | ((ended | leaves) & unseen))


def _fit_in(
    lane: jax.Array,
    s: jax.Array,
    xy: jax.Array,
    agents: Agents,
    others: Agents,
    road_map: RoadMap,
) -> tuple[jax.Array, jax.Array]:
    """Speed () m/s at which a car fits in at a place, and whether it does, () bool.

    It can stop behind the car ahead and at its lane's end, and the car behind can stop for it.
    """
    cars = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), agents, others)
    near = geometry.squared_distance(cars.xy, xy) < SPAWN_GAP**2
    same = cars.valid & (cars.lanes[:, 0] == lane)
    ahead = jnp.where(same & (cars.lane_s > s), cars.lane_s - s, FAR).min()
    room = jnp.minimum(ahead, road_map.lane_length[lane] - s + STANDSTILL) - STANDSTILL
    limit = jnp.minimum(road_map.lane_speed_limit[lane], road_map.lane_curve_speed[lane])
    stops = jnp.sqrt(2 * BRAKING * jnp.maximum(room, 0.0))
    speed = jnp.minimum(BRISK * limit, stops)
    needs = jnp.maximum(cars.speed**2 - speed**2, 0.0) / (2 * BRAKING) + STANDSTILL
    behind = same & (cars.lane_s <= s) & (s - cars.lane_s < needs)
    return speed, ~((cars.valid & near) | behind).any()


def _draw(
    ego: EgoState,
    routes: Route,
    episode_idx: jax.Array,
    route_idx: jax.Array,
    road_map: RoadMap,
    key: jax.Array,
    cell_size: float,
) -> Place:
    """A place where the ego would meet a car; whether it is free and hidden is another question."""
    key_role, key_side, key_arm, key_any, key_far = jax.random.split(key, 5)
    ahead, back, before = (
        low + u * (high - low)
        for u, (low, high) in zip(jax.random.uniform(key_far, (3,)), REACHES, strict=True)
    )
    last = routes.num_points[episode_idx] - 1
    steps = jnp.concatenate([jnp.stack([ahead, -back]), jnp.linspace(*AHEAD, 6)])
    points = route_idx + steps.astype(jnp.int32)
    exists = (points >= 0) & (points <= last)
    points = jnp.clip(points, 0, last)
    lanes, s = routes.lane[episode_idx, points], routes.lane_s[episode_idx, points]
    rows = row_at(road_map, lanes[:2], s[:2])
    side = jax.random.randint(key_side, (2,), 0, 3)
    beside = jnp.where(side == 0, road_map.point_left[rows], road_map.point_right[rows])
    opposite = road_map.point_oncoming[rows[0]]
    rows = jnp.where((side < 2) & (beside >= 0), beside, rows)
    inside = exists[2:] & road_map.lane_in_junction[lanes[2:]]
    junction = road_map.lane_junction[lanes[2:][jnp.argmax(inside)]]
    arms = road_map.junction_arms[jnp.maximum(junction, 0)]
    arm = arms[jax.random.randint(key_arm, (), 0, jnp.maximum((arms >= 0).sum(), 1))]
    from_arm = jnp.maximum(road_map.lane_length[jnp.maximum(arm, 0)] - before, END_CLEARANCE)
    places = [
        _at_point(rows[0], exists[0], road_map),
        _at_point(rows[1], exists[1], road_map),
        _at_point(jnp.maximum(opposite, 0), exists[0] & (opposite >= 0), road_map),
        Place(jnp.where(inside.any(), arm, -1), from_arm),
        _of_cell(ego, routes.town[episode_idx], road_map, key_any, cell_size),
    ]
    role = jax.random.categorical(key_role, jnp.log(jnp.float32(SHARES)))
    return jax.tree.map(lambda *x: jnp.stack(x)[role], *places)


def _at_point(row: jax.Array, exists: jax.Array, road_map: RoadMap) -> Place:
    """The place of a lane point, none in a junction or near the end of a lane."""
    lane = road_map.point_lane[row]
    spacing = road_map.lane_length[lane] / (road_map.lane_num_points[lane] - 1)
    s = (row - road_map.lane_start[lane]) * spacing
    fits = (s >= END_CLEARANCE) & (s <= road_map.lane_end[lane] - END_CLEARANCE)
    return Place(jnp.where(exists & fits & ~road_map.lane_in_junction[lane], lane, -1), s)


def _of_cell(
    ego: EgoState, town: jax.Array, road_map: RoadMap, key: jax.Array, cell_size: float
) -> Place:
    """One of the places listed for the ego's grid cell."""
    found = (
        grid_cell(road_map, town, ego.xy, cell_size),
        jax.random.randint(key, (), 0, road_map.spawn_lane.shape[1]),
    )
    return Place(road_map.spawn_lane[found], road_map.spawn_s[found])
