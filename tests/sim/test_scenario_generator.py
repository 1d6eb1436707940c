"""Scenarios along drawn routes: about as many as asked for, in order, out of each other's way."""

import collections

import jax
import numpy as np
import pytest

from carljax.sim import episodes, route_generator, towns
from carljax.sim.population import Population
from carljax.sim.route_assembly import RouteSizes
from carljax.sim.scenarios import generator, registry
from carljax.sim.scenarios.generator import place_along
from carljax.sim.scenarios.script import DRIVE_FLOW, DRIVE_MEET
from carljax.sim.town import offsets
from carljax.sim.types import KIND_NONE

NUM_ROUTES, LENGTH = 200, 1000


@pytest.fixture(scope="module")
def there(bundled):
    return [bundled[name] for name in towns.names()]


def draw(there, number, length=LENGTH):
    """A route and the chance that goes on from it."""
    town, rng = number % len(there), np.random.default_rng([7, number])
    first = offsets(there)[town]
    sizes = RouteSizes(num_points=length + 1)
    return there[town], first, route_generator.draw(there[town], first, length, sizes, rng), rng


@pytest.fixture(scope="module")
def drawn(there):
    """Town, its first rows, route and scenarios of each drawn route."""
    found = []
    for number in range(NUM_ROUTES):
        town, first, route, rng = draw(there, number)
        found.append((town, first, route, place_along(town, first, route, rng)))
    return found


def name(scenario):
    return registry.KINDS[int(scenario.kind)]


def test_all_kinds_occur_where_they_can(drawn):
    count = collections.Counter(
        (t.network.name, name(x)) for t, _, _, found in drawn for x in found
    )
    for kind in registry.KINDS:
        assert sum(count[town, kind] for town in towns.names()) >= 10, kind
    # The grid's junctions have lights, the village's have none.
    for kind in ("SignalizedJunctionLeftTurn", "SignalizedJunctionRightTurn"):
        assert count["grid", kind] > 0 and count["village", kind] == 0
    for kind in ("NonSignalizedJunctionLeftTurn", "NonSignalizedJunctionRightTurn"):
        assert count["village", kind] > 0 and count["grid", kind] == 0
    assert count["village", "OppositeVehicleRunningRedLight"] == 0


def test_about_one_every_hundred_metres(drawn):
    # The last 60 m are left free: ten stretches of 100 m, of which few suit no kind at all.
    num = np.array([len(found) for *_, found in drawn])
    assert num.max() <= 10 and num.mean() > 8.5


def test_in_order_on_the_route_and_as_the_engine_expects_them(drawn):
    for _, _, route, found in drawn:
        arm = [float(x.arm_s) for x in found]
        assert arm == sorted(arm)
        for scenario in found:
            assert 0.0 <= scenario.arm_s <= scenario.trigger_s < scenario.end_s
            assert 19.5 < scenario.trigger_s < route.length
            assert scenario.end_s <= route.length
            assert 0.0 < scenario.timeout_s < np.inf


def test_who_holds_lights_or_waits_for_nobody_has_the_road_for_itself(drawn):
    num = 0
    for *_, found in drawn:
        alone = [x for x in found if x.held_junction >= 0 or is_lawless(x).any()]
        others = [x for x in found if not any(x is y for y in alone)]
        num += len(alone)
        for i, one in enumerate(alone):
            for other in alone[:i]:
                later, sooner = max(one.trigger_s, other.trigger_s), min(one.end_s, other.end_s)
                assert later > sooner
            for other in others:
                for meet_s in other.others.meet_s[other.others.kind != KIND_NONE]:
                    assert abs(meet_s - one.cars.meet_s[0]) >= 40.0
    assert num > NUM_ROUTES  # more than one a route


def is_lawless(scenario):
    return (scenario.cars.model >= 0) & np.isin(scenario.cars.drive, (DRIVE_FLOW, DRIVE_MEET))


def test_held_junctions_lie_ahead_on_the_route(drawn):
    num = 0
    for town, first, route, found in drawn:
        lane = np.asarray(route.lane) - first.lane
        junction = town.junctions.junction[lane]
        for scenario in found:
            if scenario.held_junction < 0:
                continue
            num += 1
            s = np.asarray(route.s)
            ahead = (s > scenario.trigger_s) & (s < scenario.end_s)
            assert scenario.held_junction - first.junction in junction[ahead]
            held = scenario.held_green[scenario.held_green >= 0] - first.light
            assert len(held) > 0
            assert (town.lights.junction[held] == scenario.held_junction - first.junction).all()
            # The ego's own light is among them.
            own = town.lights.lane_light[lane[ahead]]
            assert np.isin(own[own >= 0], held).any()
    assert num > 50


def test_actors_that_there_are_come_first(drawn):
    """The engine gives rows to so many of them, counted from the first."""
    for _, _, _, found in drawn:
        for scenario in found:
            for there in (scenario.cars.model >= 0, scenario.others.kind != KIND_NONE):
                assert not (there[1:] & ~there[:-1]).any()


def test_cars_begin_on_a_way_of_lanes_that_follow_one_another(drawn):
    for town, first, _, found in drawn:
        for scenario in found:
            for number in np.flatnonzero(scenario.cars.model >= 0):
                lanes = scenario.cars.lanes[number]
                lanes = lanes[lanes >= 0] - first.lane
                for a, b in zip(lanes[:-1], lanes[1:], strict=True):
                    assert b in town.lanes.successors[a]
                assert 0.0 <= scenario.cars.s[number] <= town.lanes.length[lanes[0]]


def test_the_same_seed_gives_the_same(there):
    for number in range(4):
        one, again = (place_along(*draw(there, number)) for _ in range(2))
        assert len(one) == len(again) > 0
        jax.tree.map(np.testing.assert_array_equal, one, again)


@pytest.mark.parametrize("spacing", [50.0, 250.0])
def test_other_spacings(there, spacing):
    num = [len(place_along(*draw(there, number), spacing)) for number in range(8)]
    # Every stretch that begins before the last 60 m.
    most = int(np.ceil((LENGTH + 1 - generator.END_ROOM) / spacing))
    assert max(num) <= most and np.mean(num) > 0.5 * most


def test_only_the_kinds_asked_for(there):
    kinds = ("ControlLoss", "OppositeVehicleRunningRedLight")
    found = [x for number in range(8) for x in place_along(*draw(there, number), kinds=kinds)]
    assert {name(x) for x in found} == set(kinds)


def test_a_route_too_short_for_any_has_none(there):
    assert place_along(*draw(there, 0, length=60)) == ()


def test_banks_hold_them_padded(there):
    room = Population(2, 3, 0)
    bank = episodes.make_bank(there[:2], 4, room, 5, 600.0, 100.0)
    kind, arm = np.asarray(bank.scenarios.kind), np.asarray(bank.scenarios.arm_s)
    num = (kind >= 0).sum(axis=1)
    assert kind.shape[1] == num.max() > 2
    for row in range(4):
        assert (kind[row, : num[row]] >= 0).all() and (np.diff(arm[row, : num[row]]) >= 0).all()
        assert np.isinf(arm[row, num[row] :]).all()
    lanes = np.asarray(bank.scenarios.cars.lanes)
    towns_of = np.asarray(bank.road_map.lane_town)
    used = lanes >= 0
    routes_town = np.broadcast_to(np.asarray(bank.routes.town)[:, None, None, None], lanes.shape)
    assert (towns_of[lanes[used]] == routes_town[used]).all()
    for spacing in (None, 0.0):
        without = episodes.make_bank(there[:2], 4, room, 5, 600.0, spacing)
        assert (np.asarray(without.scenarios.kind) == -1).all()
        np.testing.assert_array_equal(without.routes.xy, bank.routes.xy)
