"""Who owes whom what inside a junction, lane by lane of the hand-made crossing."""

import dataclasses

import numpy as np
import pytest
from small_world import ARMS, crossing, inner, link, network, straight

from carljax.sim import junctions, lane_table, town
from carljax.sim.junctions import CONFLICT, CONFLICT_PRIORITY, CONFLICT_YIELD, FREE

WAYS = ("straight", "left", "right")


def owing(net):
    """A function that gives the code between lanes inside a junction, each an (arm, way)."""
    table = lane_table.build(net)
    found = junctions.build(net, table)

    def code(a, b):
        row_a, row_b = (table.raw_lane[inner(*x)] for x in (a, b))
        return int(found.conflict[row_a, found.slot[row_b]])

    return code


def turned(arm, quarters):
    """The arm that lies so many quarter turns to the left."""
    return ARMS[(ARMS.index(arm) + quarters) % 4]


@pytest.fixture(scope="module")
def plain():
    return owing(crossing())


@pytest.mark.parametrize("arm", ARMS)
def test_without_signs_crossing_lanes_conflict_as_equals(plain, arm):
    for quarters in (1, 3):
        other = turned(arm, quarters)
        assert plain((arm, "straight"), (other, "straight")) == CONFLICT


@pytest.mark.parametrize("arm", ARMS)
def test_lanes_that_leave_the_same_lane_do_not_conflict(plain, arm):
    for a in WAYS:
        for b in WAYS:
            assert plain((arm, a), (arm, b)) == FREE


@pytest.mark.parametrize("arm", ARMS)
def test_opposite_lanes_that_keep_apart_do_not_conflict(plain, arm):
    opposite = turned(arm, 2)
    # straight lanes run 3.5 m apart; the two left turns pass in front of one another: their circles
    # have centres (10, -10) and (-10, 10), 28.3 m apart, and radii of 11.75 m: a gap of 4.8 m.
    assert plain((arm, "straight"), (opposite, "straight")) == FREE
    assert plain((arm, "left"), (opposite, "left")) == FREE
    assert plain((arm, "right"), (opposite, "right")) == FREE


@pytest.mark.parametrize("arm", ARMS)
def test_merging_lanes_conflict(plain, arm):
    # Right from an arm ends where straight on from its left neighbour's opposite does.
    assert plain((arm, "right"), (turned(arm, 3), "straight")) == CONFLICT


@pytest.mark.parametrize("arm", ARMS)
def test_left_turns_yield_to_all_that_they_cross(plain, arm):
    opposite = turned(arm, 2)
    for other in (
        (opposite, "straight"),
        (opposite, "right"),  # both end on the same lane
        (turned(arm, 1), "straight"),
        (turned(arm, 3), "straight"),
    ):
        assert plain((arm, "left"), other) == CONFLICT_YIELD
        assert plain(other, (arm, "left")) == CONFLICT_PRIORITY


@pytest.mark.parametrize(
    ("signs", "priority"),
    [
        ({}, ()),
        ({"north": "stop", "south": "yield"}, ()),
        ({"east": "light", "north": "yield"}, ()),
        ({}, (("east", "north"), ("west", "north"))),
    ],
)
def test_codes_are_symmetric(signs, priority):
    owed = owing(crossing(signs, priority=priority))
    mirror = {
        FREE: FREE,
        CONFLICT: CONFLICT,
        CONFLICT_YIELD: CONFLICT_PRIORITY,
        CONFLICT_PRIORITY: CONFLICT_YIELD,
    }
    places = [(arm, way) for arm in ARMS for way in WAYS]
    codes = {(a, b): owed(a, b) for a in places for b in places}
    assert all(codes[b, a] == mirror[code] for (a, b), code in codes.items())
    assert len(set(codes.values())) == 4


@pytest.mark.parametrize("sign", ["stop", "yield"])
def test_signs_come_first(sign):
    owed = owing(crossing({"north": sign}, priority=[("north", "east")]))
    # the file's priority says the opposite, and so does the turn: the sign holds
    assert owed(("north", "straight"), ("east", "straight")) == CONFLICT_YIELD
    assert owed(("north", "straight"), ("east", "left")) == CONFLICT_YIELD
    assert owed(("west", "straight"), ("north", "straight")) == CONFLICT_PRIORITY


def test_a_light_gives_no_priority_by_itself():
    owed = owing(crossing({"north": "light"}))
    assert owed(("north", "straight"), ("east", "straight")) == CONFLICT


def test_two_signs_leave_it_to_who_comes_first():
    # An all-way stop: nobody owes, left turns neither.
    owed = owing(crossing(dict.fromkeys(ARMS, "stop")))
    assert owed(("north", "straight"), ("east", "straight")) == CONFLICT
    assert owed(("north", "left"), ("south", "straight")) == CONFLICT


def test_the_files_priorities_come_second():
    owed = owing(crossing(priority=[("east", "north")]))
    assert owed(("north", "straight"), ("east", "straight")) == CONFLICT_YIELD
    # a left turn on the road with priority goes before the other road
    assert owed(("east", "left"), ("north", "straight")) == CONFLICT_PRIORITY
    # and where the file says nothing the left turn yields
    assert owed(("south", "left"), ("west", "straight")) == CONFLICT_YIELD


def test_where_cars_keep_to_the_left_the_right_turn_yields():
    # Mirrored, what is called left here bends to the right.
    owed = owing(crossing(mirrored=True))
    assert owed(("east", "left"), ("west", "straight")) == CONFLICT_YIELD
    assert owed(("west", "straight"), ("east", "left")) == CONFLICT_PRIORITY
    assert owed(("east", "straight"), ("north", "straight")) == CONFLICT


def overpass(height):
    lanes = [
        straight((-10, 0), (10, 0), junction="9"),
        straight((0, -10), (0, 10), junction="9", z=height),
    ]
    net = network(lanes)
    return junctions.build(net, lane_table.build(net))


def test_an_overpass_does_not_conflict():
    assert overpass(0.0).conflict.tolist() == [[0, CONFLICT], [CONFLICT, 0]]
    assert overpass(6.0).conflict.tolist() == [[0, 0], [0, 0]]


@pytest.mark.parametrize(("apart", "code"), [(2.5, CONFLICT), (2.7, FREE)])
def test_lanes_conflict_where_two_cars_cannot_pass(apart, code):
    lanes = [straight((0, y), (20, y), junction="9") for y in (0, apart)]
    net = network(lanes)
    assert junctions.build(net, lane_table.build(net)).conflict[0, 1] == code


def yield_s(net, way):
    table = lane_table.build(net)
    return junctions.build(net, table).yield_s[table.raw_lane[inner("west", way)]]


def test_a_lane_is_clear_up_to_the_first_lane_it_has_to_mind():
    # Straight on from the west reaches 2.6 m before the lane from the north, at x = -1.75, after
    # 10 - 1.75 - 2.6 = 5.65 m; its points lie at whole metres.
    assert yield_s(crossing(), "straight") == 6.0
    # A left turn runs on a circle of 11.75 m around (-10, 10) and meets first the one from the
    # south, around (-10, -10). They are 2.6 m apart where 11.75^2 + 20^2 - 2 * 20 * 11.75 cos t =
    # 9.15^2: t = 0.2587, after 3.04 m; it is 18.46 m long in 19 pieces of 0.971 m.
    assert yield_s(crossing(), "left") == pytest.approx(4 * 18.4568 / 19, abs=1e-3)


def test_behind_lights_only_a_turn_across_oncoming_traffic_has_to_mind_anybody():
    lights = crossing(dict.fromkeys(ARMS, "light"), [("east", "west"), ("north", "south")])
    # The oncoming lane lies at y = 1.75: 10 - 11.75 cos t = 1.75 - 2.6, t = 0.394, after 4.63 m.
    assert yield_s(lights, "left") == pytest.approx(5 * 18.4568 / 19, abs=1e-3)
    assert yield_s(lights, "straight") == np.inf and yield_s(lights, "right") == np.inf


def test_whoever_has_priority_has_to_mind_nobody():
    assert yield_s(crossing({"north": "stop", "south": "stop"}), "straight") == np.inf


def test_lanes_of_different_junctions_never_conflict():
    lanes = [
        straight((-10, 0), (10, 0), junction="9"),
        straight((0, -10), (0, 10), junction="8"),
        straight((-10, 5), (10, 5)),
    ]
    net = network(link(lanes, []))
    table = lane_table.build(net)
    found = junctions.build(net, table)
    assert found.conflict.tolist() == [[0], [0], [0]]
    assert found.junction.tolist() == [1, 0, -1]


def test_turn_of_a_lane():
    table = lane_table.build(crossing())
    turns = [junctions.turn(table, table.raw_lane[inner("west", way)]) for way in WAYS]
    np.testing.assert_allclose(turns, [0, np.pi / 2, -np.pi / 2], atol=1e-9)


def test_slots_number_the_lanes_of_a_junction():
    net = crossing()
    other = dataclasses.replace(net, lanes=net.lanes)
    found = town.from_network(other).junctions
    inside = found.junction >= 0
    assert inside.sum() == 12 and sorted(found.slot[inside]) == list(range(12))
    assert found.conflict.shape == (20, 12)
    assert not found.conflict[~inside].any()
