"""Scenarios at junctions on real routes: streams that wait for nobody, a car that runs its red.

The ego keeps to the route and to the limit, and does not react.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenario_world import ROWS, drive, make

from carljax.sim import lights, route_generator
from carljax.sim.journey import Journey
from carljax.sim.route_assembly import RouteSizes
from carljax.sim.scenarios import registry
from carljax.sim.scenarios.generator import place_along
from carljax.sim.scenarios.script import NUM_CARS
from carljax.sim.town import offsets
from carljax.sim.types import KIND_VEHICLE, LIGHT_GREEN, LIGHT_RED

STREAMS = (
    "SignalizedJunctionLeftTurn",
    "SignalizedJunctionRightTurn",
    "NonSignalizedJunctionLeftTurn",
    "NonSignalizedJunctionRightTurn",
)
RED = "OppositeVehicleRunningRedLight"
KINDS = (*STREAMS, RED)
NUM, STEPS, DT = 12, 330, 0.1
LENGTH = 500


def journeys(towns, kind):
    """Routes with one scenario of the kind each, as the generator places it."""
    firsts, found, number = offsets(towns), [], 0
    while len(found) < NUM:
        town, rng = number % len(towns), np.random.default_rng([3, number])
        sizes = RouteSizes(num_points=LENGTH + 1)
        way = route_generator.draw(towns[town], firsts[town], LENGTH, sizes, rng)
        placed = place_along(towns[town], firsts[town], way, rng, kinds=(kind,))
        found += [Journey(way, placed[:1])] if placed else []
        number += 1
    return found


@pytest.fixture(scope="module")
def env(bundled):
    """All kinds in one environment, `NUM` routes each, in the order of `KINDS`."""
    towns = [bundled["grid"], bundled["village"]]
    return make(towns, [one for kind in KINDS for one in journeys(towns, kind)])


@pytest.fixture(scope="module")
def path(env):
    return drive(env, num_steps=STEPS)


def rows(kind):
    first = NUM * KINDS.index(kind)
    return slice(first, first + NUM)


def script(env, name, part="cars"):
    """(S, ...) of each route's scenario."""
    scenario = env.bank.scenarios
    return np.asarray(getattr(getattr(scenario, part) if part else scenario, name))[:, 0]


def since(path):
    """(S, T) s since the trigger, -1 before it and after the end."""
    slots = path.sim.scenarios
    plays = (slots.index >= 0) & ~slots.is_leaving
    return np.where(plays, slots.triggered_s, -1.0).max(axis=2)


def actors(path):
    """Agents of the scenario: (S, T, NUM_CARS, ...); there is one, so it is in the first slot."""
    first = ROWS.cars.start
    return jax.tree.map(lambda x: x[:, :, first : first + NUM_CARS], path.sim.agents)


@pytest.mark.parametrize("kind", KINDS)
def test_it_triggers_ends_and_frees_its_slot(kind, env, path):
    slots = jax.tree.map(lambda x: x[rows(kind)], path.sim.scenarios)
    assert (slots.num_triggered[:, -1] == 1).all()
    ended = slots.ended_kind >= 0
    assert (ended.sum(axis=1) == 1).all()
    assert (slots.ended_kind[ended] == registry.KINDS.index(kind)).all()
    assert not slots.has_timed_out.any() and not slots.has_failed_to_yield.any()
    begins = (since(path)[rows(kind)] >= 0.0).argmax(axis=1)
    at = path.route_s[rows(kind)]
    number = np.arange(NUM)
    # A step is 1.4 m at most, a route point 1 m.
    wanted = script(env, "trigger_s", None)[rows(kind)]
    np.testing.assert_allclose(at[number, begins], wanted, atol=2.5)
    wanted = script(env, "end_s", None)[rows(kind)]
    np.testing.assert_allclose(at[number, ended.argmax(axis=1)], wanted, atol=2.5)
    # Who is out of sight is taken away; with the last of them the slot is free.
    cars = jax.tree.map(lambda x: x[rows(kind), -1], actors(path))
    away = np.hypot(*(cars.xy - path.sim.ego.xy[rows(kind), -1, None]).transpose(2, 0, 1))
    assert not (cars.valid & (away > 105.0)).any()  # hypot(80, 66) = 104
    assert ((slots.index[:, -1] >= 0).any(axis=1) == cars.valid.any(axis=1)).all()


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_dangerous_to_keep_driving(kind, path):
    assert path.hit[rows(kind)].mean() >= 0.5


@pytest.mark.parametrize("kind", STREAMS)
def test_the_stream_leaves_its_source_car_by_car_at_its_speed(kind, env, path):
    cars = jax.tree.map(lambda x: x[rows(kind)], actors(path))
    used = script(env, "model")[rows(kind)] >= 0
    delay, source = script(env, "delay")[rows(kind)], script(env, "s")[rows(kind)]
    speed = script(env, "speed")[rows(kind)]
    time = since(path)[rows(kind)]
    there = cars.kind == KIND_VEHICLE
    first = there.argmax(axis=1)  # (NUM, L)
    appeared = used & there.any(axis=1)
    assert appeared.sum(axis=1).min() >= 2
    late = []
    for e, i in zip(*np.nonzero(appeared), strict=True):
        at = first[e, i]
        # Later than that only where the place is taken or, by then, in sight.
        late.append(time[e, at] - delay[e, i])
        assert cars.lane_s[e, at, i] == pytest.approx(source[e, i], abs=0.01)
        plays = there[e, :, i] & (time[e] >= 0.0)
        # Until the ego comes ahead of it, it is slower only to keep its distance, on its way to the
        # junction and through it.
        plays &= path.route_s[rows(kind)][e] < script(env, "meet_s")[rows(kind)][e, i] - 15.0
        plays &= (cars.lanes[e, :, i, :1] == script(env, "lanes")[rows(kind)][e, i, :2]).any(axis=1)
        assert (cars.speed[e, plays, i] <= speed[e, i] + 0.05).all()
        assert (cars.speed[e, plays, i] > 0.6 * speed[e, i]).all()
    assert not (there & ~used[:, None]).any()
    assert min(late) > -0.01
    assert np.mean(np.array(late) < DT + 0.01) > 0.7


def test_streams_go_on_while_the_ego_is_slow_to_come(env):
    slow = drive(env, speed=3.0, num_steps=STEPS)
    for kind in STREAMS:
        cars = jax.tree.map(lambda x, kind=kind: x[rows(kind)], actors(slow))
        source = script(env, "lanes")[rows(kind)][:, None, :, 0]
        on_first = (cars.kind == KIND_VEHICLE) & (cars.lanes[..., 0] == source)
        starts = (~on_first[:, :-1] & on_first[:, 1:]).sum(axis=1)
        assert (starts.max(axis=1) > 1).mean() > 0.5, kind


@pytest.mark.parametrize("kind", [k for k in KINDS if not k.startswith("Non")])
def test_lights_are_held_as_said(kind, env, path):
    road_map = env.bank.road_map
    shown = jax.jit(jax.vmap(jax.vmap(lambda c: lights.colour(_all_lights(road_map), c, road_map))))
    clock = jax.tree.map(lambda x: jnp.asarray(x[rows(kind)]), path.sim.lights)
    colour = np.asarray(shown(clock))  # (NUM, T, L)
    time = since(path)[rows(kind)]
    junction = script(env, "held_junction", None)[rows(kind)]
    green = script(env, "held_green", None)[rows(kind)]
    there = np.asarray(road_map.light_junction)[None] == junction[:, None]  # (NUM, L)
    number = np.arange(there.shape[1])
    for e in range(NUM):
        is_green = np.isin(number, green[e]) & there[e]
        held = time[e] > lights.CLEARING_S + DT
        assert held.sum() > 5 or time[e].max() < lights.CLEARING_S + 1.0
        assert (colour[e][held][:, is_green] == LIGHT_GREEN).all()
        assert (colour[e][held][:, there[e] & ~is_green] == LIGHT_RED).all()


def _all_lights(road_map):
    return jnp.arange(road_map.light_cycle.shape[0])


def test_the_ambulance_runs_its_red_light_when_the_ego_comes(env, path):
    cars = jax.tree.map(lambda x: x[rows(RED), :, 0], actors(path))
    lanes, meet = script(env, "lanes")[rows(RED)][:, 0], script(env, "meet_lane_s")[rows(RED)][:, 0]
    meet_s = script(env, "meet_s")[rows(RED)][:, 0]
    road_map = env.bank.road_map
    length, lane_light = np.asarray(road_map.lane_length), np.asarray(road_map.lane_light)
    in_time = 0
    for e in range(NUM):
        there = cars.kind[e] == KIND_VEHICLE
        inside = there & (cars.lanes[e, :, 0] == lanes[e, 1])
        enters = int(inside.argmax())
        clock = jax.tree.map(
            lambda x, e=e, t=enters: jnp.asarray(x[rows(RED)][e, t]), path.sim.lights
        )
        if inside.any():
            light = jnp.int32(lane_light[lanes[e, 1]])
            assert int(lights.colour(light, clock, road_map)) == LIGHT_RED
            assert cars.speed[e, enters] > 8.0
        came = np.where(inside, length[lanes[e, 0]] + cars.lane_s[e], -1.0)
        # It may brake for an ego that turns into its road, at the last moment.
        nearly = came >= meet[e] - 5.0
        if nearly.any():
            ego = path.route_s[rows(RED)][e]
            in_time += abs(int(nearly.argmax()) - int((ego >= meet_s[e]).argmax())) <= 8
    assert in_time >= 0.7 * NUM
