"""Scenarios of files on a straight road of 200 m: placed, moved or refused for the right reason."""

from __future__ import annotations

import numpy as np
import pytest
from small_world import WIDTH, crossing, link, network, road, straight

from carljax.sim import route_assembly, town
from carljax.sim.leaderboard_files import Trigger
from carljax.sim.route_assembly import Segment
from carljax.sim.scenarios import from_file, registry
from carljax.sim.scenarios import site as site_module
from carljax.sim.scenarios.from_file import Stage
from carljax.sim.scenarios.script import DRIVE_FLOW

BLOCKED = 100.0  # m, where "Picky" finds no room
PICKY_MARGIN = 5.0


def anywhere(site, rng):
    return site_module.blank(site, site.trigger_s + 20.0, 10.0)


def picky(site, rng):
    return None if abs(site.trigger_s - BLOCKED) < PICKY_MARGIN else anywhere(site, rng)


def never(site, rng):
    return None


def late(site, rng):
    return None if site.trigger_s < 400.0 else anywhere(site, rng)


def with_cars(site, rng):
    scenario = anywhere(site, rng)
    scenario.cars.model[0], scenario.cars.drive[0] = 0, DRIVE_FLOW
    return scenario


@pytest.fixture(autouse=True)
def kinds(monkeypatch):
    """Kinds of scenarios that are easy to foresee."""
    place = {"Anywhere": anywhere, "Picky": picky, "Never": never, "Cars": with_cars, "Late": late}
    place["ControlLoss"] = anywhere
    place["NonSignalizedJunctionLeftTurn"] = never
    place["NonSignalizedJunctionRightTurn"] = anywhere
    monkeypatch.setattr(registry, "PLACE", place)
    monkeypatch.setattr(registry, "KINDS", tuple(place))


@pytest.fixture(scope="module")
def stage():
    """A route from x = 0 to 200 m; the town's middle is at x = 100, the file's is at 0."""
    there = town.from_network(road(0, 200))
    first = town.offsets([there, there])[1]
    route = route_assembly.assemble(there, first, [Segment(0, 0.0, 200.0)])
    return Stage(there, first, route, "5")


def trigger(x, y=0.0, yaw=0.0, type="Anywhere", name="t", parameters=()):
    return Trigger(type, name, np.array([x, y], float), float(yaw), parameters)


def place_one(stage, one):
    """The scenario of a trigger, or None, and its placement."""
    scenarios, (placement,) = from_file.place_all(stage, [[one]], (0,))
    return (scenarios[0] if scenarios else None), placement


def test_a_trigger_is_placed_at_the_nearest_point_of_the_route(stage):
    scenario, placement = place_one(stage, trigger(60.2, 3.0, parameters=("distance",)))
    assert float(scenario.trigger_s) == pytest.approx(60.0)
    assert int(scenario.kind) == registry.KINDS.index("Anywhere")
    assert placement.trigger_s == pytest.approx(60.0)
    # from (60.2, 3) to (60, 0): sqrt(0.04 + 9)
    assert placement.away == pytest.approx(np.sqrt(9.04), abs=1e-4)
    expected = ("5", "t", "Anywhere", "Anywhere", "", ("distance",))
    got = placement.route, placement.name, placement.type, placement.kind, placement.reason
    assert (*got, placement.parameters) == expected


@pytest.mark.parametrize(
    ("one", "reason"),
    [
        (trigger(60, 14.5), "lies 14.5 m off the route"),
        (trigger(240, 0), "lies 40.0 m off the route"),
        (trigger(60, 3.0, yaw=np.pi), "the route does not go its way there"),
        (trigger(60, 3.0, yaw=np.radians(50)), "the route does not go its way there"),
        (trigger(60, type="Unheard"), "there is no such kind of scenario here"),
        (trigger(60, type="Never"), "does not suit the route there, 140 m before its end"),
        (trigger(60, type="Scenario99"), "there is no such kind of scenario here"),
    ],
)
def test_what_is_not_placed_is_reported_with_the_reason(stage, one, reason):
    scenario, placement = place_one(stage, one)
    assert scenario is None
    assert (placement.kind, placement.reason) == ("", reason)
    assert np.isnan(placement.trigger_s)


def test_a_trigger_that_does_not_suit_is_moved_to_the_nearest_place_that_does(stage):
    # Points every 2 m are tried, those before first: 98, 102, 96, 104; 94 is the first 5 m away.
    scenario, placement = place_one(stage, trigger(BLOCKED, type="Picky"))
    assert float(scenario.trigger_s) == pytest.approx(94.0)
    assert placement.away == pytest.approx(6.0)


def test_types_of_version_1_have_the_names_of_version_2(stage):
    scenario, placement = place_one(stage, trigger(60, type="Scenario1"))
    assert int(scenario.kind) == registry.KINDS.index("ControlLoss")
    assert (placement.type, placement.kind) == ("Scenario1", "ControlLoss")
    # Where a type became two kinds, that which suits is taken.
    assert place_one(stage, trigger(60, type="Scenario10"))[1].kind == (
        "NonSignalizedJunctionRightTurn"
    )


def test_scenarios_that_need_the_same_road_are_not_placed_at_once(stage):
    # The first plays from 60 to 80 m; the second could begin between 60 and 80 m.
    groups = [[trigger(60, type="Cars", name="a")], [trigger(70, type="Cars", name="b")]]
    scenarios, placements = from_file.place_all(stage, groups, (0,))
    assert [p.kind for p in placements] == ["Cars", ""]
    assert placements[1].reason == "another scenario needs the road at the same time"
    assert len(scenarios) == 1
    groups[1] = [trigger(150, type="Cars", name="b")]
    assert len(from_file.place_all(stage, groups, (0,))[0]) == 2


def test_scenarios_come_in_order_of_the_route(stage):
    groups = [[trigger(x)] for x in (150, 30, 90)]
    scenarios, placements = from_file.place_all(stage, groups, (0,))
    assert [float(s.trigger_s) for s in scenarios] == [30.0, 90.0, 150.0]
    assert [p.trigger_s for p in placements] == [150.0, 30.0, 90.0]


def test_a_towns_triggers_are_a_routes_where_they_lie_on_it(stage):
    triggers = [
        trigger(60, 0.0, name="on"),
        trigger(60, 1.0, name="same place"),
        trigger(60, 2.5, name="beside"),
        trigger(100, 0.0, yaw=np.radians(11), name="turned"),
        trigger(100, 0.0, yaw=np.radians(-9), name="almost straight"),
    ]
    groups = from_file.on_route(stage, triggers)
    assert [[t.name for t in group] for group in groups] == [
        ["on", "same place"],
        ["almost straight"],
    ]


def test_of_triggers_at_one_place_one_is_drawn(stage):
    group = [trigger(60, name=name) for name in "abc"] + [trigger(60, type="Never", name="d")]
    drawn = set()
    for seed in range(20):
        scenarios, placements = from_file.place_all(stage, [group], (seed,))
        assert len(scenarios) == 1 and len(placements) == 4
        (name,) = [p.name for p in placements if p.kind]
        drawn.add(name)
        for placement in placements:
            if not placement.kind and placement.name != "d":
                assert placement.reason == f"{name} was drawn for this place"
    assert drawn == {"a", "b", "c"}
    again = [from_file.place_all(stage, [group], (7,))[1] for _ in range(2)]
    assert [p.name for p in again[0]] == [p.name for p in again[1]]


def test_a_route_that_passes_twice_may_use_the_second_pass():
    corners = [(0, 0), (100, 0), (100, 100), (0, 100)]
    sides = [
        straight(corners[k], corners[(k + 1) % 4], speed_limit=10.0 + k, road_id=str(k))
        for k in range(4)
    ]
    there = town.from_network(network(link(sides, [(k, (k + 1) % 4) for k in range(4)])))
    first = town.offsets([there])[0]
    lap = [Segment(k, 0.0, 100.0) for k in range(4)]
    # From (20, 0) once round and on to (90, 0): (70, 0) is passed at 50 m and at 450 m.
    route = route_assembly.assemble(
        there, first, [Segment(0, 20.0, 100.0), *lap[1:], Segment(0, 0.0, 90.0)]
    )
    here = Stage(there, first, route, "0")
    assert float(place_one(here, trigger(70.0))[0].trigger_s) == pytest.approx(50.0)
    assert float(place_one(here, trigger(70.0, type="Late"))[0].trigger_s) == pytest.approx(450.0)


def test_the_refusal_at_a_junction_says_which(monkeypatch):
    monkeypatch.setitem(registry.PLACE, "SignalizedJunctionLeftTurn", never)
    there = town.from_network(crossing())
    first = town.offsets([there])[0]
    west, inside = there.lanes.raw_lane[[4, 8 + 3 * 2]]  # approach from the west, straight on
    onward = int(there.lanes.successors[inside][0])
    route = route_assembly.assemble(
        there, first, [Segment(int(west), 0.0, 80.0), Segment(int(inside), 0.0, 20.0),
                       Segment(onward, 0.0, 40.0)]
    )  # fmt: skip
    one = trigger(-40, -WIDTH / 2, type="SignalizedJunctionLeftTurn")
    _, placement = place_one(Stage(there, first, route, "0"), one)
    assert placement.reason.startswith(
        "does not suit the junction ahead, which has no lights, has the route go straight"
    )
    _, placement = place_one(
        Stage(there, first, route, "0"), trigger(40, -WIDTH / 2, type=one.type)
    )
    assert placement.reason == "there is no junction ahead that the route passes"
