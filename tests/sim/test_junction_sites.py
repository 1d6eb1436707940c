"""Where scenarios at junctions are placed: geometry and timing by hand on the small crossing.

The ego comes from the west along y = -1.75 and enters the crossing at x = -10, 80 m on its route.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from small_world import (
    ARMS,
    approach,
    arc,
    crossing,
    inner,
    leaving,
    link,
    network,
    straight,
)

from carljax.sim import population, route_assembly, town
from carljax.sim.lights import CLEARING_S
from carljax.sim.road_network import Junction
from carljax.sim.route_assembly import Segment
from carljax.sim.scenarios import actors, junction_flow, registry, script
from carljax.sim.scenarios import site as site_module
from carljax.sim.scenarios.script import DRIVE_FLOW, DRIVE_MEET
from carljax.sim.scenarios.site import Site
from carljax.sim.town import Offsets
from carljax.sim.types import SIGNAL_EMERGENCY

LIMIT = 10.0  # m/s
FIRST = Offsets(town=3, lane=1000, point=5000, light=70, junction=30, walk=0)
LIT = town.from_network(
    crossing(signs=dict.fromkeys(ARMS, "light"), groups=(("east", "west"), ("north",), ("south",)))
)
UNLIT = town.from_network(crossing())
ENTRY = 80.0
# Left: an arc of radius 11.75 about (-10, 10) from (-10, -1.75). It comes to the oncoming lane's
# y = 1.75 where 10 - 11.75 cos a = 1.75: a = acos(8.25 / 11.75) = 0.79236, after 9.310 m of arc, at
# x = -10 + 11.75 sin a = -1.634. The oncoming way begins at x = 90, so that is 91.634 m along it.
LEFT_MEET, ONCOMING_MEET = ENTRY + 9.310, 91.634
# Right: an arc of radius 8.25 about (-10, -10) that ends at (-1.75, -10), on the way of those from
# the north at x = -1.75. The two are 1 m apart where 8.25 cos b = 7.25, cos b counted from that
# end: b = acos(0.87879) = 0.49754, so after 8.25 (pi / 2 - b) = 8.854 m of arc, at
# y = -10 + 8.25 sin b = -6.063: on the way, from y = 90, 96.063 m.
RIGHT_MEET, FROM_LEFT_MEET = ENTRY + 8.854, 96.063
# Straight: those from the south drive north along x = 1.75, those from the north along x = -1.75.
# 80 + 11.75 m and 80 + 8.25 m of route; both ways begin 90 m from the middle: at y = -1.75 those
# from the south have come 88.25 m, those from the north 91.75 m.
NEAR = 0.75  # m: the lines are points a metre apart


def row(there, lane):
    return int(there.lanes.raw_lane[lane])


def make_site(there, way, index=10):
    """On the route from the west: the approach, a way through the crossing and its exit."""
    out = ARMS[(2 + {"straight": 2, "left": 3, "right": 1}[way]) % 4]
    lanes = [row(there, x) for x in (approach("west"), inner("west", way), leaving(out))]
    segments = [Segment(lane, 0.0, float(there.lanes.length[lane])) for lane in lanes]
    return Site(there, FIRST, route_assembly.assemble(there, FIRST, segments), index)


def placed(kind, there, way, seed=0):
    return registry.place(kind, make_site(there, way), np.random.default_rng(seed))


@pytest.mark.parametrize(
    ("way", "turn", "length"),
    [
        ("left", np.pi / 2, 11.75 * np.pi / 2),
        ("right", -np.pi / 2, 8.25 * np.pi / 2),
        ("straight", 0.0, 20.0),
    ],
)
def test_the_next_junction_is_where_the_route_goes_through_it(way, turn, length):
    site = make_site(UNLIT, way)
    found = site_module.next_junction(site)
    assert found.junction == 0
    assert found.way == way
    assert found.turn == pytest.approx(turn, abs=0.1)  # between points 1 m apart
    assert found.yaw == pytest.approx(0.0, abs=1e-3)
    assert found.entry_s == pytest.approx(ENTRY, abs=1.0)
    assert found.exit_s == pytest.approx(ENTRY + length, abs=1.1)
    assert found.approach == row(UNLIT, approach("west"))
    assert found.lanes == (row(UNLIT, inner("west", way)),)
    # Beyond it there is none, nor is there from inside of it.
    for index in (found.entry + 2, found.exit + 1):
        assert site_module.next_junction(make_site(UNLIT, way, index)) is None


def test_arms_and_ways_through_follow_the_lanes():
    lane = row(UNLIT, inner("east", "straight"))
    assert site_module.arm(UNLIT, lane, 50.0, 3) == (row(UNLIT, approach("east")),)
    assert site_module.arm(UNLIT, lane, 500.0, 3) == (row(UNLIT, approach("east")),)
    assert site_module.through(UNLIT, lane) == (lane, row(UNLIT, leaving("west")))
    lanes = [row(UNLIT, x) for x in (approach("east"), inner("east", "straight"))]
    path = site_module.way(UNLIT, lanes)
    assert path.length == pytest.approx(100.0)
    np.testing.assert_allclose(path.xy[:, 0], 90.0 - path.s, atol=1e-6)
    np.testing.assert_allclose(path.xy[:, 1], 1.75, atol=1e-6)


def test_a_short_arm_goes_on_straight_through_the_junction_before():
    # From x = -60 a road of 30 m, a junction of 10 m, a road of 20 m and the junction in question;
    # into the first junction's exit there also leads a bend from the side.
    lanes = [
        straight((-60, 0), (-30, 0)),
        straight((-30, 0), (-20, 0), junction="1"),
        straight((-20, 0), (0, 0)),
        straight((0, 0), (20, 0), junction="2"),
        arc((-30, 10), -np.pi / 2, 10.0, np.pi / 2, junction="1"),
    ]
    junction_of = [Junction("1", (), (1, 4)), Junction("2", (), (3,))]
    pairs = [(0, 1), (1, 2), (2, 3), (4, 2)]
    there = town.from_network(network(link(lanes, pairs), junctions=junction_of))
    road, through, last, lane = (row(there, x) for x in range(4))
    for reach, most, wanted in (
        (15.0, 3, (last,)),
        (25.0, 3, (through, last)),
        (31.0, 3, (road, through, last)),
        (99.0, 3, (road, through, last)),
        (99.0, 2, (through, last)),
    ):
        assert site_module.arm(there, lane, reach, most) == wanted


def test_cars_keep_to_their_way_beyond_the_lanes_they_plan():
    way_lanes = jnp.array([[4, 7, 2, 9, 5], [4, 7, 2, -1, -1], [4, 7, 2, 9, 5]], jnp.int32)
    blank = script.nothing(1).cars
    cars = population.nobody(3).replace(
        lanes=jnp.array([[7, 2, 1], [7, 2, 1], [6, 3, 1]], jnp.int32)
    )
    found = actors.way_on(cars, blank.replace(lanes=way_lanes))
    # The first goes on to 9; the second's way is known no further, the third is on no way.
    np.testing.assert_array_equal(found, [[7, 2, 9], [7, 2, 1], [6, 3, 1]])
    at_end = population.nobody(1).replace(lanes=jnp.array([[5, 3, 1]], jnp.int32))
    found = actors.way_on(at_end, blank.replace(lanes=way_lanes[:1]))
    np.testing.assert_array_equal(found, [[5, 3, 1]])


def test_place_at_takes_the_nearest_point():
    site = make_site(UNLIT, "straight")
    for s, index in ((0.0, 0), (10.4, 10), (10.6, 11), (-5.0, 0), (1e4, 180)):
        assert site_module.place_at(site, s).index == index
    place = site_module.place_at(site, 30.0)
    np.testing.assert_allclose(place.xy, [-60.0, -1.75], atol=1e-4)
    assert place.lane == row(UNLIT, approach("west"))
    assert place.lane_s == pytest.approx(30.0, abs=1e-3)


@pytest.mark.parametrize(
    ("way", "side", "arm", "meet_s", "meet_lane_s"),
    [
        ("left", np.pi, "east", LEFT_MEET, ONCOMING_MEET),
        ("right", -np.pi / 2, "north", RIGHT_MEET, FROM_LEFT_MEET),
        ("straight", -np.pi / 2, "north", ENTRY + 8.25, 91.75),
        ("straight", np.pi / 2, "south", ENTRY + 11.75, 88.25),
        ("left", np.pi / 2, "south", None, None),
    ],
)
def test_ways_meet_where_their_lines_do(way, side, arm, meet_s, meet_lane_s):
    site = make_site(UNLIT, way)
    (found,) = junction_flow.cross_ways(site, site_module.next_junction(site), side)
    assert found.way.lanes[0] == row(UNLIT, approach(arm))
    assert found.entry == pytest.approx(80.0)
    assert found.exit == pytest.approx(100.0)
    if meet_s is not None:
        assert found.meet_s == pytest.approx(meet_s, abs=NEAR)
        assert found.meet_lane_s == pytest.approx(meet_lane_s, abs=NEAR)


def test_nobody_oncoming_is_in_the_way_of_who_goes_straight_on():
    site = make_site(UNLIT, "straight")
    assert junction_flow.cross_ways(site, site_module.next_junction(site), np.pi) == []


@pytest.mark.parametrize(
    ("kind", "there", "way", "arm", "speeds", "meeting"),
    [
        ("SignalizedJunctionLeftTurn", LIT, "left", "east", (7, 19), (LEFT_MEET, ONCOMING_MEET)),
        (
            "SignalizedJunctionRightTurn",
            LIT,
            "right",
            "north",
            (7, 18),
            (RIGHT_MEET, FROM_LEFT_MEET),
        ),
        (
            "NonSignalizedJunctionLeftTurn",
            UNLIT,
            "left",
            "east",
            (7, 19),
            (LEFT_MEET, ONCOMING_MEET),
        ),
        (
            "NonSignalizedJunctionRightTurn",
            UNLIT,
            "right",
            "north",
            (7, 18),
            (RIGHT_MEET, FROM_LEFT_MEET),
        ),
    ],
)
def test_a_stream_meets_an_ego_at_the_limit(kind, there, way, arm, speeds, meeting):
    for seed in range(20):
        scenario = placed(kind, there, way, seed)
        cars = scenario.cars
        used = cars.model >= 0
        num = int(used.sum())
        assert num >= 2 and used[:num].all()
        lanes = [approach(arm), inner(arm, "straight"), leaving(ARMS[(ARMS.index(arm) + 2) % 4])]
        way_lanes = [*(FIRST.lane + row(there, lane) for lane in lanes), -1, -1]
        assert (cars.lanes[:num] == way_lanes).all()
        assert (cars.drive[:num] == DRIVE_FLOW).all() and cars.from_trigger[:num].all()
        speed = float(cars.speed[0])
        assert (cars.speed[:num] == cars.speed[0]).all() and speeds[0] <= speed <= speeds[1]
        np.testing.assert_allclose(cars.meet_s[:num], meeting[0], atol=NEAR)
        np.testing.assert_allclose(cars.meet_lane_s[:num], meeting[1], atol=NEAR)
        # From 65 m up the arm at least, unless the arm, of 80 m, has to be long enough for 4 or
        # 5 s of way; the exit is 80 m long too.
        assert (80.0 - cars.s[:num] >= 65.0 - 1e-3).all() and (cars.s[:num] >= 4.0).all()
        assert (cars.travel[:num] > 100.0).all() and (cars.travel[:num] <= 180.0).all()
        follow = np.diff(cars.delay[:num]) * speed
        assert (follow >= 15.0 - 1e-3).all() and (follow <= 60.0 + 1e-3).all()
        # The gap that is long enough to go comes after the last car of a round.
        rest = cars.travel[0] - cars.s[0] - follow.sum()
        assert rest >= max(60.0, 6.2 * speed) - 1e-2
        # An ego at 10 m/s is at the meeting place with one of them, if they can be there in time.
        ego_s = (float(cars.meet_s[0]) - float(scenario.trigger_s)) / LIMIT
        at = cars.delay[:num] + (cars.meet_lane_s[:num] - cars.s[:num]) / speed
        if scenario.trigger_s > 0.0 and ego_s >= at[0] - 1e-3:
            assert np.abs(at - ego_s).min() < 1e-3
        assert scenario.timeout_s == 240.0
        crossing_end = site_module.next_junction(make_site(there, way)).exit_s
        assert scenario.end_s == pytest.approx(crossing_end + 10.0)
        assert scenario.arm_s <= scenario.trigger_s < scenario.end_s


def test_lights_are_green_for_the_ego_and_the_stream():
    # From the west to the north: the oncoming east has the same light, row 0.
    left = placed("SignalizedJunctionLeftTurn", LIT, "left")
    assert left.held_junction == FIRST.junction
    assert left.held_green.tolist() == [FIRST.light, -1]
    # To the south: those from the north have a light of their own, row 1.
    right = placed("SignalizedJunctionRightTurn", LIT, "right")
    assert right.held_green.tolist() == [FIRST.light, FIRST.light + 1]
    for kind, way in (("Left", "left"), ("Right", "right")):
        scenario = placed(f"NonSignalizedJunction{kind}Turn", UNLIT, way)
        assert scenario.held_junction == -1 and (scenario.held_green == -1).all()


@pytest.mark.parametrize(
    ("kind", "there", "way"),
    [
        ("SignalizedJunctionLeftTurn", UNLIT, "left"),
        ("SignalizedJunctionRightTurn", UNLIT, "right"),
        ("NonSignalizedJunctionLeftTurn", LIT, "left"),
        ("NonSignalizedJunctionRightTurn", LIT, "right"),
        ("SignalizedJunctionLeftTurn", LIT, "right"),
        ("SignalizedJunctionRightTurn", LIT, "straight"),
        ("NonSignalizedJunctionLeftTurn", UNLIT, "straight"),
        ("OppositeVehicleRunningRedLight", UNLIT, "straight"),
    ],
)
def test_what_does_not_suit_is_not_placed(kind, there, way):
    assert all(placed(kind, there, way, seed) is None for seed in range(5))


def test_without_a_junction_ahead_nothing_is_placed():
    for kind in ("SignalizedJunctionLeftTurn", "OppositeVehicleRunningRedLight"):
        site = make_site(LIT, "left", index=110)
        assert registry.place(kind, site, np.random.default_rng(0)) is None


def test_the_car_at_red_comes_from_either_side_in_time():
    arms = {"north": (ENTRY + 8.25, 91.75), "south": (ENTRY + 11.75, 88.25)}
    count = dict.fromkeys(arms, 0)
    for seed in range(60):
        scenario = placed("OppositeVehicleRunningRedLight", LIT, "straight", seed)
        cars = scenario.cars
        assert (cars.model >= 0).tolist() == [True, False, False, False]
        (arm,) = [a for a in arms if cars.lanes[0, 0] == FIRST.lane + row(LIT, approach(a))]
        count[arm] += 1
        assert cars.lanes[0, 1] == FIRST.lane + row(LIT, inner(arm, "straight"))
        assert cars.drive[0] == DRIVE_MEET and cars.signals[0] == SIGNAL_EMERGENCY
        np.testing.assert_allclose((cars.meet_s[0], cars.meet_lane_s[0]), arms[arm], atol=NEAR)
        # Only the ego's light, row 0, is green; the arms to the north and south have rows 1 and 2.
        assert scenario.held_junction == FIRST.junction
        assert scenario.held_green.tolist() == [FIRST.light, -1]
        # It drives 65 + 8.25 or 65 + 11.75 m at 60 km/h; the ego, at 10 m/s, takes 0.9 to 1.4 times
        # as long, where the route is long enough before the crossing.
        assert cars.delay[0] == CLEARING_S and cars.s[0] == pytest.approx(15.0)
        time = (cars.meet_lane_s[0] - cars.s[0]) / (60.0 / 3.6)
        ego_s = (cars.meet_s[0] - scenario.trigger_s) / LIMIT - CLEARING_S
        if scenario.trigger_s > 0.0:
            assert 0.9 * time - 0.1 <= ego_s <= 1.4 * time + 0.1
        assert scenario.end_s > scenario.cars.meet_s[0] > scenario.trigger_s
    assert min(count.values()) > 18  # 30 expected, standard deviation sqrt(60) / 2 = 3.9
