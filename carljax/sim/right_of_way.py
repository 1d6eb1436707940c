"""Stop lines: lights and signs; and what drivers see of one another."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from carljax.sim import lights
from carljax.sim.road_map import RoadMap
from carljax.sim.types import (
    LIGHT_GREEN,
    LIGHT_RED,
    STOP_LIGHT,
    STOP_SIGN,
    Agents,
    EgoState,
    LightClock,
)

FAR = 1e3  # m, a gap that changes nothing
BRAKING = 3.0  # m/s^2 at which a driver still stops for yellow. source: ours, a firm stop
CLEARED = 0.3  # s of yellow that are left when the line is passed. source: ours
QUEUED, SETTING_OFF = 1.0, 0.3  # m/s, m/s^2, less of both is standing in a queue. source: ours
SETS_OFF = 1.5  # m/s^2 of a car that goes at yellow. source: ours


class Mover(struct.PyTreeNode):
    """What others see of a car: agents and, as the last row, the ego; all (N + 1,).

    Attributes:
      lane, next_lane: int32 rows of the lane table; -1 where there is none.
      s: m along its lane.
      entry: m from its front bumper to the end of its lane.
      speed: m/s.
      half_length: m.
      can_go: bool, no red light or unmet stop sign keeps it from `next_lane`.
      is_queued: bool, stands and doesn't set off.
    """

    lane: jax.Array
    next_lane: jax.Array
    s: jax.Array
    entry: jax.Array
    speed: jax.Array
    half_length: jax.Array
    can_go: jax.Array
    is_queued: jax.Array


class EgoPlace(struct.PyTreeNode):
    """Where the ego is on the lane graph: lane, next_lane () int32 (-1 unknown), s () m."""

    lane: jax.Array
    next_lane: jax.Array
    s: jax.Array


class StopAhead(struct.PyTreeNode):
    """The next stop line of each agent, (N,).

    Attributes:
      distance: m from its front bumper.
      kind: int32 STOP_*.
      light: int32 LIGHT_*, LIGHT_GREEN where there is no light.
      yellow_left: s until the light turns red, if it is yellow.
    """

    distance: jax.Array
    kind: jax.Array
    light: jax.Array
    yellow_left: jax.Array


class Ahead(struct.PyTreeNode):
    """The plan of each agent, (N, 3).

    Attributes:
      lane: int32, its lanes; row 0 where the plan has ended.
      exists: bool.
      begin: m from its middle to the beginning of each; negative for the lane it is on.
      length: m.
      in_junction: bool, False where the plan has ended.
    """

    lane: jax.Array
    exists: jax.Array
    begin: jax.Array
    length: jax.Array
    in_junction: jax.Array


def ahead_of(agents: Agents, road_map: RoadMap) -> Ahead:
    """Lays the lanes of each agent's plan one behind the other."""
    exists = agents.lanes >= 0
    lane = jnp.maximum(agents.lanes, 0)
    length = road_map.lane_length[lane]
    first = length[:, 0] - agents.lane_s
    begin = jnp.stack([-agents.lane_s, first, first + length[:, 1]], axis=1)
    return Ahead(lane, exists, begin, length, road_map.lane_in_junction[lane] & exists)


def planned_lane(agents: Agents, number: int) -> jax.Array:
    """A lane of the plan, the current one where the plan has ended."""
    lane = agents.lanes[:, number]
    return jnp.where(lane >= 0, lane, jnp.maximum(agents.lanes[:, 0], 0))


def all_movers(
    agents: Agents,
    stop: StopAhead,
    ego: EgoState,
    ego_length: jax.Array,
    ego_place: EgoPlace,
    road_map: RoadMap,
    clock: LightClock,
) -> Mover:
    """Lists what drivers see of one another: the agents and, last, the ego.

    Nobody waits for an ego that a red light keeps from entering, unless it is too fast to stop.
    """
    lane = planned_lane(agents, 0)
    valid = agents.valid
    half = 0.5 * agents.length
    ego_half = 0.5 * ego_length
    ego_left = road_map.lane_length[jnp.maximum(ego_place.lane, 0)] - ego_place.s
    held = must_stop(agents, stop) & ~agents.is_lawless
    ego_lanes = jnp.stack([ego_place.lane, ego_place.next_lane])
    ego_begin = jnp.stack([-ego_place.s, ego_left]) - ego_half
    ego_stop = _first_line(jnp.maximum(ego_lanes, 0), ego_lanes >= 0, ego_begin, road_map, clock)
    room = ego_stop.distance > ego.speed**2 / (2 * BRAKING)
    ego_held = (ego_stop.kind == STOP_LIGHT) & (ego_stop.light != LIGHT_GREEN) & room

    def with_ego(values: jax.Array, of_ego: jax.Array) -> jax.Array:
        return jnp.append(values, of_ego.astype(values.dtype))

    return Mover(
        lane=with_ego(jnp.where(valid, agents.lanes[:, 0], -1), ego_place.lane),
        next_lane=with_ego(jnp.where(valid, agents.lanes[:, 1], -1), ego_place.next_lane),
        s=with_ego(agents.lane_s, ego_place.s),
        entry=with_ego(road_map.lane_length[lane] - agents.lane_s - half, ego_left - ego_half),
        speed=with_ego(agents.speed, ego.speed),
        half_length=with_ego(half, ego_half),
        can_go=with_ego(~held, ~ego_held),
        is_queued=with_ego(
            (agents.speed < QUEUED) & (agents.accel < SETTING_OFF),
            (ego.speed < QUEUED) & (ego.accel < SETTING_OFF),
        ),
    )


def stop_ahead(agents: Agents, road_map: RoadMap, clock: LightClock) -> StopAhead:
    """The first stop line ahead on the lanes of an agent's plan."""
    plan = ahead_of(agents, road_map)
    front = 0.5 * agents.length[:, None]
    return _first_line(plan.lane, plan.exists, plan.begin - front, road_map, clock)


def _first_line(
    lane: jax.Array, exists: jax.Array, begin: jax.Array, road_map: RoadMap, clock: LightClock
) -> StopAhead:
    """The stop line ahead of front bumpers on lanes (..., n) that begin so many metres ahead."""
    distance = begin + road_map.lane_stop_s[lane]
    holds = exists & (road_map.lane_stop_kind[lane] > 0) & (distance > -0.5)
    first = jnp.argmax(holds, axis=-1)[..., None]

    def pick(values: jax.Array) -> jax.Array:
        return jnp.take_along_axis(values, first, axis=-1)[..., 0]

    holds, governing = pick(holds), pick(lane)
    light = road_map.lane_light[governing]
    has_light = holds & (light >= 0)
    light = jnp.maximum(light, 0)
    return StopAhead(
        distance=jnp.where(holds, pick(distance), FAR),
        kind=jnp.where(holds, road_map.lane_stop_kind[governing], 0),
        light=jnp.where(has_light, lights.colour(light, clock, road_map), LIGHT_GREEN),
        yellow_left=lights.yellow_left_of(light, clock, road_map),
    )


def must_stop(agents: Agents, stop: StopAhead) -> jax.Array:
    """(N,) bool: a red light, a yellow one with room to stop, or a stop sign not yet honoured.

    Whoever waited through the green for a gap goes at yellow: else a turn across a stream of
    oncoming traffic is never made. Nobody goes who would pass the line too late.
    """
    room = stop.distance > agents.speed**2 / (2 * BRAKING)
    drives = jnp.sqrt(agents.speed**2 + 2 * SETS_OFF * jnp.maximum(stop.distance, 0.0))
    late = (drives - agents.speed) / SETS_OFF > stop.yellow_left - CLEARED
    stops_at_yellow = (stop.light != LIGHT_GREEN) & ((room & ~agents.has_stopped) | late)
    red = (stop.kind == STOP_LIGHT) & ((stop.light == LIGHT_RED) | stops_at_yellow)
    sign = (stop.kind == STOP_SIGN) & ~agents.has_stopped
    return (red | sign) & (stop.distance > -0.5)


def has_stopped(agents: Agents, stop: StopAhead, speed: jax.Array) -> jax.Array:
    """(N,) bool: halted at the sign, or at the green light, ahead.

    Forgotten once the line is passed, and when the light turns red.
    """
    halts = speed < 0.2
    at_sign = (stop.kind == STOP_SIGN) & (agents.has_stopped | halts)
    waits = halts & (stop.light == LIGHT_GREEN)
    at_light = (stop.kind == STOP_LIGHT) & (agents.has_stopped | waits)
    return (at_sign | (at_light & (stop.light != LIGHT_RED))) & (stop.distance < 4.0)
