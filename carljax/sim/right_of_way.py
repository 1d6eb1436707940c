"""Right of way: stop lines, lights, stop signs, and who enters a junction first."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from carljax.sim import lights
from carljax.sim.junctions import CONFLICT, CONFLICT_YIELD, FREE
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

BRAKING = 3.0  # m/s^2 at which a driver still stops for yellow. source: ours, a firm stop
GATE_RANGE = 40.0  # m before a junction at which others are looked at. source: ours
GAP_TIME = 4.0  # s of gap taken in traffic that has priority. source: HCM critical gaps, 4 to 7 s
PATIENCE = (
    8.0  # s at rest after which nobody waits for a car that doesn't move itself. source: ours
)


class Mover(struct.PyTreeNode):
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
    """

    distance: jax.Array
    kind: jax.Array
    light: jax.Array


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
    ego_stop = _next_line(
        jnp.maximum(ego_place.lane, 0),
        ego_place.next_lane,
        ego_place.s + ego_half,
        road_map,
        clock,
    )
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
    )


def stop_ahead(agents: Agents, road_map: RoadMap, clock: LightClock) -> StopAhead:
    """The stop line on the lane an agent is on or on the one it will take next."""
    front = agents.lane_s + 0.5 * agents.length
    return _next_line(planned_lane(agents, 0), agents.lanes[:, 1], front, road_map, clock)


def _next_line(
    lane: jax.Array, next_lane: jax.Array, front: jax.Array, road_map: RoadMap, clock: LightClock
) -> StopAhead:
    """The stop line ahead of a front bumper at arc length `front`; next_lane may be -1."""
    following = jnp.where(next_lane >= 0, next_lane, lane)
    here = road_map.lane_stop_s[lane] - front
    there = road_map.lane_length[lane] + road_map.lane_stop_s[following] - front
    ahead = (road_map.lane_stop_kind[lane] > 0) & (here > -0.5)
    kind_there = jnp.where(next_lane >= 0, road_map.lane_stop_kind[following], 0)
    governing = jnp.where(ahead, lane, following)
    light = jnp.maximum(road_map.lane_light[governing], 0)
    colour = lights.colour(light, clock, road_map)
    return StopAhead(
        distance=jnp.where(ahead, here, there),
        kind=jnp.where(ahead, road_map.lane_stop_kind[lane], kind_there),
        light=jnp.where(road_map.lane_light[governing] >= 0, colour, LIGHT_GREEN),
    )


def must_stop(agents: Agents, stop: StopAhead) -> jax.Array:
    """(N,) bool: a red light, a yellow one with room to stop, or a stop sign not yet honoured.

    Whoever waited through the green for a gap goes at yellow: else a turn across a stream of
    oncoming traffic is never made.
    """
    room = stop.distance > agents.speed**2 / (2 * BRAKING)
    stops_at_yellow = (stop.light != LIGHT_GREEN) & room & ~agents.has_stopped
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


def gated(agents: Agents, movers: Mover, road_map: RoadMap) -> jax.Array:
    """(N,) bool: others go first into the junction that an agent is about to enter.

    Nobody enters while a conflicting lane is occupied or while another car's front is on its way
    into it. Whoever has priority and is near goes first; among equals, whoever arrives first.
    """
    following = planned_lane(agents, 1)
    entry = movers.entry[:-1]
    enters = road_map.lane_in_junction[following] & (agents.lanes[:, 1] >= 0)
    enters &= (entry > -1.0) & (entry < GATE_RANGE)
    owes_inside = _owes(following, movers.lane, road_map)
    owes = _owes(following, movers.next_lane, road_map)
    arrival = jnp.maximum(movers.entry, 0.0) / jnp.maximum(movers.speed, 2.0)
    coming = movers.can_go & (arrival < GAP_TIME)
    entering = (movers.entry <= -1.0)[None, :]  # its centre, and so its lane, will follow
    order = jnp.arange(movers.lane.shape[0])
    mine, mine_order = arrival[:-1, None], order[:-1, None]
    earlier = (arrival[None, :] < mine) | ((arrival[None, :] == mine) & (order < mine_order))
    # Two that wait for one another would wait for ever.
    stuck = (agents.wait_s > PATIENCE)[:, None] & (movers.speed < 0.5)[None, :]
    waits = (owes == CONFLICT_YIELD) | ((owes == CONFLICT) & earlier)
    waits |= (owes != FREE) & entering
    waits &= coming[None, :] & ~stuck
    return enters & ((owes_inside != FREE) | waits).any(axis=1)


def _owes(lane: jax.Array, other: jax.Array, road_map: RoadMap) -> jax.Array:
    """(N, N + 1) uint8: what each agent's lane owes the lane of every other car."""
    seen = jnp.maximum(other, 0)
    same = road_map.lane_junction[lane][:, None] == road_map.lane_junction[seen][None, :]
    same &= (other >= 0)[None, :] & road_map.lane_in_junction[lane][:, None]
    owes = road_map.lane_conflict[lane[:, None], road_map.lane_slot[seen][None, :]]
    return jnp.where(same, owes, jnp.uint8(FREE))
