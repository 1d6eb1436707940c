"""Traffic on lanes: IDM behind leaders, at red lights, stop signs and in junctions.

An agent is a lane, an arc length and a plan of the next two lanes. Everything it reacts to is a gap
along that plan: the car ahead (also across lane boundaries), the stop line of a light that is not
green, a stop sign at which it has not yet halted, and the entry of a junction in which others go
first. It takes the hardest braking of all. The ego is one more car to them.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.sim import geometry, idm, indicators, lane_change, lane_shift, population, vehicles
from carljax.sim.idm import IDMParams
from carljax.sim.lane_plan import next_lane, plan
from carljax.sim.right_of_way import (
    BRAKING,
    EgoPlace,
    Mover,
    StopAhead,
    all_movers,
    gated,
    has_stopped,
    must_stop,
    planned_lane,
    stop_ahead,
)
from carljax.sim.road_map import RoadMap, pose_at
from carljax.sim.types import KIND_VEHICLE, Agents, EgoState, LightClock

FAR = 1e3  # m, a gap that changes nothing
FORK_LENGTH = 9.0  # m in which lanes that part still overlap. source: ours, car length + width
CURVE_BRAKING = 1.5  # m/s^2 towards a bend. source: ours
STOP_MARGIN = 1.0  # m kept to a stop line. source: ours


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
      others: whoever else may stand or walk in their way.
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
    accel = accelerations(agents, stop, movers, ego, ego_length, road_map, params)
    key_change, key_plan = jax.random.split(key)
    agents = lane_change.begin(
        agents, movers, desired_speed(agents, road_map), road_map, params, key_change
    )
    speed = jnp.maximum(agents.speed + accel * dt, 0.0)
    travelled = 0.5 * (agents.speed + speed) * dt
    moved = agents.replace(
        speed=speed,
        accel=(speed - agents.speed) / dt,
        lane_s=agents.lane_s + travelled,
        wait_s=jnp.where(speed < 0.1, agents.wait_s + dt, 0.0),
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


def accelerations(
    agents: Agents,
    stop: StopAhead,
    movers: Mover,
    ego: EgoState,
    ego_length: jax.Array,
    road_map: RoadMap,
    params: IDMParams,
) -> jax.Array:
    """(N,) m/s^2: the hardest braking that any leader, line or junction asks for.

    The lawless mind only who is ahead of them in their lane, the ego not even there.
    """
    desired = desired_speed(agents, road_map)
    drivers = vehicles.driver(agents.model, params)
    gap, leader_speed = leaders(agents, movers, road_map)
    change_gap, change_speed = lane_shift.leaders(agents, movers, road_map)
    minds = ~agents.is_lawless
    ego_gap = jnp.where(minds, corridor_gap(agents, ego, ego_length), FAR)
    line = jnp.where(minds & must_stop(agents, stop), stop.distance - STOP_MARGIN, FAR)
    waits = minds & gated(agents, movers, road_map)
    gate = jnp.where(waits, movers.entry[:-1] - STOP_MARGIN, FAR)
    lane_end = road_map.lane_end[planned_lane(agents, 0)] - agents.lane_s - 0.5 * agents.length
    dead_end = jnp.where(agents.lanes[:, 1] < 0, lane_end - STOP_MARGIN, FAR)
    still = jnp.minimum(jnp.minimum(line, gate), dead_end)

    def respond(gap: jax.Array, leader_speed: jax.Array) -> jax.Array:
        return idm.acceleration(agents.speed, gap, leader_speed, desired, drivers)

    accel = jnp.minimum(respond(gap, leader_speed), respond(change_gap, change_speed))
    accel = jnp.minimum(accel, respond(ego_gap, ego.speed))
    accel = jnp.minimum(accel, respond(still, jnp.zeros_like(still)))
    accel = jnp.where(agents.is_braking_hard, -params.brake_max, accel)
    return jnp.where(agents.valid, accel, 0.0)


def desired_speed(agents: Agents, road_map: RoadMap) -> jax.Array:
    """(N,) m/s: the limit or what a scenario asks, slower in bends and early enough before them."""
    lane, following = planned_lane(agents, 0), planned_lane(agents, 1)
    cap = vehicles.speed_cap(agents.model)
    cap = jnp.where(agents.cruise_speed > 0.0, agents.cruise_speed, cap)
    limit = jnp.minimum(road_map.lane_speed_limit[lane] * agents.desired_speed_frac, cap)
    here = jnp.minimum(limit, road_map.lane_curve_speed[lane])
    there = jnp.minimum(
        road_map.lane_speed_limit[following] * agents.desired_speed_frac,
        road_map.lane_curve_speed[following],
    )
    left = jnp.maximum(road_map.lane_length[lane] - agents.lane_s, 0.0)
    legal = jnp.maximum(jnp.minimum(here, jnp.sqrt(there**2 + 2 * CURVE_BRAKING * left)), 1.0)
    is_scripted = agents.is_lawless & (agents.cruise_speed > 0.0)
    return jnp.where(is_scripted, agents.cruise_speed, legal)


def leaders(agents: Agents, movers: Mover, road_map: RoadMap) -> tuple[jax.Array, jax.Array]:
    """Bumper gap to, and speed of, the nearest car ahead on each agent's plan: (N,) m, (N,) m/s."""
    lanes = agents.lanes[:, :, None]  # (N, 3, 1)
    lengths = road_map.lane_length[jnp.maximum(agents.lanes, 0)]
    to_next = (lengths[:, 0] - agents.lane_s)[:, None]
    to_third = to_next + lengths[:, 1, None]
    other, other_s = movers.lane[None, :], movers.s[None, :]  # (1, N + 1)
    ahead = other_s - agents.lane_s[:, None]
    fork = road_map.lane_fork[jnp.maximum(agents.lanes[:, :2], 0)][:, :, None]
    other_fork = road_map.lane_fork[jnp.maximum(movers.lane, 0)][None, :]
    parting = other_s < FORK_LENGTH
    ours = (agents.lane_s < FORK_LENGTH)[:, None]
    same = (other == lanes[:, 0]) | ((other_fork == fork[:, 0]) & parting & ours)
    on_next = (other == lanes[:, 1]) | ((other_fork == fork[:, 1]) & parting & (lanes[:, 1] >= 0))
    gap = jnp.where(same & (ahead > 0.0), ahead, FAR)
    gap = jnp.minimum(gap, jnp.where(on_next, to_next + other_s, FAR))
    gap = jnp.minimum(gap, jnp.where(other == lanes[:, 2], to_third + other_s, FAR))
    is_ego = (jnp.arange(movers.lane.shape[0]) == movers.lane.shape[0] - 1)[None, :]
    seen = (other >= 0) & ~(is_ego & agents.is_lawless[:, None])
    gap = jnp.where(seen & (gap > 0.0), gap - movers.half_length[None, :], FAR)
    nearest = gap.min(axis=1)
    # No search by index, which would cost more than all of the above.
    speed = jnp.where(gap == nearest[:, None], movers.speed, 0.0).max(axis=1)
    return nearest - 0.5 * agents.length, speed


def corridor_gap(agents: Agents, ego: EgoState, ego_length: jax.Array) -> jax.Array:
    """(N,) m, bumper gap to an ego that stands or drives across an agent's way, off its own lane.

    Looks straight ahead as far as the agent can stop.
    """
    at = geometry.to_frame(ego.xy[None, :], agents.xy, agents.yaw)
    half = 0.5 * (agents.length + ego_length)
    # The ego's half extent across the agent's way, whatever its direction.
    across = 0.5 * ego_length * jnp.abs(jnp.sin(ego.yaw - agents.yaw)) + 0.5 * agents.width + 0.9
    reach = half + 4.0 + agents.speed**2 / (2 * BRAKING)
    in_way = (at[:, 0] > 0.0) & (at[:, 0] < reach) & (jnp.abs(at[:, 1]) < across)
    return jnp.where(in_way, at[:, 0] - half, FAR)


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
