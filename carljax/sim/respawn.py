"""Cars that are left behind come back ahead: out of sight, where there is room."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.sim import geometry, lane_plan, traffic, vehicles
from carljax.sim.right_of_way import BRAKING, planned_lane
from carljax.sim.road_map import RoadMap, pose_at
from carljax.sim.types import Agents, EgoState

VIEW_FRONT, VIEW_BACK, VIEW_SIDE = 80.0, 52.0, 66.0  # m, just beyond CaRL's image
GONE = 150.0  # m from the ego, beyond which an agent is used again
SPAWN_GAP = 14.0  # m kept to other cars


def respawn(
    agents: Agents,
    others: Agents,
    ego: EgoState,
    town: jax.Array,
    road_map: RoadMap,
    key: jax.Array,
    cell_size: float,
) -> Agents:
    """Moves at most one far-away agent to a free place near the ego but out of its sight.

    Args:
      agents: (N,) agents.
      others: vehicles of scenarios, whose places are taken too.
      ego: the ego.
      town: () int32.
      road_map: the map.
      key: PRNG key.
      cell_size: m, of the respawn grid.

    Returns:
      The agents; the moved one is another vehicle, with a new plan and the speed of its lane.
    """
    key_place, key_plan, key_model = jax.random.split(key, 3)
    lane, s = _respawn_place(ego, town, road_map, key_place, cell_size)
    pose = pose_at(road_map, jnp.maximum(lane, 0), s)
    seen = geometry.to_frame(pose.xy, ego.xy, ego.yaw)
    hidden = (seen[0] > VIEW_FRONT) | (seen[0] < -VIEW_BACK) | (jnp.abs(seen[1]) > VIEW_SIDE)
    clear = _is_clear(agents, pose.xy) & _is_clear(others, pose.xy)
    away = ((agents.xy - ego.xy) ** 2).sum(axis=1)
    ended = (agents.lanes[:, 1] < 0) & _at_end(agents, road_map)
    relative = geometry.to_frame(agents.xy, ego.xy, ego.yaw)
    unseen = ((relative[:, 0] > VIEW_FRONT) | (relative[:, 0] < -VIEW_BACK)) | (
        jnp.abs(relative[:, 1]) > VIEW_SIDE
    )
    gone = agents.valid & ((away > GONE**2) | (ended & unseen))
    chosen = jnp.argmax(jnp.where(gone, away + 1.0, 0.0))
    moves = (jnp.arange(gone.shape[0]) == chosen) & gone & hidden & clear & (lane >= 0)
    one = jnp.maximum(lane, 0)[None]
    model, length, width = vehicles.draw(one, jnp.float32([SPAWN_GAP]), road_map, key_model)
    lanes = lane_plan.plan(one, model, road_map, key_plan)
    limit = jnp.minimum(
        road_map.lane_speed_limit[lanes[0, 0]], road_map.lane_curve_speed[lanes[0, 0]]
    )
    # No faster than can be stopped within the gap that was checked.
    speed = jnp.minimum(0.8 * limit, jnp.sqrt(2 * BRAKING * (SPAWN_GAP - 6.0)))
    speed = jnp.minimum(speed, vehicles.speed_cap(model[0]))
    return traffic.place(
        agents.replace(
            model=jnp.where(moves, model, agents.model),
            length=jnp.where(moves, length, agents.length),
            width=jnp.where(moves, width, agents.width),
            lanes=jnp.where(moves[:, None], lanes, agents.lanes),
            lane_s=jnp.where(moves, s, agents.lane_s),
            past_lane=jnp.where(moves, -1, agents.past_lane),
            speed=jnp.where(moves, speed, agents.speed),
            accel=jnp.where(moves, 0.0, agents.accel),
            wait_s=jnp.where(moves, 0.0, agents.wait_s),
            has_stopped=agents.has_stopped & ~moves,
            lateral=jnp.where(moves, 0.0, agents.lateral),
            from_lane=jnp.where(moves, -1, agents.from_lane),
        ),
        road_map,
    )


def _is_clear(agents: Agents, xy: jax.Array) -> jax.Array:
    """() bool: none of them is near a place (2,)."""
    return (~agents.valid | (((agents.xy - xy) ** 2).sum(axis=1) > SPAWN_GAP**2)).all()


def _at_end(agents: Agents, road_map: RoadMap) -> jax.Array:
    return agents.lane_s > road_map.lane_length[planned_lane(agents, 0)] - 8.0


def _respawn_place(
    ego: EgoState, town: jax.Array, road_map: RoadMap, key: jax.Array, cell_size: float
) -> tuple[jax.Array, jax.Array]:
    """One of the places listed for the ego's grid cell: lane () int32 (-1: none), s () m."""
    _, rows, columns, candidates = road_map.spawn_lane.shape
    cell = ((ego.xy - road_map.origin[town]) / cell_size).astype(jnp.int32)
    column, row = jnp.clip(cell[0], 0, columns - 1), jnp.clip(cell[1], 0, rows - 1)
    pick = jax.random.randint(key, (), 0, candidates)
    return road_map.spawn_lane[town, row, column, pick], road_map.spawn_s[town, row, column, pick]
