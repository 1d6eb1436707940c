"""carljax-36: what its routes are like, and that they are always the same."""

from __future__ import annotations

import collections

import jax
import numpy as np
import pytest

from carljax import benchmark
from carljax.sim import town as town_module
from carljax.sim import towns
from carljax.sim.scenarios import registry


@pytest.fixture(scope="module")
def loaded():
    return benchmark.load_towns()


@pytest.fixture(scope="module")
def journeys(loaded):
    return benchmark.journeys(loaded)


def test_36_routes_shared_among_all_bundled_towns(journeys, loaded):
    assert [town.network.name for town in loaded] == list(towns.TRAINING + towns.HELD_OUT)
    assert sorted(benchmark.town_names()) == list(towns.names())
    number = collections.Counter(int(journey.route.town) for journey in journeys)
    assert sum(number.values()) == 36
    assert set(number) == set(range(len(loaded)))
    assert max(number.values()) - min(number.values()) <= 1


def test_routes_are_as_long_as_in_longest6_and_as_full(journeys):
    # The route's own length counts the way aside in a lane change, 3.5 m less 1 m each.
    lengths = np.array([float(journey.route.length) for journey in journeys])
    assert (lengths >= 999.0).all() and (lengths <= 2040.0).all()
    assert lengths.std() > 150.0
    scenarios = np.array([len(journey.scenarios) for journey in journeys])
    assert (scenarios >= 5).all() and (scenarios <= 21).all()
    kinds = {registry.KINDS[int(s.kind)] for journey in journeys for s in journey.scenarios}
    assert kinds <= set(benchmark.KINDS)
    assert len(kinds) >= 6


def test_the_kinds_are_those_that_there_are():
    assert len(set(benchmark.KINDS)) == 9
    assert set(benchmark.KINDS) <= set(registry.KINDS)


def test_the_routes_are_all_different_and_the_same_every_time(journeys, loaded):
    assert len({journey.route.xy.tobytes() for journey in journeys}) == 36
    firsts = town_module.offsets(loaded)
    for number in (0, len(loaded), 35):
        at = number % len(loaded)
        again = benchmark._journey(loaded[at], firsts[at], number)
        jax.tree.map(np.testing.assert_array_equal, again.route, journeys[number].route)
        for one, other in zip(again.scenarios, journeys[number].scenarios, strict=True):
            jax.tree.map(np.testing.assert_array_equal, one, other)


def test_scenarios_lie_on_their_route_in_order(journeys):
    for journey in journeys:
        trigger = [float(scenario.trigger_s) for scenario in journey.scenarios]
        armed = [float(scenario.arm_s) for scenario in journey.scenarios]
        assert armed == sorted(armed)
        assert all(0.0 < s < float(journey.route.length) for s in trigger)
