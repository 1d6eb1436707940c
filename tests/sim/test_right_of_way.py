"""Who goes first: agents among each other, and the ego among them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_world import approach
from traffic_world import (
    ALL,
    DT,
    EGO_LENGTH,
    STEPS,
    cars,
    ego_place,
    enters_at,
    f32,
    gap_to_end,
    is_gated,
    make_ego,
    overlaps_jit,
)

from carljax.sim import situation
from carljax.sim.route import WINDOW, Route

# Who goes first


@pytest.mark.parametrize("late", [-20.0, -8.0, -3.0, -0.5, 0.0, 0.5, 3.0, 8.0, 20.0])
@pytest.mark.parametrize("ways", [("straight", "straight"), ("right", "straight")])
def test_of_two_equals_who_comes_first_goes_first_and_they_never_touch(world, late, ways):
    # From the east and from its left, at 7 m/s; one is `late` metres farther away.
    first = world.way("plain", "east", ways[0])
    second = world.way("plain", "south", ways[1])
    path = world.run(
        cars(
            world,
            {"lanes": first, "lane_s": 30.0, "speed": 7.0, "desired_speed_frac": 0.7},
            {"lanes": second, "lane_s": 30.0 - late, "speed": 7.0, "desired_speed_frac": 0.7},
        )
    )
    assert not overlaps_jit(path).any()
    entered = [enters_at(path, 0, first[0]), enters_at(path, 1, second[0])]
    assert max(entered) < STEPS - 20  # both have gone
    if abs(late) > 2.0 and ways[0] == ways[1]:
        assert np.argmin(entered) == (0 if late > 0 else 1)
    if abs(late) < 4.0:  # they would have met
        assert abs(entered[0] - entered[1]) > 15


@pytest.mark.parametrize(("oncoming", "first"), [(10.0, 0), (34.0, 1), (42.0, 1), (50.0, 1)])
def test_a_left_turn_yields_to_oncoming_traffic_that_is_near(world, oncoming, first):
    # The one who turns is 20 m from the junction at 5 m/s, there in 4 s. Oncoming traffic at 8 m/s
    # is then 80 - s - 2 - 32 m away: less than 4 s = 32 m, it goes first.
    turning = world.way("plain", "east", "left")
    straight = world.way("plain", "west", "straight")
    path = world.run(
        cars(
            world,
            {"lanes": turning, "lane_s": 58.0, "speed": 5.0, "desired_speed_frac": 0.5},
            {"lanes": straight, "lane_s": oncoming, "speed": 8.0, "desired_speed_frac": 0.8},
        )
    )
    assert not overlaps_jit(path).any()
    entered = [enters_at(path, 0, turning[0]), enters_at(path, 1, straight[0])]
    assert max(entered) < STEPS and int(np.argmin(entered)) == first


def test_main_road_traffic_does_not_slow_for_one_who_has_a_sign(world):
    main, side = world.way("signs", "east", "straight"), world.way("signs", "north", "straight")
    path = world.run(
        cars(
            world,
            {"lanes": main, "lane_s": 10.0, "speed": 8.0, "desired_speed_frac": 0.8},
            {"lanes": side, "lane_s": 50.0, "speed": 6.0},
        )
    )
    assert path.speed[: enters_at(path, 0, main[0]), 0].min() > 7.5
    assert enters_at(path, 1, side[0]) > enters_at(path, 0, main[0])
    assert not overlaps_jit(path).any()


@pytest.mark.parametrize(
    ("front", "waits"),
    [
        (-1.5, True),  # its front is 1.5 m inside, its centre still outside
        (-2.5, True),  # its centre is inside too
        (9.0, False),  # 9 m away and stopping
    ],
)
def test_nobody_enters_while_another_is_on_its_way_in(world, front, waits):
    # The first has priority over the second, which stands at its sign but for its front bumper.
    main, side = world.way("signs", "east", "straight"), world.way("signs", "north", "straight")
    if front < -2.0:
        other = {"lanes": (*side[1:], -1), "lane_s": -front - 2.0}
    else:
        other = {"lanes": side, "lane_s": 80.0 - 2.0 - front}
    mine = {"lanes": main, "lane_s": 70.0, "speed": 5.0}
    assert is_gated(world, cars(world, mine, other | {"speed": 1.0})) == waits


@pytest.mark.parametrize(("speed", "waits"), [(8.0, True), (0.0, False)])
def test_a_lawless_car_goes_first_but_not_while_it_stands_in_a_queue(world, speed, waits):
    # The first has priority by its sign; the other, 6 m from the junction, minds no sign.
    main, side = world.way("signs", "east", "straight"), world.way("signs", "north", "straight")
    mine = {"lanes": main, "lane_s": 77.0, "speed": 0.0}
    other = {"lanes": side, "lane_s": 80.0 - 2.0 - 6.0, "speed": speed, "is_lawless": True}
    assert is_gated(world, cars(world, mine, other | {"cruise_speed": 10.0})) == waits


def test_two_that_wait_for_one_another_get_going(world):
    # All four arms at once, at rest before the junction: each has another on its right and left.
    specs = [
        {"lanes": world.way("plain", arm, "straight"), "lane_s": 77.0, "speed": 0.0} for arm in ALL
    ]
    path = world.run(cars(world, *specs))
    assert not overlaps_jit(path).any()
    assert all(enters_at(path, k, spec["lanes"][0]) < STEPS for k, spec in enumerate(specs))


def test_a_turn_across_a_stream_is_made_at_yellow(world):
    # 5 s of green are left. One waits to turn left; oncoming at 8 m/s are one car 20 m before the
    # junction, which it enters after 2.5 s and leaves after 5.3 s, and one 52 m before it, which is
    # within 4 s from 2.5 s on and stops at yellow: it is then 12 m away and needs 64 / 6 = 10.7 m.
    start, _ = world.light("east")
    turning = world.way("lights", "east", "left")
    oncoming = {"lanes": world.way("lights", "west", "straight"), "speed": 8.0}
    path = world.run(
        cars(
            world,
            {"lanes": turning, "lane_s": 77.0},
            oncoming | {"lane_s": 80.0 - 20 - 2, "desired_speed_frac": 0.8},
            oncoming | {"lane_s": 80.0 - 52 - 2, "desired_speed_frac": 0.8},
        ),
        start + 5.05,
    )
    assert not overlaps_jit(path).any()
    crosses = np.argmax(~(gap_to_end(world, path, 0, turning[0]) > 0)) * DT
    assert 5.0 < crosses < 8.0  # neither in their way nor at red
    assert enters_at(path, 0, turning[0]) * DT < 10.0
    assert enters_at(path, 2, oncoming["lanes"][0]) * DT > 25.0  # waits for the next green


# The ego


@pytest.mark.parametrize("offset", [0.0, 1.0])
def test_stops_behind_an_ego_that_stands_on_its_lane(world, offset):
    lanes = [world.row("road", k) for k in range(3)]
    # at 30 m on the second lane, 80 m along the road, which runs from x = -75 to 75
    ego, place = make_ego((5.0, offset)), ego_place(lanes[1], -1, 30.0)
    path = world.run(cars(world, {"lanes": lanes, "lane_s": 10.0, "speed": 9.0}), 0.0, ego, place)
    bumper = path.xy[:, 0, 0] + 2.0
    assert (bumper < 5.0 - EGO_LENGTH / 2).all()
    assert path.speed[-1, 0] < 0.1 and bumper[-1] > 5.0 - EGO_LENGTH / 2 - 4.0


@pytest.mark.parametrize("y", [-2.0, 0.0, 2.0])
def test_stops_before_an_ego_that_stands_across_the_road(world, y):
    lanes = [world.row("road", k) for k in range(3)]
    ego = make_ego((5.0, y), yaw=np.pi / 2)
    path = world.run(cars(world, {"lanes": lanes, "lane_s": 10.0, "speed": 9.0}), 0.0, ego)
    bumper = path.xy[:, 0, 0] + 2.0
    assert (bumper < 5.0 - 1.836 / 2).all() and path.speed[-1, 0] < 0.1


def test_drives_past_an_ego_beside_its_lane(world):
    lanes = [world.row("road", k) for k in range(3)]
    ego = make_ego((5.0, 3.5))  # a lane's width to the left, along the road
    path = world.run(cars(world, {"lanes": lanes, "lane_s": 10.0, "speed": 9.0}), 0.0, ego)
    assert path.xy[-1, 0, 0] > 50.0 and path.speed[:60, 0].min() > 8.0


def test_lets_an_ego_go_first_that_comes_first(world):
    mine, theirs = world.way("plain", "east", "straight"), world.way("plain", "south", "straight")
    agents = cars(world, {"lanes": mine, "lane_s": 60.0, "speed": 7.0})
    # the ego is 5 m from the junction at 6 m/s: 0.8 s away, the agent 18 m / 7 m/s = 2.6 s
    ego, s = make_ego((1.75, -17.45), np.pi / 2, 6.0), 80 - 5 - EGO_LENGTH / 2
    assert is_gated(world, agents, 0.0, ego, ego_place(theirs[0], theirs[1], s))
    assert not is_gated(world, agents, 0.0, ego, ego_place(theirs[0], -1, s))


@pytest.mark.parametrize(
    ("red", "distance", "speed", "waits"),
    [
        (True, 1.0, 0.0, False),  # it stands at its red light
        (True, 15.0, 8.0, False),  # 64 / 6 = 10.7 m to stop: it still can
        (True, 6.0, 8.0, True),  # it can't
        (False, 1.0, 0.0, True),  # both are green in this test's eyes: who comes first goes first
    ],
)
def test_nobody_waits_for_an_ego_at_a_red_light(world, red, distance, speed, waits):
    start, _ = world.light("east")
    time = start + 1.0 if red else start + 16.0  # the ego's light, from the south, is red or green
    mine = world.way("lights", "east", "straight")
    theirs = world.way("lights", "south", "straight")
    agents = cars(world, {"lanes": mine, "lane_s": 60.0, "speed": 5.0})
    s = 80 - distance - EGO_LENGTH / 2
    ego = make_ego((1.75, -10 - distance - EGO_LENGTH / 2), np.pi / 2, speed)
    assert is_gated(world, agents, time, ego, ego_place(theirs[0], theirs[1], s)) == waits


def test_the_ego_is_seen_to_enter_the_next_lane_of_its_route(world):
    # From the south to the right: 13 m inside the crossing, shorter than the look ahead of 18 m.
    table = world.towns["plain"].lanes
    plan = world.way("plain", "south", "right")
    lane = np.repeat(plan, [81, 13, 81])
    s = np.concatenate([np.arange(81.0), np.arange(13.0), np.arange(81.0)])
    num = WINDOW + 10
    fields = {name: jnp.zeros(()) for name in Route.__dataclass_fields__}
    points = np.zeros((num, 2))
    for k in range(len(lane)):
        rows = table.points(lane[k] - world.first["plain"].lane)
        xy = table.point_xyz[rows][:, :2]
        known = np.linspace(0, table.length[lane[k] - world.first["plain"].lane], len(xy))
        points[k] = [np.interp(s[k], known, xy[:, i]) for i in range(2)]
    fields |= {
        "xy": f32(points),
        "yaw": f32(np.full(num, np.pi / 2)),
        "lane": jnp.asarray(np.pad(lane, (0, num - len(lane)), mode="edge"), jnp.int32),
        "lane_s": f32(np.pad(s, (0, num - len(s)), mode="edge")),
        "num_points": jnp.int32(len(lane)),
        "town": jnp.int32(0),
    }
    route = Route(**fields)
    find = jax.jit(situation.ego_place)
    for idx, next_lane in ((50, -1), (70, plan[1]), (79, plan[1]), (85, plan[2]), (174, -1)):
        got = find(make_ego(points[idx], np.pi / 2), world.map, route, jnp.int32(idx))
        assert (int(got.lane), int(got.next_lane)) == (lane[idx], next_lane)
        np.testing.assert_allclose(got.s, s[idx], atol=1e-3)
    off = find(make_ego(points[50] + [4.0, 0.0], np.pi / 2), world.map, route, jnp.int32(50))
    assert int(off.next_lane) == -1 and int(off.lane) == world.row("plain", approach("south"))
