"""Where lanes meet: stretches by hand, whom to follow from lane to lane, and room beyond."""

import dataclasses
import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_world import (
    ALL,
    EGO_LENGTH,
    STEPS,
    cars,
    drive,
    ego_place,
    enters_at,
    f32,
    gap_to_end,
    is_gated,
    joined_jit,
    make_ego,
    overlaps_jit,
)

from carljax.sim import drivers, lights, order, priority, right_of_way
from carljax.sim.junctions import FORK, FREE, MERGE

# Cars are 4 m long. Lanes straight on are 20 m long and run 1.75 m beside the middle, so that from
# the east crosses from the south at 10 - 1.75 = 8.25 m, and that crosses it at 11.75 m.


def lane(world, arm, way):
    """Row of a lane inside, in the town's own table."""
    return world.way("plain", arm, way)[1] - world.first["plain"].lane


def test_stretches_of_a_crossing(world):
    # Nearer than 2.6 m: from 5.65 to 10.85 m, that is at the points 6 to 10, and from 9.15 to
    # 14.35 m, at the points 10 to 14; one point more to either side, as it lies between points.
    found = world.towns["plain"].junctions
    a, b = lane(world, "east", "straight"), lane(world, "south", "straight")
    for one, other, want in ((a, b, (5.0, 11.0)), (b, a, (9.0, 15.0))):
        place = (one, found.slot[other])
        np.testing.assert_allclose((found.enter[place], found.leave[place]), want, atol=1e-6)
        assert found.relation[place] == 0


def test_stretches_of_lanes_that_part_and_join(world):
    found = world.towns["plain"].junctions
    a, b = lane(world, "east", "straight"), lane(world, "east", "left")
    place = (a, found.slot[b])
    # The circle of radius 11.75 m is 2.6 m away from its tangent where 1 - cos = 2.6 / 11.75, at
    # 0.679 rad, and 11.75 sin 0.679 = 7.4 m along it, or nearest a little farther on.
    assert found.relation[place] == FORK and found.conflict[place] == FREE
    assert found.enter[place] == 0.0 and 7.0 < found.leave[place] < 11.0
    place = (a, found.slot[lane(world, "south", "left")])  # ends where straight on does
    assert found.relation[place] == MERGE
    np.testing.assert_allclose(found.leave[place], 20.0, atol=1e-6)


@jax.jit
def pairs_jit(agents, road_map):
    clock = lights.clock(f32(0.0), 0)
    stop = right_of_way.stop_ahead(agents, road_map, clock)
    movers = right_of_way.all_movers(
        agents, stop, make_ego(), f32(EGO_LENGTH), ego_place(), road_map, clock
    )
    limit = drivers.free_speed(agents, road_map).limit
    focus = priority.focus_of(agents, road_map, limit)
    others = priority.crossers(agents, movers, movers.can_go, road_map, limit)
    return priority.pairs(agents, focus, others, road_map)


@pytest.mark.parametrize("pair", [(0, 1), (1, 0), (0, 4), (5, 2), (2, 7), (3, 6)])
def test_what_is_looked_up_is_what_the_host_found(world, pair):
    found, ways = world.towns["plain"].junctions, ("straight", "left", "right")
    names = [(arm, way) for arm in ALL for way in ways]
    plans = [world.way("plain", *names[k]) for k in pair]
    agents = cars(world, *({"lanes": (*plan[1:], -1), "lane_s": 1.0} for plan in plans))
    got = pairs_jit(agents, world.map)
    a, b = (plan[1] - world.first["plain"].lane for plan in plans)
    there, back = (a, found.slot[b]), (b, found.slot[a])
    assert got.owes[1, 0] == found.conflict[there]
    assert got.merges[1, 0] == (found.relation[there] & MERGE > 0)
    assert got.forks[1, 0] == (found.relation[there] & FORK > 0)
    # in steps of 1/4 m, outwards
    for stretch, place in ((got.mine, there), (got.theirs, back)):
        assert 0 <= found.enter[place] - stretch.enter[1, 0] < 0.25
        assert 0 <= stretch.leave[1, 0] - found.leave[place] < 0.25


def test_follows_on_the_lane_beside_until_they_have_parted(world):
    straight, left = (world.way("plain", "east", way)[1:] for way in ("straight", "left"))
    for ahead, gap in ((7.0, 7.0 - 3.0 - 4.0), (15.0, 1000.0)):
        agents = cars(
            world,
            {"lanes": (*straight, -1), "lane_s": 3.0},
            {"lanes": (*left, -1), "lane_s": ahead},
        )
        got = joined_jit(agents, world.map)
        np.testing.assert_allclose(got[1, 0], gap, atol=1e-4)
        assert got[0, 1] > 900  # nobody follows who is behind


def test_follows_whoever_is_nearer_to_where_lanes_join(world):
    # Straight on from the east, 20 m long, and left from the south, 11.75 pi / 2 = 18.457 m long:
    # 12 m and 4.457 m are left. Stretches are rounded by up to 1/4 m.
    straight = world.way("plain", "east", "straight")[1:]
    left = world.way("plain", "south", "left")[1:]
    agents = cars(
        world,
        {"lanes": (*straight, -1), "lane_s": 8.0},
        {"lanes": (*left, -1), "lane_s": 14.0},
    )
    got = joined_jit(agents, world.map)
    np.testing.assert_allclose(got[1, 0], 12.0 - 4.457 - 4.0, atol=0.26)
    assert got[0, 1] > 900


def test_of_many_only_those_of_the_same_junction_are_looked_at(world, monkeypatch):
    ways = [world.way("plain", arm, way) for arm in ALL for way in ("straight", "left")]
    agents = cars(
        world,
        *({"lanes": way, "lane_s": 50.0 + 3.0 * k, "speed": 6.0} for k, way in enumerate(ways)),
    )
    given = (world.map, agents, f32(0.0), jax.random.key(0), make_ego(), ego_place())
    full = jax.jit(functools.partial(drive, num_steps=STEPS))(*given)
    assert full.wait_s.max() > 2.0 and full.lane_s[-1].std() > 1.0  # some had to wait
    monkeypatch.setattr(order, "MANY", 4)
    some = jax.jit(functools.partial(drive, num_steps=STEPS))(*given)
    for name in ("lane_s", "speed", "wait_s", "lanes"):
        np.testing.assert_allclose(getattr(some, name), getattr(full, name), atol=1e-3)


def test_of_a_crowded_junction_the_nearest_are_looked_at():
    num, rng = 120, np.random.default_rng(0)
    lane = rng.integers(-1, 8, num).astype(np.int32)
    s = rng.uniform(-40.0, 15.0, num).astype(np.float32)
    rest = {f.name: np.zeros(num, np.float32) for f in dataclasses.fields(priority.Crossers)}
    others = priority.Crossers(**{**rest, "number": np.arange(num), "lane": lane, "s": s})
    junction = np.array([0, 0, 0, 0, 0, 0, -1, 1], np.int32)  # of lanes
    road_map = types.SimpleNamespace(lane_junction=jnp.asarray(junction))
    focus = types.SimpleNamespace(lane=jnp.array([7, 2]))
    got = priority._nearest(focus, jax.tree.map(jnp.asarray, others), road_map)
    for column, number in ((0, 1), (1, 0)):
        there = np.flatnonzero((lane >= 0) & (junction[lane] == number))
        want = there[np.argsort(-s[there])][: priority.NEAREST]
        seen = np.asarray(got.lane[:, column])
        mine = (seen >= 0) & (junction[seen] == number)
        np.testing.assert_array_equal(np.asarray(got.number[:, column])[mine], want)
        np.testing.assert_array_equal(np.asarray(got.s[:, column])[mine], s[want])
    assert (junction[lane[lane >= 0]] == 0).sum() > priority.NEAREST


@pytest.mark.parametrize(
    ("s", "speed", "waits"),
    [
        (2.0, 0.0, True),  # before the stretch from 9 to 15 m, and might go on
        (12.0, 0.0, True),  # on it
        (18.0, 0.0, False),  # its tail, at 16 m, is clear of it, though it is still on the lane
        (13.0, 8.0, False),  # will have left it in 0.5 s
    ],
)
def test_a_lane_is_free_once_the_stretch_is(world, s, speed, waits):
    mine = world.way("plain", "east", "straight")
    theirs = world.way("plain", "south", "straight")
    agents = cars(
        world,
        {"lanes": mine, "lane_s": 74.0, "speed": 3.0},
        {"lanes": (*theirs[1:], -1), "lane_s": s, "speed": speed},
    )
    assert is_gated(world, agents) == waits


def test_stops_within_the_junction_before_one_that_stands_there(world):
    # 5 m/s at 8 m/s^2 need 25 / 16 = 1.6 m: from 2 m the front stops before 5 m.
    mine = world.way("plain", "east", "straight")
    theirs = world.way("plain", "south", "straight")
    stands = {"lanes": (*theirs[1:], -1), "lane_s": 12.0, "is_braking_hard": True}
    moves = {"lanes": (*mine[1:], -1), "lane_s": 0.0, "speed": 5.0}
    path = world.run(cars(world, moves, stands))
    assert not overlaps_jit(path).any()
    assert path.speed[-1, 0] < 0.05 and path.lane_s[-1, 0] + 2.0 < 5.0 + 1e-3


def test_does_not_enter_without_room_behind_the_junction(world):
    # One stands on the way out, its tail 2 m or 10 m behind the junction; a car needs 4 + 2 m.
    mine = world.way("plain", "east", "straight")
    queue = {"lanes": (mine[2], -1, -1), "is_braking_hard": True}
    for ahead, enters in ((4.0, False), (12.0, True)):
        moves = {"lanes": mine, "lane_s": 60.0, "speed": 6.0}
        path = world.run(cars(world, moves, queue | {"lane_s": ahead}))
        assert (enters_at(path, 0, mine[0]) < STEPS) == enters
        assert not overlaps_jit(path).any()
        if not enters:
            assert (gap_to_end(world, path, 0, mine[0]) > 0).all()


def test_nobody_waits_for_room_behind_those_who_drive_on(world):
    mine = world.way("plain", "east", "straight")
    moving = {"lanes": (mine[2], -1, -1), "lane_s": 2.0, "speed": 3.0}
    path = world.run(cars(world, {"lanes": mine, "lane_s": 60.0, "speed": 6.0}, moving))
    assert enters_at(path, 0, mine[0]) < 60


@pytest.mark.parametrize("lawless", [False, True])
def test_a_lawless_driver_goes_through_red_and_the_others_let_it(world, lawless):
    start, _ = world.light("east")
    red = world.way("lights", "south", "straight")
    green = world.way("lights", "east", "straight")
    path = world.run(
        cars(
            world,
            {"lanes": red, "lane_s": 40.0, "speed": 9.0, "is_lawless": lawless},
            {"lanes": green, "lane_s": 42.0, "speed": 8.0},
        ),
        start + 1.0,
    )
    assert not overlaps_jit(path).any()
    first = [enters_at(path, 0, red[0]), enters_at(path, 1, green[0])]
    assert (first[0] < first[1]) == lawless
    if lawless:
        assert path.speed[: first[0], 0].min() > 8.0


def test_who_is_told_to_brake_halts(world):
    # 8 m/s at 8 m/s^2: 1 s and 4 m
    lanes = world.way("plain", "east", "straight")
    brakes = {"lanes": lanes, "lane_s": 20.0, "speed": 8.0, "is_braking_hard": True}
    path = world.run(cars(world, brakes))
    assert path.speed[11, 0] == 0.0
    np.testing.assert_allclose(path.lane_s[-1, 0], 24.0, atol=0.1)


def test_a_cruising_car_keeps_its_speed_below_the_limit(world):
    lanes = world.way("plain", "east", "straight")
    path = world.run(cars(world, {"lanes": lanes, "lane_s": 2.0, "cruise_speed": 4.0}))
    assert 3.8 < path.speed[:, 0].max() <= 4.0 + 1e-3
