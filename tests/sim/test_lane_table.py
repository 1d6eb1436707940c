"""Lanes of a town: what is joined, how it is resampled, bends and stop lines."""

import numpy as np
import pytest
from small_world import (
    LIMIT,
    approach,
    arc,
    crossing,
    inner,
    lane,
    leaving,
    link,
    network,
    road,
    signal,
    straight,
)

from carljax.sim import lane_table
from carljax.sim.types import STOP_LIGHT, STOP_NONE, STOP_SIGN, STOP_YIELD


def members(net):
    return sorted(map(tuple, lane_table.build(net).members))


def test_pieces_with_a_single_way_on_become_one_lane():
    table = lane_table.build(road(0, 10, 25, 30))
    assert table.members == [[0, 1, 2]]
    np.testing.assert_array_equal(table.raw_lane, [0, 0, 0])
    np.testing.assert_allclose(table.raw_start, [0, 10, 25])
    np.testing.assert_allclose(table.length, [30])
    # 30 m in steps of at most 1 m: 31 points, one on each metre
    np.testing.assert_allclose(table.point_xyz[:, 0], np.arange(31), atol=1e-12)
    assert table.num_points.tolist() == [31]
    assert table.successors.tolist() == [[-1]]


def test_lanes_are_not_joined_where_the_road_forks_or_merges():
    arms = [straight((a, 0), (a + 10, 0)) for a in (0, 10, 10, 20)]
    forks_and_merges = link(arms, [(0, 1), (0, 2), (1, 3), (2, 3)])
    table = lane_table.build(network(forks_and_merges))
    assert table.members == [[0], [1], [2], [3]]
    assert table.successors.tolist() == [[1, 2], [3, -1], [3, -1], [-1, -1]]
    assert table.predecessors == [[], [0], [0], [1, 2]]


def test_lanes_are_not_joined_across_a_junctions_border_or_where_the_limit_changes():
    pieces = [
        straight((0, 0), (10, 0)),
        straight((10, 0), (20, 0), junction="9"),
        straight((20, 0), (30, 0), junction="9"),
        straight((30, 0), (40, 0)),
        straight((40, 0), (50, 0), speed_limit=20.0),
    ]
    table = lane_table.build(network(link(pieces, [(i, i + 1) for i in range(4)])))
    assert table.members == [[0], [1, 2], [3], [4]]
    assert table.junction == [None, "9", None, None]
    np.testing.assert_allclose(table.speed_limit, [LIMIT, LIMIT, LIMIT, 20])


def test_a_closed_loop_is_cut_once():
    quarters = []
    for k in range(4):
        at = k * np.pi / 2
        quarters.append(arc((20 * np.sin(at), -20 * np.cos(at)), at, 20.0, np.pi / 2, num=201))
    table = lane_table.build(network(link(quarters, [(k, (k + 1) % 4) for k in range(4)])))
    assert sorted(table.members[0]) == [0, 1, 2, 3] and len(table.members) == 1
    assert table.successors.tolist() == [[0]]  # and leads into itself
    np.testing.assert_allclose(table.length, 2 * np.pi * 20, rtol=1e-4)


def test_a_lane_has_at_most_one_stop_line():
    signals = [signal("a", "stop", [(1, 9)]), signal("b", "stop", [(3, 9)])]
    table = lane_table.build(road(0, 10, 20, 30, 40, 50, signals=signals))
    # the second line begins a lane of its own
    assert sorted(table.members) == [[0, 1, 2], [3, 4]]
    first, second = table.raw_lane[1], table.raw_lane[3]
    assert table.stop_signal[first] == "a" and table.stop_signal[second] == "b"
    np.testing.assert_allclose(table.stop_s[[first, second]], [10 + 9, 0 + 9])
    assert table.successors[first, 0] == second


def test_every_raw_driving_lane_is_on_exactly_one_lane():
    net = crossing({"north": "stop"})
    table = lane_table.build(net)
    assert sorted(raw for chain in table.members for raw in chain) == list(range(20))
    for raw in range(20):
        assert raw in table.members[table.raw_lane[raw]]


def test_lanes_that_are_not_driven_have_no_row():
    lanes = [straight((0, 0), (10, 0)), straight((0, 4), (10, 4), kind="shoulder")]
    table = lane_table.build(network(lanes))
    assert table.raw_lane.tolist() == [0, -1]


def test_points_are_even_at_most_a_metre_apart_and_on_the_lane():
    rng = np.random.default_rng(0)
    corners = np.cumsum(rng.uniform(0.3, 4.0, (12, 2)), axis=0)
    table = lane_table.build(network([lane(corners)]))
    xy = table.point_xyz[:, :2]
    along = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    at = np.linspace(0, along[-1], len(xy))  # evenly spaced along the lane
    assert 0 < at[1] <= 1.0 and at[1] > along[-1] / (along[-1] + 1)  # and no finer than needed
    wanted = [np.interp(at, along, corners[:, i]) for i in range(2)]
    np.testing.assert_allclose(xy, np.stack(wanted, axis=-1), atol=1e-9)
    np.testing.assert_allclose(xy[[0, -1]], corners[[0, -1]], atol=1e-12)
    np.testing.assert_allclose(table.length[0], along[-1])


def test_direction_is_interpolated_across_the_half_turn():
    # A left bend from 170 to 190 degrees: half way it heads for 180, not for 0.
    table = lane_table.build(network([arc((0, 0), np.radians(170), 20.0, np.radians(20))]))
    yaw = np.degrees(table.point_yaw)
    middle = np.interp(0.5, np.linspace(0, 1, len(yaw)), yaw % 360)
    np.testing.assert_allclose(middle, 180, atol=0.1)
    assert (yaw >= -180).all() and (yaw < 180).all()
    np.testing.assert_allclose(yaw[[0, -1]], [170, -170], atol=1e-6)


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("radius", [12.0, 20.0, 50.0])
def test_speed_in_a_bend(radius, side):
    # v^2 / R = 2.5 m/s^2
    table = lane_table.build(network([arc((0, 0), 1.0, radius, side * 1.5, num=301)]))
    np.testing.assert_allclose(table.curve_speed, np.sqrt(2.5 * radius), rtol=1e-3)


def test_a_bend_in_a_straight_road_sets_its_speed():
    begin, bend = straight((0, 0), (40, 0)), arc((40, 0), 0.0, 15.0, np.pi / 2, num=301)
    end = straight((55, 15), (55, 60), yaw=np.pi / 2)
    table = lane_table.build(network(link([begin, bend, end], [(0, 1), (1, 2)])))
    assert len(table.length) == 1
    np.testing.assert_allclose(table.curve_speed, np.sqrt(2.5 * 15), rtol=0.02)


def test_a_kink_is_spread_over_three_metres():
    # 0.3 rad at one point: 0.1 rad/m, v = sqrt(2.5 / 0.1) = 5; a straight road has no such bound.
    before = np.arange(21)[:, None] * [1.0, 0.0]
    after = [20.0, 0.0] + np.arange(1, 21)[:, None] * [np.cos(0.3), np.sin(0.3)]
    sharp = np.where(np.arange(41) < 20, 0.0, 0.3)
    table = lane_table.build(network([lane(np.concatenate([before, after]), yaw=sharp)]))
    np.testing.assert_allclose(table.curve_speed, 5.0, rtol=1e-6)
    assert lane_table.build(road(0, 30)).curve_speed[0] > 100


@pytest.mark.parametrize("order", [1, -1])
def test_of_several_signals_light_holds_before_stop_before_yield(order):
    signals = [
        signal("give", "yield", [(0, 5), (1, 5), (2, 5)]),
        signal("halt", "stop", [(0, 6), (1, 6)]),
        signal("lamp", "light", [(0, 7)]),
        signal("fast", "speed", [(3, 1)], value=5.0),
    ][::order]
    lanes = [straight((0, 9 * k), (20, 9 * k)) for k in range(4)]
    table = lane_table.build(network(lanes, signals))
    assert table.stop_kind.tolist() == [STOP_LIGHT, STOP_SIGN, STOP_YIELD, STOP_NONE]
    assert table.stop_signal == ["lamp", "halt", "give", ""]
    np.testing.assert_allclose(table.stop_s, [7, 6, 5, 0])


def test_inside_a_junction_cars_wait_before_it():
    net = crossing({"east": "light", "north": "stop"})
    table = lane_table.build(net)
    for way in ("straight", "left", "right"):
        east, north = table.raw_lane[inner("east", way)], table.raw_lane[inner("north", way)]
        assert table.stop_kind[east] == STOP_LIGHT and table.stop_kind[north] == STOP_SIGN
        assert table.stop_s[east] == table.stop_s[north] == 0.0  # the posts stand 4 m along
    assert table.stop_kind[table.raw_lane[approach("east")]] == STOP_NONE


def test_limit_where_the_file_gives_none():
    table = lane_table.build(network([straight((0, 0), (10, 0), speed_limit=None)]))
    np.testing.assert_allclose(table.speed_limit, 50 / 3.6)


def test_no_way_on_is_lost_however_many_there_are():
    fan = [straight((0, 0), (10, 0))]
    fan += [straight((10, 0), (20, y)) for y in (-8, -5, -2, 1, 4, 7)]
    table = lane_table.build(network(link(fan, [(0, k) for k in range(1, 7)])))
    assert table.successors[0].tolist() == [1, 2, 3, 4, 5, 6]


def test_place_of_a_raw_distance():
    table = lane_table.build(road(0, 10, 25, 30))
    assert table.place(1, 4.0) == lane_table.Place(0, 14.0)
    assert table.place(2, 99.0) == lane_table.Place(0, 30.0)
    assert table.place(0, -1.0) == lane_table.Place(0, 0.0)


def test_exits_of_the_crossing_have_three_ways_in():
    table = lane_table.build(crossing())
    for arm in ("east", "north", "west", "south"):
        assert len(table.predecessors[table.raw_lane[leaving(arm)]]) == 3
        assert (table.successors[table.raw_lane[approach(arm)]] >= 0).sum() == 3


def test_a_lane_that_tapers_to_nothing_ends_where_it_is_too_narrow():
    taper = np.interp(np.arange(41), [0, 20, 40], [3.5, 3.5, 0.0])
    # 3.5 m less 0.175 m for each metre beyond 20: 2.625 m wide at 25 m, 2.45 m at 26 m
    pieces = [straight((0, 0), (40, 0), width=taper), straight((40, 0), (80, 0))]
    np.testing.assert_allclose(lane_table.build(network(pieces)).end, [25.0, 40.0])
    # where it goes on it ends where it ends
    linked = lane_table.build(network(link(pieces, [(0, 1)])))
    np.testing.assert_allclose(linked.end, linked.length)
