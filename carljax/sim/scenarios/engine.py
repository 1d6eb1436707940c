"""Plays the scenarios of a route: one engine for all kinds, everything in fixed slots.

When the ego comes to a scenario's `arm_s` its actors take their places, if there are rows for them
(`parts`), nobody sees them appear and nobody is in their place; else the scenario waits, and is
left out once its trigger is passed. From the trigger on it plays, until the ego is past its end or
its time is up. Then its actors leave as soon as nobody sees them, and the slot and its rows are
free.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from carljax.sim import geometry, population
from carljax.sim.route import Route
from carljax.sim.scenarios import actors, parts
from carljax.sim.scenarios.actors import Cues, Scene
from carljax.sim.scenarios.parts import Parts
from carljax.sim.scenarios.script import (
    DRIVE_FLOW,
    DRIVE_MEET,
    Scenario,
    ScenarioSlots,
)
from carljax.sim.types import KIND_NONE, SIGNAL_EMERGENCY, Agents, EgoState, LightClock

# m within which a car ahead is the one that brakes. source: ours, a headway of 3 s at 50 km/h
LEADER_RANGE = 40.0
FAR = 1e3  # m
# m beyond its trigger within which a scenario may still be armed. source: ours, a step at 30 m/s
LATE = 3.0


def scripts(scenarios: Scenario, episode_idx: jax.Array, index: jax.Array) -> Scenario:
    """Rows of the bank's scenarios, of the index's shape; kind is -1 where there is none.

    Args:
      scenarios: the bank's, leading axes S, E.
      episode_idx: () int32.
      index: (...) int32.
    """
    num = scenarios.kind.shape[1]
    found = jax.tree.map(lambda x: x[episode_idx, jnp.clip(index, 0, num - 1)], scenarios)
    return found.replace(kind=jnp.where((index >= 0) & (index < num), found.kind, -1))


def progress(stretch: Route, idx: jax.Array, ego: EgoState) -> jax.Array:
    """() m, where on its route the ego is, between the points too."""
    along = geometry.to_frame(ego.xy, stretch.xy[idx], stretch.yaw[idx])[0]
    return stretch.s[idx] + jnp.clip(along, 0.0, 1.0)


def disturb(
    action: jax.Array,
    slots: ScenarioSlots,
    scenarios: Scenario,
    episode_idx: jax.Array,
    route_s: jax.Array,
) -> jax.Array:
    """(2,) the action as the car takes it: on the patches of a scenario it is not what was meant.

    Args:
      action: (2,) steering and longitudinal.
      slots: see `ScenarioSlots`.
      scenarios: the bank's.
      episode_idx: () int32.
      route_s: () m, see `progress`.
    """
    script = scripts(scenarios, episode_idx, slots.index)
    on = (script.patches[..., 0] <= route_s) & (route_s < script.patches[..., 1])
    on &= slots.is_playing[:, None]
    half_width = jnp.stack([script.steer_noise, script.throttle_noise], axis=-1)[:, None]
    return action + jnp.where(on[..., None], slots.noise * half_width, 0.0).sum(axis=(0, 1))


def start(
    slots: ScenarioSlots,
    agents: Agents,
    scenarios: Scenario,
    episode_idx: jax.Array,
    scene: Scene,
    key: jax.Array,
) -> tuple[ScenarioSlots, Agents]:
    """Sets up the scenarios around the start of a route; there, actors may appear in sight.

    Args:
      slots: empty.
      agents: (N,) at the start.
      scenarios: the bank's.
      episode_idx: () int32.
      scene: at the start.
      key: PRNG key.

    Returns:
      Slots and agents.
    """

    def one(
        carry: tuple[ScenarioSlots, Agents], key: jax.Array
    ) -> tuple[tuple[ScenarioSlots, Agents], None]:
        slots, agents = carry
        cast = _cast(agents, scene)
        slots, script, cast = _arm(slots, scenarios, episode_idx, cast, agents, scene, key)
        slots, cast = _cars(slots, script, cast, agents, scene)
        return (slots, _with_cast(agents, cast, scene)), None

    if scene.rows.num_slots == 0:
        return slots, agents
    carry, _ = jax.lax.scan(one, (slots, agents), jax.random.split(key, scene.rows.num_slots))
    return carry


def step(
    slots: ScenarioSlots,
    agents: Agents,
    clock: LightClock,
    scenarios: Scenario,
    episode_idx: jax.Array,
    scene: Scene,
    key: jax.Array,
    dt: float,
) -> tuple[ScenarioSlots, Agents, LightClock]:
    """Plays all scenarios for one step.

    Args:
      slots: before.
      agents: (N,) after traffic has moved.
      clock: of the lights, after the step.
      scenarios: the bank's.
      episode_idx: () int32.
      scene: after the ego's step.
      key: PRNG key.
      dt: s.

    Returns:
      Slots, agents and clock dt later.
    """
    if scene.rows.num_slots == 0:
        return slots, agents, clock
    cast = _cast(agents, scene)
    slots, script, cast = _arm(slots, scenarios, episode_idx, cast, agents, scene, key)
    slots, clock = _trigger(slots, script, clock, scene, dt)
    slots, clock = _end(slots, script, clock, cast, scene)
    slots, cast = _others(slots, script, cast, scene, dt)
    slots, cast = _cars(slots, script, cast, agents, scene)
    slots, is_braking_hard = _brake(slots, script, agents, scene, dt)
    slots, cast = _leave(slots, cast, scene)
    agents = _with_cast(agents, cast, scene)
    return slots, agents.replace(is_braking_hard=is_braking_hard), clock


class Cast(struct.PyTreeNode):
    """The rows of all scenarios: cars (P,), others (Q,)."""

    cars: Agents
    others: Agents


def _cast(agents: Agents, scene: Scene) -> Cast:
    return Cast(
        population.rows(agents, scene.rows.cars), population.rows(agents, scene.rows.others)
    )


def _with_cast(agents: Agents, cast: Cast, scene: Scene) -> Agents:
    before = population.rows(agents, scene.rows.traffic)
    after = population.rows(agents, scene.rows.walkers)
    return population.join(before, cast.cars, cast.others, after)


def _arm(
    slots: ScenarioSlots,
    scenarios: Scenario,
    episode_idx: jax.Array,
    cast: Cast,
    agents: Agents,
    scene: Scene,
    key: jax.Array,
) -> tuple[ScenarioSlots, Scenario, Cast]:
    """Gives the next scenario a slot, if it is time and its actors can take their places.

    Returns:
      The slots, what is played in them (see `_in_play`), and their actors.
    """
    coming = scripts(scenarios, episode_idx, slots.next_index)
    free = slots.index < 0
    slot = jnp.argmax(2 * free + slots.is_leaving)
    num_cars, num_others = (coming.cars.model >= 0).sum(), (coming.others.kind != KIND_NONE).sum()
    exists = coming.kind >= 0
    missed = exists & (scene.route_s > coming.trigger_s + LATE)
    arms = exists & ~missed & (scene.route_s >= coming.arm_s)
    arms &= (free | slots.is_leaving)[slot] & _has_room(coming, agents, scene)
    arms &= parts.num_free(slots.cars, slot) >= num_cars
    arms &= parts.num_free(slots.others, slot) >= num_others
    taken = arms & (jnp.arange(scene.rows.num_slots) == slot)
    noise = jax.random.uniform(key, slots.noise.shape, minval=-1.0)
    cars, changed_cars = parts.hand_over(slots.cars, taken, num_cars)
    others, changed_others = parts.hand_over(slots.others, taken, num_others)
    slots = slots.replace(
        index=jnp.where(taken, slots.next_index, slots.index),
        is_leaving=slots.is_leaving & ~taken,
        triggered_s=jnp.where(taken, -1.0, slots.triggered_s),
        cars=cars,
        others=others,
        has_appeared=slots.has_appeared & ~changed_cars,
        has_started=slots.has_started & ~changed_others,
        moved=jnp.where(changed_others, 0.0, slots.moved),
        noise=jnp.where(taken[:, None, None], noise, slots.noise),
        braker=jnp.where(taken, -1, slots.braker),
        braked_s=jnp.where(taken, 0.0, slots.braked_s),
        next_index=slots.next_index + (arms | missed),
    )
    script = _in_play(slots, scenarios, episode_idx)
    cast = Cast(
        actors.take_away(cast.cars, changed_cars),
        actors.put_others(cast.others, changed_others, script.others),
    )
    return slots, script, cast


def _in_play(slots: ScenarioSlots, scenarios: Scenario, episode_idx: jax.Array) -> Scenario:
    """What is played in the slots, (H,); in its cars and others the scripts of rows, (P,) (Q,).

    Free rows are told that there is nobody.
    """
    script = scripts(scenarios, episode_idx, slots.index)

    def of_rows(scripted: Any, rows: Parts) -> Any:
        index = jnp.maximum(slots.index, 0)[jnp.maximum(rows.slot, 0)]
        return jax.tree.map(lambda x: x[episode_idx, index, rows.number], scripted)

    cars, others = of_rows(scenarios.cars, slots.cars), of_rows(scenarios.others, slots.others)
    return script.replace(
        cars=cars.replace(model=jnp.where(slots.cars.is_free, -1, cars.model)),
        others=others.replace(kind=jnp.where(slots.others.is_free, KIND_NONE, others.kind)),
    )


def _has_room(coming: Scenario, agents: Agents, scene: Scene) -> jax.Array:
    """() bool: whoever of a scenario has to be there from the beginning can be."""
    cars, others = coming.cars, coming.others
    here = (cars.model >= 0) & ~cars.from_trigger & (cars.drive != DRIVE_FLOW)
    at = actors.car_start(cars, scene.road_map).xy
    vehicles = population.rows(agents, scene.rows.vehicles)
    room = ~here | actors.may_appear(at, actors.car_length(cars), actors.CAR_GAP, vehicles, scene)
    stands = others.kind != KIND_NONE
    free = actors.may_appear(others.xy, others.length, actors.OTHER_GAP, agents, scene)
    return room.all() & (~stands | free).all()


def _trigger(
    slots: ScenarioSlots, script: Scenario, clock: LightClock, scene: Scene, dt: float
) -> tuple[ScenarioSlots, LightClock]:
    """Begins what the ego has come to, and counts the time since."""
    plays = slots.is_playing
    begins = slots.is_armed & (scene.route_s >= script.trigger_s)
    since = jnp.where(plays, slots.triggered_s + dt, slots.triggered_s)
    slots = slots.replace(
        triggered_s=jnp.where(begins, 0.0, since),
        num_triggered=slots.num_triggered + begins.sum(),
    )
    holds = begins & (script.held_junction >= 0)
    clock = clock.replace(
        held_junction=jnp.where(holds, script.held_junction, clock.held_junction),
        held_green=jnp.where(holds[:, None], script.held_green, clock.held_green),
        held_from=jnp.where(holds, clock.time, clock.held_from),
        held_until=jnp.where(holds, jnp.inf, clock.held_until),
    )
    return slots, clock


def _end(
    slots: ScenarioSlots, script: Scenario, clock: LightClock, cast: Cast, scene: Scene
) -> tuple[ScenarioSlots, LightClock]:
    """Ends what the ego has passed or what takes too long: one a step, so that none goes unseen."""
    passed = scene.route_s >= script.end_s
    over = slots.is_playing & (passed | (slots.triggered_s > script.timeout_s))
    ends = over & (jnp.cumsum(over) == 1)
    cars = cast.cars
    behind = geometry.to_frame(cars.xy, scene.ego.xy, scene.ego.yaw)[:, 0] < 0.0
    # Nobody can give way to one that crosses: only what comes along the ego's own way counts.
    flashes = ((script.cars.signals & SIGNAL_EMERGENCY) > 0) & (script.cars.drive != DRIVE_MEET)
    follows = parts.any_of(slots.cars, cars.valid & behind & flashes, len(ends))
    slots = slots.replace(
        is_leaving=slots.is_leaving | ends,
        ended_kind=jnp.where(ends, script.kind, -1).max(),
        has_timed_out=(ends & ~passed).any(),
        has_failed_to_yield=(ends & follows).any(),
    )
    until = jnp.where(ends, jnp.minimum(clock.held_until, clock.time), clock.held_until)
    return slots, clock.replace(held_until=until)


def _others(
    slots: ScenarioSlots, script: Scenario, cast: Cast, scene: Scene, dt: float
) -> tuple[ScenarioSlots, Cast]:
    """Lets those off the lanes start, and moves them."""
    starts = actors.starts_moving(script.others, _cues(slots, slots.others), scene)
    started = slots.has_started | starts
    others, moved = actors.move_others(cast.others, script.others, started, slots.moved, dt)
    return slots.replace(has_started=started, moved=moved), cast.replace(others=others)


def _cars(
    slots: ScenarioSlots, script: Scenario, cast: Cast, agents: Agents, scene: Scene
) -> tuple[ScenarioSlots, Cast]:
    """Lets cars on lanes take their places when it is their turn, and tells them how to drive."""
    cars, role, cues = cast.cars, script.cars, _cues(slots, slots.cars)
    came = actors.way(cars, role, scene.road_map)
    waits = actors.waiting(cars, slots.has_appeared, role, cues, came)
    at = actors.car_start(role, scene.road_map)
    vehicles = population.rows(agents, scene.rows.vehicles)
    able = actors.may_appear(at.xy, actors.car_length(role), actors.CAR_GAP, vehicles, scene)
    able &= ~cars.valid | actors.is_hidden(cars.xy, scene)
    starts = actors.one_at_a_time(at.xy, waits & able)
    cars = actors.put_cars(cars, starts, role, at, scene.road_map)
    cars = actors.command_cars(cars, role, cues, jnp.where(starts, role.s, came), scene)
    return slots.replace(has_appeared=slots.has_appeared | starts), cast.replace(cars=cars)


def _brake(
    slots: ScenarioSlots, script: Scenario, agents: Agents, scene: Scene, dt: float
) -> tuple[ScenarioSlots, jax.Array]:
    """Makes the car ahead of the ego brake, once there is one: (N,) bool, who brakes hard."""
    num = scene.rows.num_vehicles
    leader, gap = _leader(population.rows(agents, scene.rows.vehicles), scene)
    plays = slots.is_playing & (script.brake_s > 0.0)
    finds = plays & (slots.braker < 0) & (gap < LEADER_RANGE)
    braker = jnp.where(finds, leader, slots.braker)
    brakes = plays & (braker >= 0) & (slots.braked_s < script.brake_s)
    hard = (braker[:, None] == jnp.arange(num)) & brakes[:, None]
    hard = jnp.append(hard.any(axis=0), jnp.zeros(scene.rows.num_agents - num, bool))
    braked = slots.braked_s + jnp.where(brakes, dt, 0.0)
    return slots.replace(braker=braker, braked_s=braked), hard


def _leader(vehicles: Agents, scene: Scene) -> tuple[jax.Array, jax.Array]:
    """The nearest vehicle ahead on the ego's lane or the next one: its row, and m to it."""
    place = scene.ego_place
    left = scene.road_map.lane_length[jnp.maximum(place.lane, 0)] - place.s
    lane = vehicles.lanes[:, 0]
    here = (lane == place.lane) & (vehicles.lane_s > place.s)
    there = (lane == place.next_lane) & (lane != place.lane)
    gap = jnp.where(here, vehicles.lane_s - place.s, jnp.where(there, left + vehicles.lane_s, FAR))
    gap = jnp.where(vehicles.valid & (lane >= 0), gap, FAR)
    leader = jnp.argmin(gap)
    return leader.astype(jnp.int32), gap[leader]


def _leave(slots: ScenarioSlots, cast: Cast, scene: Scene) -> tuple[ScenarioSlots, Cast]:
    """Takes away whom nobody sees once a scenario is over; without any, its slot is free."""

    def without(part: Agents, rows: Parts) -> Agents:
        leaves = parts.of_slots(rows, slots.is_leaving, False)
        return actors.take_away(part, leaves & actors.is_hidden(part.xy, scene))

    cast = Cast(without(cast.cars, slots.cars), without(cast.others, slots.others))
    num = len(slots.index)
    here = parts.any_of(slots.cars, cast.cars.valid, num)
    here |= parts.any_of(slots.others, cast.others.valid, num)
    empty = slots.is_leaving & ~here
    slots = slots.replace(
        index=jnp.where(empty, -1, slots.index),
        is_leaving=slots.is_leaving & ~empty,
        cars=parts.without(slots.cars, empty),
        others=parts.without(slots.others, empty),
    )
    return slots, cast


def _cues(slots: ScenarioSlots, rows: Parts) -> Cues:
    """What the actors in rows go by."""
    return Cues(
        is_active=parts.of_slots(rows, slots.is_armed | slots.is_playing, False),
        triggered_s=parts.of_slots(rows, slots.triggered_s, -1.0),
    )
