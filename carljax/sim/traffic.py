"""Traffic on lanes: IDM behind leaders, at red lights, stop signs and in junctions.

An agent is a lane, an arc length and a plan of the next two lanes. Everything it reacts to is a gap along
that plan: the car ahead (also across lane boundaries), the stop line of a light that is not green, a stop
sign at which it has not yet halted, and the entry of a junction in which others go first. It takes the
hardest braking of all. The ego is one more car to them.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from carljax.sim import geometry, idm, lights
from carljax.sim.idm import IDMParams
from carljax.sim.junctions import CONFLICT, CONFLICT_YIELD, FREE
from carljax.sim.road_map import RoadMap, pose_at
from carljax.sim.types import (
    KIND_VEHICLE,
    LIGHT_GREEN,
    LIGHT_RED,
    STOP_LIGHT,
    STOP_SIGN,
    Agents,
    EgoState,
)

FAR = 1e3  # m, a gap that changes nothing
FORK_LENGTH = 9.0  # m in which lanes that part still overlap. source: ours, car length + width
BRAKING = 3.0  # m/s^2 at which a driver still stops for yellow. source: ours
CURVE_BRAKING = 1.5  # m/s^2 towards a bend. source: ours
MAX_BRAKING = 8.0  # m/s^2. source: carl-facts 13, full brake is 7 to 8
STOP_MARGIN = 1.0  # m kept to a stop line
GATE_RANGE = 40.0  # m before a junction at which others are looked at
GAP_TIME = 4.0  # s of gap taken in traffic that has priority. source: HCM critical gaps, 4 to 7 s
PATIENCE = 8.0  # s at rest after which nobody waits for a car that doesn't move itself


@struct.dataclass
class Mover:
    """What others see of a car: agents and, as the last row, the ego; all (N + 1,).

    Attributes:
      lane, next_lane: int32 rows of the lane table; -1 where there is none.
      s: m along its lane.
      entry: m from its front bumper to the end of its lane.
      speed: m/s.
      half_length: m.
      can_go: bool, no red light or unmet stop sign keeps it from `next_lane`.
    """

    lane: jax.Array
    next_lane: jax.Array
    s: jax.Array
    entry: jax.Array
    speed: jax.Array
    half_length: jax.Array
    can_go: jax.Array


@struct.dataclass
class EgoPlace:
    """Where the ego is on the lane graph: lane, next_lane () int32 (-1 unknown), s () m."""

    lane: jax.Array
    next_lane: jax.Array
    s: jax.Array


@struct.dataclass
class StopAhead:
    """The next stop line of each agent: distance (N,) m from its front bumper, kind (N,), light (N,)."""

    distance: jax.Array
    kind: jax.Array
    light: jax.Array


def step(
    agents: Agents,
    ego: EgoState,
    ego_length: jax.Array,
    ego_place: EgoPlace,
    road_map: RoadMap,
    light_time: jax.Array,
    key: jax.Array,
    params: IDMParams,
    dt: float,
) -> Agents:
    """Moves all agents by one step.

    Args:
      agents: (N,) agents.
      ego: the ego before its own step.
      ego_length: () m.
      ego_place: its place on the lane graph.
      road_map: the map.
      light_time: () s.
      key: PRNG key, for the choice of lanes.
      params: of the driver model.
      dt: s.

    Returns:
      The agents dt later.
    """
    stop = stop_ahead(agents, road_map, light_time)
    movers = _movers(agents, stop, ego, ego_length, ego_place, road_map)
    accel = accelerations(agents, stop, movers, ego, ego_length, road_map, params)
    speed = jnp.maximum(agents.speed + accel * dt, 0.0)
    travelled = 0.5 * (agents.speed + speed) * dt
    moved = agents.replace(
        speed=speed,
        accel=(speed - agents.speed) / dt,
        lane_s=agents.lane_s + travelled,
        wait_s=jnp.where(speed < 0.1, agents.wait_s + dt, 0.0),
        has_stopped=_has_stopped(agents, stop, speed),
    )
    return place(_follow_plan(moved, road_map, key), road_map)


def place(agents: Agents, road_map: RoadMap) -> Agents:
    """Fills in xy, z, yaw and yaw rate from lane and arc length."""
    pose = pose_at(road_map, jnp.maximum(agents.lanes[:, 0], 0), agents.lane_s)
    return agents.replace(
        xy=pose.xy, z=pose.z, yaw=pose.yaw, yaw_rate=agents.speed * pose.curvature
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
    """(N,) m/s^2: the hardest braking that any leader, line or junction asks for."""
    desired = desired_speed(agents, road_map)
    gap, leader_speed = leaders(agents, movers, road_map)
    ego_gap = corridor_gap(agents, ego, ego_length)
    line = jnp.where(_must_stop(agents, stop), stop.distance - STOP_MARGIN, FAR)
    gate = jnp.where(gated(agents, movers, road_map), movers.entry[:-1] - STOP_MARGIN, FAR)
    still = jnp.minimum(line, gate)

    def respond(gap: jax.Array, leader_speed: jax.Array) -> jax.Array:
        return idm.acceleration(agents.speed, gap, leader_speed, desired, params)

    accel = jnp.minimum(respond(gap, leader_speed), respond(ego_gap, ego.speed))
    accel = jnp.minimum(accel, respond(still, jnp.zeros_like(still)))
    return jnp.where(agents.valid, jnp.clip(accel, -MAX_BRAKING, None), 0.0)


def desired_speed(agents: Agents, road_map: RoadMap) -> jax.Array:
    """(N,) m/s: the limit, slower in bends and early enough before them."""
    lane, following = _lane(agents, 0), _lane(agents, 1)
    limit = road_map.lane_speed_limit[lane] * agents.desired_speed_frac
    here = jnp.minimum(limit, road_map.lane_curve_speed[lane])
    there = jnp.minimum(
        road_map.lane_speed_limit[following] * agents.desired_speed_frac,
        road_map.lane_curve_speed[following],
    )
    left = jnp.maximum(road_map.lane_length[lane] - agents.lane_s, 0.0)
    return jnp.maximum(jnp.minimum(here, jnp.sqrt(there**2 + 2 * CURVE_BRAKING * left)), 1.0)


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
    gap = jnp.where((other >= 0) & (gap > 0.0), gap - movers.half_length[None, :], FAR)
    first = jnp.argmin(gap, axis=1)
    nearest = jnp.take_along_axis(gap, first[:, None], axis=1)[:, 0]
    return nearest - 0.5 * agents.length, movers.speed[first]


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


def stop_ahead(agents: Agents, road_map: RoadMap, light_time: jax.Array) -> StopAhead:
    """The stop line on the lane an agent is on or on the one it will take next."""
    lane, following = _lane(agents, 0), _lane(agents, 1)
    front = agents.lane_s + 0.5 * agents.length
    here = road_map.lane_stop_s[lane] - front
    there = road_map.lane_length[lane] + road_map.lane_stop_s[following] - front
    ahead = (road_map.lane_stop_kind[lane] > 0) & (here > -0.5)
    kind_there = jnp.where(agents.lanes[:, 1] >= 0, road_map.lane_stop_kind[following], 0)
    governing = jnp.where(ahead, lane, following)
    light = jnp.maximum(road_map.lane_light[governing], 0)
    colour = lights.state(light_time, road_map.light_start[light], road_map.light_cycle[light])
    return StopAhead(
        distance=jnp.where(ahead, here, there),
        kind=jnp.where(ahead, road_map.lane_stop_kind[lane], kind_there),
        light=jnp.where(road_map.lane_light[governing] >= 0, colour, LIGHT_GREEN),
    )


def gated(agents: Agents, movers: Mover, road_map: RoadMap) -> jax.Array:
    """(N,) bool: others go first into the junction that an agent is about to enter.

    Nobody enters while a conflicting lane is occupied. Whoever has priority and is near goes first;
    among equals, whoever arrives first.
    """
    following = _lane(agents, 1)
    entry = movers.entry[:-1]
    enters = road_map.lane_in_junction[following] & (agents.lanes[:, 1] >= 0)
    enters &= (entry > -1.0) & (entry < GATE_RANGE)
    owes_inside = _owes(following, movers.lane, road_map)
    owes = _owes(following, movers.next_lane, road_map)
    arrival = jnp.maximum(movers.entry, 0.0) / jnp.maximum(movers.speed, 2.0)
    coming = movers.can_go & (arrival < GAP_TIME) & (movers.entry > -1.0)
    order = jnp.arange(movers.lane.shape[0])
    mine, mine_order = arrival[:-1, None], order[:-1, None]
    earlier = (arrival[None, :] < mine) | ((arrival[None, :] == mine) & (order < mine_order))
    # Two that wait for one another would wait for ever.
    stuck = (agents.wait_s > PATIENCE)[:, None] & (movers.speed < 0.5)[None, :]
    waits = (owes == CONFLICT_YIELD) | ((owes == CONFLICT) & earlier)
    waits &= coming[None, :] & ~stuck
    return enters & ((owes_inside != FREE) | waits).any(axis=1)


def _owes(lane: jax.Array, other: jax.Array, road_map: RoadMap) -> jax.Array:
    """(N, N + 1) uint8: what each agent's lane owes the lane of every other car."""
    seen = jnp.maximum(other, 0)
    same = road_map.lane_junction[lane][:, None] == road_map.lane_junction[seen][None, :]
    same &= (other >= 0)[None, :] & road_map.lane_in_junction[lane][:, None]
    owes = road_map.lane_conflict[lane[:, None], road_map.lane_slot[seen][None, :]]
    return jnp.where(same, owes, jnp.uint8(FREE))


def _lane(agents: Agents, number: int) -> jax.Array:
    """A lane of the plan, the current one where the plan has ended."""
    lane = agents.lanes[:, number]
    return jnp.where(lane >= 0, lane, jnp.maximum(agents.lanes[:, 0], 0))


def _movers(
    agents: Agents,
    stop: StopAhead,
    ego: EgoState,
    ego_length: jax.Array,
    ego_place: EgoPlace,
    road_map: RoadMap,
) -> Mover:
    lane = _lane(agents, 0)
    valid = agents.valid
    half = 0.5 * agents.length
    ego_half = 0.5 * ego_length
    ego_left = road_map.lane_length[jnp.maximum(ego_place.lane, 0)] - ego_place.s
    held = _must_stop(agents, stop)

    def with_ego(values: jax.Array, of_ego: jax.Array) -> jax.Array:
        return jnp.append(values, of_ego.astype(values.dtype))

    return Mover(
        lane=with_ego(jnp.where(valid, agents.lanes[:, 0], -1), ego_place.lane),
        next_lane=with_ego(jnp.where(valid, agents.lanes[:, 1], -1), ego_place.next_lane),
        s=with_ego(agents.lane_s, ego_place.s),
        entry=with_ego(road_map.lane_length[lane] - agents.lane_s - half, ego_left - ego_half),
        speed=with_ego(agents.speed, ego.speed),
        half_length=with_ego(half, ego_half),
        can_go=with_ego(~held, jnp.ones((), bool)),
    )


def _must_stop(agents: Agents, stop: StopAhead) -> jax.Array:
    """(N,) bool: a light that is red, or yellow with room to stop, or a stop sign not yet honoured."""
    room = stop.distance > agents.speed**2 / (2 * BRAKING)
    not_green = (stop.light == LIGHT_RED) | ((stop.light != LIGHT_GREEN) & room)
    red = (stop.kind == STOP_LIGHT) & not_green
    sign = (stop.kind == STOP_SIGN) & ~agents.has_stopped
    return (red | sign) & (stop.distance > -0.5)


def _has_stopped(agents: Agents, stop: StopAhead, speed: jax.Array) -> jax.Array:
    """(N,) bool: halted at the sign ahead; forgotten once the line is passed."""
    near = (stop.kind == STOP_SIGN) & (stop.distance < 4.0)
    return near & (agents.has_stopped | (speed < 0.2))


def _follow_plan(agents: Agents, road_map: RoadMap, key: jax.Array) -> Agents:
    """Moves on to the next lane of the plan where the current one ends, and extends the plan."""
    keys = jax.random.split(key, 2)
    for key_choice in keys:  # twice: very short lanes are passed within one step
        length = road_map.lane_length[_lane(agents, 0)]
        over = (agents.lane_s > length) & (agents.lanes[:, 1] >= 0)
        drawn = next_lane(agents.lanes[:, 2], road_map, key_choice)
        onward = jnp.stack([agents.lanes[:, 1], agents.lanes[:, 2], drawn], axis=1)
        agents = agents.replace(
            lanes=jnp.where(over[:, None], onward, agents.lanes),
            lane_s=jnp.where(over, agents.lane_s - length, agents.lane_s),
        )
    return agents


def next_lane(lane: jax.Array, road_map: RoadMap, key: jax.Array) -> jax.Array:
    """(N,) int32, a successor of each lane drawn uniformly; -1 after a dead end."""
    successors = road_map.lane_successors[jnp.maximum(lane, 0)]
    count = (successors >= 0).sum(axis=1)
    drawn = jax.random.randint(key, lane.shape, 0, 1 << 16) % jnp.maximum(count, 1)
    chosen = jnp.take_along_axis(successors, drawn[:, None], axis=1)[:, 0]
    return jnp.where((lane >= 0) & (count > 0), chosen, -1)


def plan(lane: jax.Array, road_map: RoadMap, key: jax.Array) -> jax.Array:
    """(N, 3) int32, a plan that begins with the given lanes."""
    key_second, key_third = jax.random.split(key)
    second = next_lane(lane, road_map, key_second)
    return jnp.stack([lane, second, next_lane(second, road_map, key_third)], axis=1)


VIEW_FRONT, VIEW_BACK, VIEW_SIDE = 80.0, 52.0, 66.0  # m, just beyond CaRL's image
GONE = 150.0  # m from the ego, beyond which an agent is used again
SPAWN_GAP = 14.0  # m kept to other cars
CELL_KEYS = 4


def respawn(
    agents: Agents,
    ego: EgoState,
    town: jax.Array,
    road_map: RoadMap,
    key: jax.Array,
    cell_size: float,
) -> Agents:
    """Moves at most one far-away agent to a free place near the ego but out of its sight.

    Args:
      agents: (N,) agents.
      ego: the ego.
      town: () int32.
      road_map: the map.
      key: PRNG key.
      cell_size: m, of the respawn grid.

    Returns:
      The agents; the moved one has a new plan and the speed of its lane.
    """
    key_place, key_plan = jax.random.split(key)
    lane, s = _respawn_place(ego, town, road_map, key_place, cell_size)
    pose = pose_at(road_map, jnp.maximum(lane, 0), s)
    seen = geometry.to_frame(pose.xy, ego.xy, ego.yaw)
    hidden = (seen[0] > VIEW_FRONT) | (seen[0] < -VIEW_BACK) | (jnp.abs(seen[1]) > VIEW_SIDE)
    offset = agents.xy - pose.xy
    clear = (~agents.valid | ((offset**2).sum(axis=1) > SPAWN_GAP**2)).all()
    away = ((agents.xy - ego.xy) ** 2).sum(axis=1)
    ended = (agents.lanes[:, 1] < 0) & _at_end(agents, road_map)
    relative = geometry.to_frame(agents.xy, ego.xy, ego.yaw)
    unseen = (
        (relative[:, 0] > VIEW_FRONT) | (relative[:, 0] < -VIEW_BACK)
    ) | (jnp.abs(relative[:, 1]) > VIEW_SIDE)
    gone = agents.valid & ((away > GONE**2) | (ended & unseen))
    chosen = jnp.argmax(jnp.where(gone, away + 1.0, 0.0))
    moves = (jnp.arange(gone.shape[0]) == chosen) & gone & hidden & clear & (lane >= 0)
    lanes = plan(jnp.maximum(lane, 0)[None], road_map, key_plan)
    limit = jnp.minimum(
        road_map.lane_speed_limit[lanes[0, 0]], road_map.lane_curve_speed[lanes[0, 0]]
    )
    # No faster than can be stopped within the gap that was checked.
    speed = jnp.minimum(0.8 * limit, jnp.sqrt(2 * BRAKING * (SPAWN_GAP - 6.0)))
    return place(
        agents.replace(
            lanes=jnp.where(moves[:, None], lanes, agents.lanes),
            lane_s=jnp.where(moves, s, agents.lane_s),
            speed=jnp.where(moves, speed, agents.speed),
            accel=jnp.where(moves, 0.0, agents.accel),
            wait_s=jnp.where(moves, 0.0, agents.wait_s),
            has_stopped=agents.has_stopped & ~moves,
        ),
        road_map,
    )


def _at_end(agents: Agents, road_map: RoadMap) -> jax.Array:
    return agents.lane_s > road_map.lane_length[_lane(agents, 0)] - 8.0


def _respawn_place(
    ego: EgoState, town: jax.Array, road_map: RoadMap, key: jax.Array, cell_size: float
) -> tuple[jax.Array, jax.Array]:
    """One of the places listed for the ego's grid cell: lane () int32 (-1: none), s () m."""
    _, rows, columns, candidates = road_map.spawn_lane.shape
    cell = ((ego.xy - road_map.origin[town]) / cell_size).astype(jnp.int32)
    column, row = jnp.clip(cell[0], 0, columns - 1), jnp.clip(cell[1], 0, rows - 1)
    pick = jax.random.randint(key, (), 0, candidates)
    return road_map.spawn_lane[town, row, column, pick], road_map.spawn_s[town, row, column, pick]


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
    key_plan, key_size, key_temper = jax.random.split(key, 3)
    num = lane.shape[0]
    size = jax.random.uniform(key_size, (num, 2))
    temper = jax.random.uniform(key_temper, (num,), minval=0.7, maxval=1.1)
    zeros = jnp.zeros(num, jnp.float32)
    agents = Agents(
        xy=jnp.zeros((num, 2), jnp.float32),
        z=zeros,
        yaw=zeros,
        speed=jnp.where(lane >= 0, speed, 0.0),
        yaw_rate=zeros,
        accel=zeros,
        # From a small car to a van. source: spread of CARLA's car blueprints, 3.6 to 5.4 m by 1.8 to 2.2 m
        length=3.6 + 1.8 * size[:, 0],
        width=1.8 + 0.4 * size[:, 1],
        kind=jnp.where(lane >= 0, KIND_VEHICLE, 0).astype(jnp.int32),
        lanes=plan(lane, road_map, key_plan),
        lane_s=s,
        desired_speed_frac=temper,
        has_stopped=jnp.zeros(num, bool),
        wait_s=zeros,
    )
    return place(agents, road_map)
