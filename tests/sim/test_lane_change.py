"""Lane changes: MOBIL by hand, where one may change, and what becomes of it."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_world import link, network, straight
from traffic_world import drive, ego_place, f32, make_ego, overlaps_jit, with_values

from carljax.sim import (
    lane_change,
    lane_shift,
    lights,
    right_of_way,
    road_map_builder,
    town,
    traffic,
    vehicles,
)
from carljax.sim.idm import IDMParams
from carljax.sim.road_network import MARK_SOLID, RoadMark
from carljax.sim.types import KIND_VEHICLE, SIGNAL_BRAKE, SIGNAL_LEFT, SIGNAL_RIGHT

DRIVER = IDMParams()
SLOTS, FREE = 4, 20.0
RIGHT, LEFT = 0, 1


def two_lanes(left_end=1000.0, marks=()):
    """Lanes of 1,000 m to the east at y = 0 and y = 3.5, the left one perhaps shorter."""
    lanes = [
        straight((0, 0), (1000, 0), left=1, left_is_same_direction=True),
        straight((0, 3.5), (left_end, 3.5), right=0, right_is_same_direction=True),
    ]
    lanes = [dataclasses.replace(one, speed_limit=FREE) for one in lanes]
    return network(lanes, marks=marks)


def two_roads():
    """The same cut at 100 m, where the limit changes: 2 and 3 come after 0 and 1."""
    lanes = [
        straight((0, 0), (100, 0), left=1, left_is_same_direction=True, speed_limit=FREE),
        straight((0, 3.5), (100, 3.5), right=0, right_is_same_direction=True, speed_limit=FREE),
        straight((100, 0), (1000, 0), left=3, left_is_same_direction=True),
        straight((100, 3.5), (1000, 3.5), right=2, right_is_same_direction=True),
    ]
    return network(link(lanes, [(0, 2), (1, 3)]))


def solid():
    x = np.linspace(0.0, 1000.0, 1001)
    return RoadMark(np.column_stack([x, np.full(1001, 1.75)]), MARK_SOLID, "white", np.zeros(1001))


class Roads:
    """Several such roads in one map."""

    def __init__(self):
        networks = {
            "free": two_lanes(),
            "solid": two_lanes(marks=(solid(),)),
            "ends": two_lanes(left_end=300.0),
            "cut": two_roads(),
        }
        towns = {name: town.from_network(net) for name, net in networks.items()}
        first = town.offsets(list(towns.values()))
        self.first = {name: one.lane for name, one in zip(towns, first, strict=True)}
        self.offset = {name: one.offset for name, one in towns.items()}
        self.map = road_map_builder.build(list(towns.values()))

    def cars(self, name, *specs):
        """Cars of 4 m by 2 m on a road, from `car`; the other slots are empty."""
        empty = {"model": 0, "length": 4.0, "width": 2.0, "from_lane": -1, "lateral": 0.0}
        empty |= {"from_s": 0.0, "is_lawless": False, "cruise_speed": 0.0, "kind": 0}
        empty |= {"desired_speed_frac": 1.0, "lane_s": 0.0, "speed": 0.0}
        values = {field: np.full(SLOTS, value) for field, value in empty.items()}
        values["lanes"] = np.full((SLOTS, 3), -1)
        for i, spec in enumerate(specs):
            lane = self.first[name] + spec["lane"]
            values["lanes"][i, :2] = lane, int(self.map.lane_successors[lane, 0])
            values["kind"][i] = KIND_VEHICLE
            for field in spec.keys() - {"lane"}:
                values[field][i] = spec[field]
            if values["from_lane"][i] >= 0:
                values["from_lane"][i] += self.first[name]
        return place_jit(with_values(SLOTS, values), self.map)

    def place(self, name, lane, s):
        """The ego's place on a road."""
        return ego_place(self.first[name] + lane, -1, s)


@pytest.fixture(scope="module")
def roads():
    return Roads()


place_jit = jax.jit(traffic.place)


def movers_of(agents, road_map, ego, place):
    clock = lights.clock(f32(0.0), 0)
    stop = right_of_way.stop_ahead(agents, road_map, clock)
    return right_of_way.all_movers(agents, stop, ego, f32(4.9), place, road_map, clock)


@jax.jit
def judge_jit(agents, road_map, ego, place):
    """What a change to the left would be to car 0."""
    rows = jnp.array([0])
    movers = movers_of(agents, road_map, ego, place)
    car = jax.tree.map(lambda x: x[rows], agents)
    change = lane_change.beside(car, jnp.array([True]), road_map, jax.random.key(0))
    desired = jnp.full(SLOTS, FREE, jnp.float32)
    return lane_change.judge(rows, change, agents, movers, desired, road_map, DRIVER)


def judge(roads, *specs, ego=None, place=None):
    agents = roads.cars("free", *specs)
    gain, safe = judge_jit(agents, roads.map, ego or make_ego(), place or ego_place())
    return float(gain[0]), bool(safe[0])


@jax.jit
def begin_jit(agents, road_map, keys):
    movers = movers_of(agents, road_map, make_ego(), ego_place())
    desired = jnp.full(SLOTS, FREE, jnp.float32)
    one = functools.partial(lane_change.begin, agents, movers, desired, road_map, DRIVER)
    return jax.vmap(one)(keys)


def begins(roads, name, *specs):
    """Which cars begin to change lanes, over 32 draws of who looks where: (SLOTS,) counts."""
    agents = roads.cars(name, *specs)
    after = begin_jit(agents, roads.map, jax.random.split(jax.random.key(0), 32))
    changed = np.asarray(after.lanes[:, :, 0] != agents.lanes[:, 0])
    assert (changed.sum(axis=1) <= 1).all()  # at most one at a time
    return changed.sum(axis=0)


def car(lane, s, speed=15.0, **fields):
    return {"lane": lane, "lane_s": s, "speed": speed} | fields


# MOBIL's criteria. All drive at 15 m/s where the free speed is 20: (15 / 20)^4 = 0.3164.


def test_gain_behind_a_slow_car(roads):
    # Stays: gap 130 - 100 - 4 = 26 m, s* = 2 + 15 + 15 * 5 / (2 sqrt(1.5)) = 47.62,
    #   a = 1 - 0.3164 - (47.62 / 26)^2 = -2.671
    # Goes: nobody ahead, a = 0.6836. The new follower, 36 m behind, had 0.6836 as well and then
    #   has 1 - 0.3164 - (17 / 36)^2 = 0.4606, so the others lose 0.2230.
    # Gain = 0.6836 + 2.671 - 0.2 * 0.2230 = 3.310
    gain, safe = judge(roads, car(RIGHT, 100.0), car(RIGHT, 130.0, 10.0), car(LEFT, 60.0))
    np.testing.assert_allclose(gain, 3.310, atol=5e-3)
    assert safe


def test_the_old_followers_gain_counts(roads):
    # Car 2 follows car 0 at 20 - 4 = 16 m: a = 0.6836 - (17 / 16)^2 = -0.4453. Without car 0 the
    # next one is 16 + 4 + 196 = 216 m ahead: 0.6836 - (17 / 216)^2 = 0.6774. It gains 1.1227, and
    # car 0 itself 0.6836 - (0.6836 - (17 / 196)^2) = 0.0075.
    gain, safe = judge(roads, car(RIGHT, 100.0), car(RIGHT, 300.0), car(RIGHT, 80.0))
    np.testing.assert_allclose(gain, 0.0075 + 0.2 * 1.1227, atol=2e-3)
    assert safe


@pytest.mark.parametrize(
    ("follower", "safe"),
    [
        (car(LEFT, 60.0, 15.0), True),
        # 76 m behind and 5 m/s faster: s* = 2 + 20 + 20 * 5 / 2.449 = 62.8,
        # a = 1 - 1 - (62.8 / 76)^2 = -0.68; 36 m behind -(62.8 / 36)^2 = -3.04
        (car(LEFT, 20.0, 20.0), True),
        (car(LEFT, 60.0, 20.0), False),
        (car(LEFT, 97.0, 15.0), False),  # bumpers overlap
        (car(LEFT, 103.0, 15.0), False),
        (car(LEFT, 105.2, 15.0), False),  # 1.2 m between bumpers
    ],
)
def test_safe_for_those_on_the_new_lane(roads, follower, safe):
    assert judge(roads, car(RIGHT, 100.0), follower)[1] is safe


@pytest.mark.parametrize(("s", "safe"), [(20.0, True), (60.0, False)])
def test_the_ego_is_not_cut_off_either(roads, s, safe):
    place = roads.place("free", LEFT, s)
    got = judge(roads, car(RIGHT, 100.0), ego=make_ego((s, 3.5), speed=20.0), place=place)
    assert got[1] is safe


def test_a_car_that_leaves_the_new_lane_is_still_there(roads):
    leaver = car(RIGHT, 106.0, lateral=3.0, from_lane=LEFT, from_s=101.0)
    assert not judge(roads, car(RIGHT, 100.0), leaver)[1]
    has_left = car(RIGHT, 106.0, lateral=0.3)
    assert judge(roads, car(RIGHT, 100.0), has_left)[1]


# Where one may change


def slow(lane, s):
    return car(lane, s, 5.0)


def test_changes_only_for_a_gain(roads):
    assert begins(roads, "free", car(RIGHT, 100.0), slow(RIGHT, 150.0))[0] > 4
    assert begins(roads, "free", car(RIGHT, 100.0), car(RIGHT, 300.0)).sum() == 0
    assert begins(roads, "free", car(RIGHT, 100.0)).sum() == 0


def test_never_across_a_solid_line(roads):
    assert begins(roads, "solid", car(RIGHT, 100.0), slow(RIGHT, 150.0)).sum() == 0


@pytest.mark.parametrize(
    "fields",
    [
        {"is_lawless": True},
        {"cruise_speed": 5.0},
        {"from_lane": LEFT, "from_s": 100.0, "lateral": 2.0},
    ],
    ids=["lawless", "of a scenario", "on its way already"],
)
def test_some_never_change(roads, fields):
    assert begins(roads, "free", car(RIGHT, 100.0, **fields), slow(RIGHT, 150.0))[0] == 0


def test_not_near_the_end_of_a_lane_that_goes_on(roads):
    # At 15 m/s a change takes 3.5 s, 52.5 m; at 2 m/s it is kept 20 m before the end.
    leader = slow(2, 5.0)
    assert begins(roads, "cut", car(RIGHT, 46.0), leader)[0] > 4
    assert begins(roads, "cut", car(RIGHT, 49.0), leader)[0] == 0
    assert begins(roads, "cut", car(RIGHT, 5.0), slow(RIGHT, 40.0))[0] == 0  # just come in


def test_a_lane_that_ends_is_left_and_not_entered(roads):
    assert (
        begins(roads, "ends", car(LEFT, 200.0))[0] > 4
    )  # 100 m before its end, though it gains nothing
    assert begins(roads, "ends", car(LEFT, 100.0))[0] == 0
    assert begins(roads, "ends", car(RIGHT, 200.0), slow(RIGHT, 250.0)).sum() == 0
    assert begins(roads, "ends", car(RIGHT, 100.0), slow(RIGHT, 150.0))[0] > 4


def test_two_do_not_take_the_same_gap(roads):
    # Both would go left, and never do so in the same step: see `begins`.
    counts = begins(roads, "free", car(RIGHT, 100.0), slow(RIGHT, 150.0), slow(RIGHT, 130.0))
    assert counts[0] > 0 and counts[2] > 0


# What becomes of it


def test_the_body_stays_where_it_was(roads):
    agents = roads.cars("free", car(RIGHT, 100.3), slow(RIGHT, 150.0))
    after = begin_jit(agents, roads.map, jax.random.split(jax.random.key(0), 32))
    chosen = int(np.flatnonzero(np.asarray(after.lanes)[:, 0, 0] == LEFT)[0])
    after = place_jit(jax.tree.map(lambda x: x[chosen], after), roads.map)
    np.testing.assert_allclose(after.xy[0] + roads.offset["free"], [100.3, 0.0], atol=1e-4)
    np.testing.assert_allclose(after.lateral[0], -3.5, atol=1e-4)
    assert after.from_lane[0] == RIGHT and after.lanes[0].tolist() == [LEFT, -1, -1]
    np.testing.assert_allclose(after.from_s[0], 100.3, atol=1e-4)


leaders_jit = jax.jit(
    lambda agents, road_map, ego, place: lane_shift.leaders(
        agents, movers_of(agents, road_map, ego, place), road_map
    )
)


def test_on_both_lanes_until_it_is_clear(roads):
    leaver = car(LEFT, 100.0, 12.0, lateral=-2.0, from_lane=RIGHT, from_s=100.0)
    behind, ahead = car(RIGHT, 80.0), car(RIGHT, 130.0, 7.0)
    agents = roads.cars("free", leaver, behind, ahead)
    gap, speed = leaders_jit(agents, roads.map, make_ego(), ego_place())
    np.testing.assert_allclose(gap[:2], [130 - 100 - 4, 100 - 80 - 4], atol=1e-4)
    np.testing.assert_allclose(speed[:2], [7.0, 12.0])
    assert gap[2] > 900
    # the ego on the lane it leaves: half lengths 2 and 2.45 m
    ego = make_ego((110.0, 0.0), speed=3.0)
    gap, speed = leaders_jit(agents, roads.map, ego, roads.place("free", RIGHT, 110.0))
    np.testing.assert_allclose([gap[0], speed[0]], [10 - 2 - 2.45, 3.0], atol=1e-4)
    # nobody changes: nobody leads
    agents = roads.cars("free", car(LEFT, 100.0), behind, ahead)
    assert (leaders_jit(agents, roads.map, make_ego(), ego_place())[0] > 900).all()


def test_a_leader_that_still_leaves_the_next_lane(roads):
    leaver = car(3, 5.0, 12.0, lateral=-2.0, from_lane=2, from_s=5.0)
    agents = roads.cars("cut", car(RIGHT, 90.0), leaver)
    gap, _ = leaders_jit(agents, roads.map, make_ego(), ego_place())
    np.testing.assert_allclose(gap[0], 10 + 5 - 4, atol=1e-4)


@pytest.fixture(scope="module")
def overtaking(roads):
    """A minute: a lorry at 8 m/s (FREE 20, 0.4 of it), a car that comes up behind it."""
    lorry = car(RIGHT, 60.0, 8.0, desired_speed_frac=0.4, model=vehicles.TRUCK, length=8.0)
    agents = roads.cars("free", car(RIGHT, 15.0, 12.0, desired_speed_frac=0.75), lorry)
    run = jax.jit(functools.partial(drive, num_steps=500))
    path = run(roads.map, agents, f32(0.0), jax.random.key(0), make_ego(), ego_place())
    assert not overlaps_jit(path).any()
    return jax.tree.map(np.asarray, path)


def test_a_slow_lorry_is_overtaken(overtaking):
    path = overtaking
    x = path.xy[:, :, 0]
    assert x[0, 0] < x[0, 1] and x[-1, 0] > x[-1, 1] + 50.0
    changing = np.flatnonzero(path.from_lane[:, 0] >= 0)
    # 3.5 m at up to 1.6 m/s, slowly at either end
    assert 25 < len(changing) < 60 and np.ptp(changing) == len(changing) - 1
    assert path.lanes[-1, 0, 0] == LEFT and path.lateral[-1, 0] == 0.0
    np.testing.assert_allclose(path.xy[-1, 0, 1] - path.xy[0, 0, 1], 3.5, atol=1e-3)
    # nowhere faster sideways than 1.6 m/s, nor against its own heading
    step = np.diff(path.xy[:, 0], axis=0)
    assert np.abs(step[:, 1]).max() < 0.16 + 1e-3
    moving = np.hypot(*step.T) > 0.1
    heading = np.arctan2(step[:, 1], step[:, 0])[moving]
    # (in its first step a change is not yet in the heading: 0.15 of a slope of 1.6 / 12)
    np.testing.assert_allclose(heading, path.yaw[:-1, 0][moving], atol=0.025)


def test_the_change_is_shown(overtaking):
    left = overtaking.signals[:, 0] & SIGNAL_LEFT > 0
    np.testing.assert_array_equal(left[1:], overtaking.from_lane[1:, 0] >= 0)
    assert not (overtaking.signals & SIGNAL_RIGHT).any()
    assert not overtaking.signals[:, 2:].any()  # empty rows show nothing


def test_brake_lights(overtaking):
    braking = overtaking.signals[1:] & SIGNAL_BRAKE > 0
    want = (overtaking.accel[1:] < -1.0) | (overtaking.speed[1:] < 0.1)
    want &= overtaking.kind[1:] > 0
    np.testing.assert_array_equal(braking, want)


def test_turns_are_shown_from_30_metres_before(world):
    for way, bit in (("left", SIGNAL_LEFT), ("right", SIGNAL_RIGHT), ("straight", 0)):
        lanes = world.way("plain", "east", way)
        agent = {"lanes": np.array([lanes]), "lane_s": np.array([10.0]), "speed": np.array([8.0])}
        size = {"length": np.array([4.0]), "width": np.array([2.0]), "kind": np.array([1])}
        agents = with_values(1, agent | size | {"desired_speed_frac": np.ones(1)})
        path = world.run(place_jit(agents, world.map))
        shown = path.signals[1:, 0] & (SIGNAL_LEFT | SIGNAL_RIGHT)
        lane, s = path.lanes[1:, 0, 0], path.lane_s[1:, 0]
        near = (lane == lanes[0]) & (s > 80.0 - 30.0 - 2.0) | (lane == lanes[1])
        np.testing.assert_array_equal(shown, np.where(near, bit, 0))
        assert near.sum() > 30
