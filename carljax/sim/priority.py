"""Where lanes meet: who goes first, and whom to follow from one lane to the other.

For each two lanes of a junction it is known where on either the other one is too near
(`junctions`). A car that comes to a junction compares when it would be on such a stretch with when
others would be on theirs, and waits at the junction's entry if it has to give way. In the junction
it stops before a stretch on which another stands, and follows those with whom its lane begins or
ends. Nobody enters who could not leave again.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from flax import struct

from carljax.sim import order
from carljax.sim.cars_ahead import CarsAhead
from carljax.sim.junctions import (
    CONFLICT,
    CONFLICT_YIELD,
    FORK,
    FREE,
    MEETING_MASK,
    MEETING_STEPS,
    MERGE,
)
from carljax.sim.once import once
from carljax.sim.right_of_way import BRAKING, Mover, ahead_of
from carljax.sim.road_map import RoadMap
from carljax.sim.types import Agents

FAR = 1e3  # m, a gap that changes nothing
NOTICE = 12.0  # m, and the way to stop gently: from there on a junction is looked at. source: ours
GENTLE_BRAKING = 2.0  # m/s^2. source: ours
ENTERED = 1.0  # m into the junction from which on a car will not wait at its entry. source: ours
ACCEL = 1.5  # m/s^2 at which others, and the car itself, are taken to drive off. source: ours
SLOWEST = 1.0  # m/s of others that are taken to go on. source: ours
MARGIN = 1.2  # s between two cars at one place. source: ours
LEAST_MARGIN = 0.3  # s, after long waits. source: ours
PATIENCE = 8.0  # s at rest after which nobody waits for a car that doesn't move. source: ours
FOLLOWS = 0.5  # s of headway given to a car before which an agent joins. source: ours
SHORT = 12.0  # m; nobody waits for room on shorter lanes, such as in roundabouts. source: ours
ROOM_GAP = 2.0  # m kept to it at rest. source: IDM's gap at rest
# Of many cars each agent looks at the NEAREST of its own junction alone. source: ours; of 256 cars
# in the training towns, up to 80 at one junction, fewer than 1 of 100,000 decisions differed
NEAREST = 24
BEFORE, BEHIND = 192.0, 64.0  # m from a junction's entry where they are put in order. source: ours


class Crossers(struct.PyTreeNode):
    """Agents and, last, the ego, where lanes meet; all (M,), M = N + 1.

    Attributes:
      number: int32, counted from 0.
      lane: int32, the junction's lane that it is on or has not wholly left, else the one it will
        take next; -1 for none.
      s: m of its middle along that lane, negative before its beginning, beyond its end after it.
      speed: m/s.
      top_speed: m/s, no faster than that on it.
      half_length: m.
      wait_s: s at rest.
      is_lawless: bool, drives and stops for nobody.
      may_go: bool, neither a light, a sign nor want of room keeps it from entering.
    """

    number: jax.Array
    lane: jax.Array
    s: jax.Array
    speed: jax.Array
    top_speed: jax.Array
    half_length: jax.Array
    wait_s: jax.Array
    is_lawless: jax.Array
    may_go: jax.Array


class Focus(struct.PyTreeNode):
    """What each agent looks at, (N,): the junction it is in or soon in the next one.

    Attributes:
      lane: int32, of its plan; -1 for none.
      s: m of its middle along that lane, negative before its beginning.
      front: m of its front bumper, likewise.
      length: m, of that lane.
      top_speed: m/s on it.
      can_wait: bool, is before it and on a lane on which there is room to wait.
    """

    lane: jax.Array
    s: jax.Array
    front: jax.Array
    length: jax.Array
    can_wait: jax.Array
    top_speed: jax.Array


class Stretch(struct.PyTreeNode):
    """Where a lane is too near to another: from enter to leave, m along it; both 0 if nowhere."""

    enter: jax.Array
    leave: jax.Array


class Pairs(struct.PyTreeNode):
    """Crossers (rows) against every agent's focus (columns), (R, N).

    The rows are all crossers, or of each column some: see `pairs`. The agents come last since a CPU
    computes along the last axis, and what is looked for among the others of each is then found for
    many agents at once.

    Attributes:
      owes: int32, FREE or one of the CONFLICT codes of `junctions`.
      merges, forks: bool, the lanes end, begin together.
      mine, theirs: the stretches on the lanes of both.
      focus: (N,) of each agent.
      others: (R, 1) or (R, N) crossers.
      speed, wait_s, half_length: (N,) of each agent.
    """

    owes: jax.Array
    merges: jax.Array
    forks: jax.Array
    mine: Stretch
    theirs: Stretch
    focus: Focus
    others: Crossers
    speed: jax.Array
    wait_s: jax.Array
    half_length: jax.Array


def crossers(
    agents: Agents, movers: Mover, may_go: jax.Array, road_map: RoadMap, top_speed: jax.Array
) -> Crossers:
    """Everybody as others see them at junctions.

    Args:
      agents: (N,) vehicles.
      movers: (N + 1,) the same and the ego.
      may_go: (N + 1,) bool, see `Crossers`; of those who stop for somebody.
      road_map: the map.
      top_speed: (N,) m/s, free speeds.
    """
    lane, following = jnp.maximum(movers.lane, 0), jnp.maximum(movers.next_lane, 0)
    past = jnp.append(jnp.where(agents.valid, agents.past_lane, -1), -1)
    is_in = (movers.lane >= 0) & road_map.lane_in_junction[lane]
    is_out = (past >= 0) & (movers.s < movers.half_length)
    is_out &= road_map.lane_in_junction[jnp.maximum(past, 0)] & ~is_in
    comes = (movers.next_lane >= 0) & road_map.lane_in_junction[following]
    way = jnp.where(is_in, lane, jnp.where(is_out, past, jnp.where(comes, following, -1)))
    before = movers.s - road_map.lane_length[lane]
    after = movers.s + road_map.lane_length[jnp.maximum(past, 0)]
    bend = road_map.lane_curve_speed[jnp.maximum(way, 0)]
    # One that stands in a queue will not come: to wait for it could be to wait for ever.
    is_lawless = jnp.append(agents.is_lawless, False) & ~movers.is_queued
    # The ego may be as fast as it likes.
    return Crossers(
        number=jnp.arange(way.shape[0]),
        lane=way,
        s=jnp.where(is_in, movers.s, jnp.where(is_out, after, before)),
        speed=movers.speed,
        top_speed=jnp.minimum(jnp.append(top_speed, 40.0), 1.2 * bend),
        half_length=movers.half_length,
        wait_s=jnp.append(agents.wait_s, 0.0),
        is_lawless=is_lawless,
        may_go=may_go | is_lawless,
    )


def focus_of(agents: Agents, road_map: RoadMap, top_speed: jax.Array) -> Focus:
    """The junction of each agent's plan that matters to it now."""
    plan = ahead_of(agents, road_map)
    half = 0.5 * agents.length
    nearby = plan.begin - half[:, None] < (NOTICE + agents.speed**2 / (2 * GENTLE_BRAKING))[:, None]
    comes = plan.in_junction & nearby & (plan.begin > 0.0)
    following = jnp.where(comes[:, 1], 1, 2)
    is_in = plan.in_junction[:, 0]
    begin = jnp.where(comes[:, 1], plan.begin[:, 1], plan.begin[:, 2])
    near = begin - half < 4.0 + agents.speed**2 / (2 * BRAKING)
    looks_on = comes[:, 1:].any(axis=1) & (~is_in | near)
    number = jnp.where(looks_on, following, 0)[:, None]

    def pick(values: jax.Array) -> jax.Array:
        return jnp.take_along_axis(values, number, axis=1)[:, 0]

    used = (is_in | looks_on) & agents.valid
    lane, s = pick(plan.lane), -pick(plan.begin)
    return Focus(
        lane=jnp.where(used, lane, -1),
        s=s,
        front=s + half,
        length=pick(plan.length),
        can_wait=looks_on & ~is_in & (plan.length[:, 0] > SHORT),
        top_speed=jnp.minimum(top_speed, road_map.lane_curve_speed[lane]),
    )


def pairs(agents: Agents, focus: Focus, others: Crossers, road_map: RoadMap) -> Pairs:
    """Looks up how each focus meets each lane of others.

    Of more than `order.MANY` others these are for each focus the `NEAREST` of its junction.
    """
    if others.lane.shape[0] > order.MANY:
        others = once(_nearest(focus, others, road_map))
        slot = road_map.lane_slot[jnp.maximum(others.lane, 0)]
        meeting = once(road_map.lane_meeting[jnp.maximum(focus.lane, 0), :, slot])
        found, same = (meeting[..., 0], meeting[..., 1]), others.lane >= 0
    else:
        found = _meetings(focus, others, road_map)
        others = jax.tree.map(lambda x: x[:, None], others)
        junction = _junction(others.lane, road_map)
        same = (junction >= 0) & (junction == _junction(focus.lane, road_map))
    mine, theirs = (jnp.where(same, number.astype(jnp.int32), 0) for number in found)
    relation = (mine >> 2) & 3
    return Pairs(
        owes=mine & 3,
        merges=(relation & MERGE) > 0,
        forks=(relation & FORK) > 0,
        mine=_stretch((mine >> 4) & MEETING_MASK, mine >> 14),
        theirs=_stretch(theirs & 0xFFF, theirs >> 12),
        focus=focus,
        others=others,
        speed=agents.speed,
        wait_s=agents.wait_s,
        half_length=0.5 * agents.length,
    )


def _junction(lane: jax.Array, road_map: RoadMap) -> jax.Array:
    """Junctions of lanes, int32; -1 for no lane and outside of junctions."""
    return jnp.where(lane >= 0, road_map.lane_junction[jnp.maximum(lane, 0)], -1)


def _meetings(focus: Focus, others: Crossers, road_map: RoadMap) -> tuple[jax.Array, jax.Array]:
    """(M, N) float32, both numbers of `lane_meeting` of each focus and each other."""
    slots = jnp.arange(road_map.lane_meeting.shape[-1])
    slot = road_map.lane_slot[jnp.maximum(others.lane, 0)]
    is_slot = (slot[:, None] == slots).astype(jnp.float32)  # (M, J)
    # A product of matrices that picks single numbers, exactly; a look-up for each pair within what
    # follows would keep the compiler from vectorising all of it on a CPU.
    table = road_map.lane_meeting[jnp.maximum(focus.lane, 0)]  # (N, 2, J)
    # Two products, lest both numbers come out with M last, and have to be transposed.
    pick = functools.partial(jnp.einsum, "mj,nj->mn", precision=jax.lax.Precision.HIGHEST)
    return pick(is_slot, table[:, 0]), pick(is_slot, table[:, 1])


def _nearest(focus: Focus, others: Crossers, road_map: RoadMap) -> Crossers:
    """(NEAREST, N) crossers of each focus's junction: the farthest on their way come first.

    Where they are fewer, the rest are on no lane.
    """
    num_junctions = road_map.lane_junction.shape[0]  # no more than lanes
    junction = _junction(others.lane, road_map)
    all_cars = order.sort(junction, BEHIND - others.s, others, num_junctions, BEFORE + BEHIND)
    found, is_there = order.following(all_cars, _junction(focus.lane, road_map), 0.0, NEAREST)
    return found.replace(lane=jnp.where(is_there, found.lane, -1))


def _stretch(enter: jax.Array, leave: jax.Array) -> Stretch:
    step = jnp.float32(1 / MEETING_STEPS)
    return Stretch(enter.astype(jnp.float32) * step, leave.astype(jnp.float32) * step)


def joined_gaps(pair: Pairs) -> jax.Array:
    """(R, N) m, bumper gap to cars on lanes that begin or end with an agent's own, FAR elsewhere.

    Where lanes part, to the one ahead until its tail is clear; where they join, to the one that is
    nearer to where they end.
    """
    theirs, focus, others = pair.theirs, pair.focus, pair.others
    room = pair.half_length + others.half_length
    parts = pair.forks & (others.s > focus.s) & (others.s - others.half_length < theirs.leave)
    parts &= others.s > -others.half_length
    gap = jnp.where(parts, others.s - focus.s - room, FAR)
    return jnp.where(_joins(pair), _join_gap(pair) - room, gap)


def _join_gap(pair: Pairs) -> jax.Array:
    """How much farther an agent has to go to where the lanes join than the other, m."""
    # Both lanes are left at the same place, so the stretches end there.
    mine, theirs = pair.mine.leave - pair.focus.s, pair.theirs.leave - pair.others.s
    return mine - theirs


def _joins(pair: Pairs) -> jax.Array:
    """The other car's front is where the lanes join, and it is ahead."""
    there = pair.others.s + pair.others.half_length > pair.theirs.enter
    return pair.merges & there & (_join_gap(pair) > 0.0)


def stretch_gaps(pair: Pairs) -> jax.Array:
    """(N,) m from the front bumper to the first stretch on which another car is; FAR for none."""
    theirs, focus, others = pair.theirs, pair.focus, pair.others
    crosses = (pair.mine.leave > 0.0) & ~pair.merges & ~pair.forks
    there = others.s + others.half_length > theirs.enter
    there |= others.is_lawless & _collides(pair, MARGIN)
    there &= others.s - others.half_length < theirs.leave
    blocked = crosses & there & (focus.front < pair.mine.enter)
    return jnp.where(blocked, pair.mine.enter - focus.front, FAR).min(axis=0)


def has_room(focus: Focus, half_length: jax.Array, along: CarsAhead) -> jax.Array:
    """(N,) bool: behind those who stand an agent would come to rest beyond the junction.

    Those who drive between it and the first one that stands will stop there as well. On a short
    lane between two junctions none of it is asked: cars that wait there for one another all around
    a block or a roundabout would wait for ever.

    Args:
      focus: of each agent.
      half_length: (N,) m.
      along: cars ahead on its plan.
    """
    to_queue = jnp.where(along.is_queued, along.gap, FAR).min(axis=0)
    space = 2.0 * along.half_length + ROOM_GAP
    taken = jnp.where(along.gap < to_queue, space, 0.0).sum(axis=0)
    rests = focus.front + to_queue - taken - ROOM_GAP
    is_free = (to_queue >= FAR) | (rests > focus.length + 2.0 * half_length)
    return ~focus.can_wait | is_free


def gated(pair: Pairs) -> jax.Array:
    """(N,) bool: others go first into the junction that an agent is about to enter."""
    theirs, focus, others = pair.theirs, pair.focus, pair.others
    front = others.s + others.half_length
    has_entered = front > ENTERED
    there = (front > theirs.enter) & (others.s - others.half_length < theirs.leave)
    # Two that wait for one another would wait for ever: the one that waited longest goes.
    first = pair.wait_s > others.wait_s
    first |= (pair.wait_s == others.wait_s) & (_order(pair) < others.number)
    stands = (pair.wait_s > PATIENCE) & (others.speed < 0.5) & ~others.is_lawless
    inside = has_entered & (others.s - others.half_length < theirs.leave) & ~_joins(pair)
    inside &= (_leaves(pair) + 0.5 * MARGIN > _arrives(pair)) & (there | ~stands)
    margin = jnp.clip(MARGIN * PATIENCE / (PATIENCE + pair.wait_s), LEAST_MARGIN, MARGIN)
    yields = (pair.owes == CONFLICT_YIELD) | others.is_lawless
    yields |= (pair.owes == CONFLICT) & _is_earlier(pair)
    coming = ~has_entered & others.may_go & yields & _collides(pair, margin)
    waits = (pair.owes != FREE) & (inside | (coming & ~(stands & first)))
    return waits.any(axis=0) & (focus.front < ENTERED)


def _order(pair: Pairs) -> jax.Array:
    """(N,) int32 numbers of the agents among the crossers: the first goes if all else is equal."""
    return jnp.arange(pair.speed.shape[0])


def _is_earlier(pair: Pairs) -> jax.Array:
    """The other car arrives, or has arrived, before the agent."""
    focus, others = pair.focus, pair.others
    mine = jnp.maximum(-focus.front, 0.0) / jnp.maximum(pair.speed, 2.0) - pair.wait_s
    other = jnp.maximum(-others.s - others.half_length, 0.0) / jnp.maximum(others.speed, 2.0)
    other = other - others.wait_s
    return (other < mine) | ((other == mine) & (others.number < _order(pair)))


def _collides(pair: Pairs, margin: jax.Array | float) -> jax.Array:
    """An agent that goes now and another would be on their stretches within a margin of time."""
    theirs, focus, others = pair.theirs, pair.focus, pair.others
    theirs_in = _time(theirs.enter - others.s - others.half_length, others.speed, others.top_speed)
    out = pair.mine.leave - focus.s + pair.half_length
    # A car that ends on one lane with the other only has to be ahead of it.
    out = jnp.where(pair.merges, out + FOLLOWS * others.speed, out)
    mine_out = _time(out, pair.speed, focus.top_speed)
    return (_arrives(pair) < _leaves(pair) + margin) & (theirs_in < mine_out + margin)


def _arrives(pair: Pairs) -> jax.Array:
    """(R, N) s until an agent comes to the stretch."""
    to_go = pair.mine.enter - pair.focus.front
    return _time(to_go, pair.speed, pair.focus.top_speed)


def _leaves(pair: Pairs) -> jax.Array:
    """(R, N) s until the other car has left the stretch if it goes on as now."""
    others = pair.others
    left = pair.theirs.leave - others.s + others.half_length
    return jnp.maximum(left, 0.0) / jnp.maximum(others.speed, SLOWEST)


def _time(distance: jax.Array, speed: jax.Array, top_speed: jax.Array) -> jax.Array:
    """Seconds for a distance: with ACCEL from a speed, no faster than another."""
    distance = jnp.maximum(distance, 0.0)
    free = (jnp.sqrt(speed**2 + 2 * ACCEL * distance) - speed) / ACCEL
    return jnp.maximum(free, distance / jnp.maximum(top_speed, SLOWEST))
