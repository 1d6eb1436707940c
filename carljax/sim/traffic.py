"""Traffic on lanes: where vehicles are, how they move on, where they begin.

An agent is a lane, an arc length and a plan of the next two lanes. `drivers` says how it speeds up
and brakes, `lane_change` when it changes lanes, `lane_plan` where it goes.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.sim import (
    corridor,
    drivers,
    geometry,
    indicators,
    lane_change,
    lane_shift,
    population,
    vehicles,
)
from carljax.sim.idm import IDMParams
from carljax.sim.lane_plan import next_lane, plan
from carljax.sim.once import once
from carljax.sim.right_of_way import (
    FAR,
    EgoPlace,
    all_movers,
    has_stopped,
    planned_lane,
    stop_ahead,
)
from carljax.sim.road_map import RoadMap, pose_at
from carljax.sim.types import KIND_VEHICLE, Agents, EgoState, LightClock

STANDS, DRIVES_ON = 0.1, 2.0  # m/s, less is rest, more is driving on. source: ours


def step(
    agents: Agents,
    others: Agents,
    ego: EgoState,
    ego_length: jax.Array,
    ego_place: EgoPlace,
    road_map: RoadMap,
    clock: LightClock,
    key: jax.Array,
    params: IDMParams,
    dt: float,
) -> Agents:
    """Moves all agents by one step.

    Args:
      agents: (N,) vehicles on lanes.
      others: (F,) whoever else may stand, walk or ride in their way, off the lanes.
      ego: the ego before its own step.
      ego_length: () m.
      ego_place: its place on the lane graph.
      road_map: the map.
      clock: of the lights.
      key: PRNG key, for the choice of lanes.
      params: of the driver model.
      dt: s.

    Returns:
      The agents dt later.
    """
    stop = stop_ahead(agents, road_map, clock)
    movers = all_movers(agents, stop, ego, ego_length, ego_place, road_map, clock)
    seen = corridor.obstacles(others, ego, ego_length)
    free = drivers.free_speed(agents, road_map)
    accel = drivers.accelerations(agents, free, stop, movers, seen, road_map, params)
    # Else a CPU works them out anew for each field of the agents that follows from them.
    accel, free_speed = once((accel, free.speed))
    key_change, key_plan = jax.random.split(key)
    agents = lane_change.begin(agents, movers, free_speed, road_map, params, key_change)
    speed = jnp.maximum(agents.speed + accel * dt, 0.0)
    travelled = 0.5 * (agents.speed + speed) * dt
    moved = agents.replace(
        speed=speed,
        accel=(speed - agents.speed) / dt,
        lane_s=agents.lane_s + travelled,
        wait_s=_waited(agents, speed, dt),
        has_stopped=has_stopped(agents, stop, speed),
    )
    moved = lane_shift.move(moved, travelled, road_map)
    moved = place(_follow_plan(moved, road_map, key_plan), road_map)
    return moved.replace(signals=indicators.signals(moved, road_map))


def place(agents: Agents, road_map: RoadMap) -> Agents:
    """Fills in xy, z, yaw and yaw rate from lane, arc length and offset."""
    pose = pose_at(road_map, jnp.maximum(agents.lanes[:, 0], 0), agents.lane_s)
    side = jnp.stack([-jnp.sin(pose.yaw), jnp.cos(pose.yaw)], axis=-1)
    return agents.replace(
        xy=pose.xy + agents.lateral[:, None] * side,
        z=pose.z,
        yaw=geometry.wrap_angle(pose.yaw + jnp.arctan(lane_shift.slope(agents))),
        yaw_rate=agents.speed * pose.curvature,
    )


def _waited(agents: Agents, speed: jax.Array, dt: float) -> jax.Array:
    """(N,) s since the agent came to rest, until it drives on.

    It counts on while the agent sets off, which would lose its turn otherwise.
    """
    counts = (speed < STANDS) | (agents.wait_s > 0.0)
    return jnp.where(counts & (speed < DRIVES_ON), agents.wait_s + dt, 0.0)


def _follow_plan(agents: Agents, road_map: RoadMap, key: jax.Array) -> Agents:
    """Moves on to the next lane of the plan where the current one ends, and extends the plan."""
    keys = jax.random.split(key, 2)
    for key_choice in keys:  # twice: very short lanes are passed within one step
        length = road_map.lane_length[planned_lane(agents, 0)]
        over = (agents.lane_s > length) & (agents.lanes[:, 1] >= 0)
        drawn = next_lane(agents.lanes[:, 2], agents.model, road_map, key_choice)
        onward = jnp.stack([agents.lanes[:, 1], agents.lanes[:, 2], drawn], axis=1)
        agents = agents.replace(
            lanes=jnp.where(over[:, None], onward, agents.lanes),
            lane_s=jnp.where(over, agents.lane_s - length, agents.lane_s),
            past_lane=jnp.where(over, agents.lanes[:, 0], agents.past_lane),
        )
    return agents


def initial(
    lane: jax.Array, s: jax.Array, speed: jax.Array, road_map: RoadMap, key: jax.Array
) -> Agents:
    """Agents at the start of an episode.

    Args:
      lane: (N,) int32, -1 for empty slots.
      s: (N,) m.
      speed: (N,) m/s.
      road_map: the map.
      key: PRNG key, of plans, sizes and tempers.

    Returns:
      The agents, placed.
    """
    key_plan, key_model, key_temper = jax.random.split(key, 3)
    num = lane.shape[0]
    model, length, width = vehicles.draw(lane, _room(lane, s), road_map, key_model)
    agents = population.nobody(num).replace(
        speed=jnp.where(lane >= 0, jnp.minimum(speed, vehicles.speed_cap(model)), 0.0),
        length=length,
        width=width,
        kind=jnp.where(lane >= 0, KIND_VEHICLE, 0).astype(jnp.int32),
        model=model,
        lanes=plan(lane, model, road_map, key_plan),
        lane_s=s,
        desired_speed_frac=jax.random.uniform(key_temper, (num,), minval=0.7, maxval=1.1),
    )
    return place(agents, road_map)


def _room(lane: jax.Array, s: jax.Array) -> jax.Array:
    """(N,) m, length of vehicles that leave a metre between one another on each lane."""
    away = jnp.abs(s[:, None] - s[None, :])
    same = (lane[:, None] == lane[None, :]) & ~jnp.eye(lane.shape[0], dtype=bool)
    return jnp.where(same, away, FAR).min(axis=1) - 1.0
