"""Waypoints joined along lanes: hand-made towns, and longest6 against paths found with CARLA."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from small_world import HALF, LEFT_RADIUS, WIDTH, crossing, link, network, straight

from carljax.sim import leaderboard_files, route_assembly, route_matching, town
from carljax.sim.route_matching import MatchError

EAST, NORTH, WEST, SOUTH = 0.0, np.pi / 2, np.pi, -np.pi / 2
SIDE = WIDTH / 2


def match(there, points, yaw):
    """The segments through waypoints in the coordinates of the file."""
    xy = np.array(points, float) - there.offset
    return route_matching.match(there, xy, None if yaw is None else np.array(yaw, float))


def route_of(there, points, yaw):
    segments = match(there, points, yaw)
    return route_assembly.assemble(there, town.offsets([there])[0], segments)


def total(segments):
    return sum(segment.end - segment.start for segment in segments)


def raw_lanes(there, segments):
    """The lanes of the file under the middle of each segment."""
    out = []
    for segment in segments:
        members = there.lanes.members[segment.lane]
        middle = (segment.start + segment.end) / 2
        starts = there.lanes.raw_start[members]
        out.append(there.network.lanes[members[int((starts <= middle).sum()) - 1]])
    return out


@pytest.fixture(scope="module")
def cross():
    return town.from_network(crossing())


def test_a_left_turn_is_as_long_as_its_arc(cross):
    # From 30 m before the crossing, eastbound, to 25 m beyond it, northbound.
    points = [(-HALF - 30.0, -SIDE), (SIDE, HALF + 25.0)]
    for yaw in ([EAST, NORTH], None):
        segments = match(cross, points, yaw)
        # 30 + 11.75 * pi / 2 + 25, less what chords of 1 m cut off the arc
        assert total(segments) == pytest.approx(55.0 + LEFT_RADIUS * np.pi / 2, abs=0.02)


# A waypoint in the crossing where the lanes of the four ways on overlap: 1 m into it, eastbound.
INSIDE = (-HALF + 1.0, -SIDE)


@pytest.mark.parametrize(
    ("goal", "yaw", "way"),
    [
        ((HALF + 20.0, -SIDE), EAST, 2 * HALF),
        ((SIDE, HALF + 20.0), NORTH, LEFT_RADIUS * np.pi / 2),
        ((-SIDE, -HALF - 20.0), SOUTH, (HALF - SIDE) * np.pi / 2),
    ],
    ids=["straight", "left", "right"],
)
def test_the_way_on_decides_between_lanes_that_overlap(cross, goal, yaw, way):
    points = [(-HALF - 10.0, -SIDE), INSIDE, goal]
    for directions in ([EAST, EAST, yaw], None):
        assert total(match(cross, points, directions)) == pytest.approx(30.0 + way, abs=0.02)


def test_yaw_keeps_a_waypoint_off_the_crossing_lane_that_is_nearer(cross):
    # 1.2 m beside the eastbound lane straight on, exactly on the northbound one.
    beside = (SIDE, -SIDE + 1.2)
    points = [(-HALF - 10.0, -SIDE), beside, (HALF + 10.0, -SIDE)]
    assert total(match(cross, points, [EAST] * 3)) == pytest.approx(20.0 + 2 * HALF, abs=0.02)


def test_a_way_back_to_the_same_lane_goes_all_the_way_round():
    corners = [(0, 0), (100, 0), (100, 100), (0, 100)]
    sides = [straight(corners[k], corners[(k + 1) % 4], road_id=str(k)) for k in range(4)]
    ring = town.from_network(network(link(sides, [(k, (k + 1) % 4) for k in range(4)])))
    points = [(60, 0), (100, 50), (50, 100), (0, 50), (40, 0)]
    yaw = [EAST, NORTH, WEST, SOUTH, EAST]
    segments = match(ring, points, yaw)
    assert total(segments) == pytest.approx(380.0)
    assert total(match(ring, points, None)) == pytest.approx(380.0)


@pytest.mark.parametrize(
    ("points", "yaw", "reason"),
    [
        ([(-20, -SIDE), (40, 60)], [EAST, EAST], "waypoint 1 is on no driving lane"),
        ([(-20, -SIDE), (30, -SIDE)], [NORTH, EAST], "waypoint 0 is on no driving lane that goes"),
        # beyond the end of the road's last lane there is no way back
        ([(30, -SIDE), (20, -SIDE)], [EAST, EAST], "waypoint 1 can't be reached from waypoint 0"),
    ],
    ids=["off the road", "across the lane", "no way back"],
)
def test_waypoints_that_nothing_joins_are_named(cross, points, yaw, reason):
    with pytest.raises(MatchError, match=reason):
        match(cross, points, yaw)


def carriageway(num_lanes, *cuts, junction=(), width=None):
    """A road to the east in sections between the given x, lanes side by side from right to left."""
    lanes, pairs = [], []
    for k in range(len(cuts) - 1):
        for i in range(num_lanes):
            number = k * num_lanes + i
            lane = straight((cuts[k], WIDTH * i), (cuts[k + 1], WIDTH * i), section=k)
            lane = dataclasses.replace(
                lane,
                lane_id=i - num_lanes,
                s=lane.xyz[:, 0] - cuts[0],
                junction="1" if k in junction else None,
                left=number + 1 if i < num_lanes - 1 else -1,
                right=number - 1 if i > 0 else -1,
                left_is_same_direction=i < num_lanes - 1,
                right_is_same_direction=i > 0,
            )
            if width is not None and i == 1:
                lane = dataclasses.replace(lane, width=width(lane.xyz[:, 0]))
            lanes.append(lane)
            if k > 0:
                pairs.append((number - num_lanes, number))
    return town.from_network(network(link(lanes, pairs)))


def test_one_change_to_the_lane_beside_in_the_middle_of_the_way():
    there = carriageway(2, 0, 200)
    segments = match(there, [(20, 0), (180, WIDTH)], [EAST, EAST])
    assert [(s.start, s.end) for s in segments] == [(20.0, 100.0), (100.0, 180.0)]
    assert segments[0].lane != segments[1].lane
    found = route_of(there, [(20, 0), (180, WIDTH)], [EAST, EAST])
    # 160 steps of 1 m; that of the change goes 3.5 m aside: sqrt(1 + 12.25) = 3.64 m.
    assert float(found.length) == pytest.approx(159.0 + np.hypot(1.0, WIDTH), abs=1e-3)


def test_two_changes_share_the_way():
    segments = match(carriageway(3, 0, 200), [(20, 2 * WIDTH), (170, 0)], None)
    assert [(s.start, s.end) for s in segments] == [(20.0, 70.0), (70.0, 120.0), (120.0, 170.0)]


def test_no_change_inside_a_junction():
    # The change must come in the 20 m before the junction or in the 100 m after it.
    there = carriageway(2, 0, 30, 90, 200, junction=(1,))
    segments = match(there, [(10, 0), (190, WIDTH)], [EAST, EAST])
    lanes = raw_lanes(there, segments)
    at = next(i for i, lane in enumerate(lanes) if lane.lane_id == -1)
    assert lanes[at].section == 2 and lanes[at - 1].section == 2
    # the section with more room: the middle of x = 90 to 190 is 140, 50 m along it
    assert segments[at].start == pytest.approx(50.0)


def test_a_change_comes_where_the_new_lane_is_wide_enough():
    # The left lane opens between x = 100 and 120 from nothing to 3.5 m: 2.5 m are reached at 114.3.
    def opening(x):
        return np.clip((x - 100.0) / 20.0, 0.0, 1.0) * WIDTH

    there = carriageway(2, 0, 200, width=opening)
    segments = match(there, [(20, 0), (180, WIDTH)], [EAST, EAST])
    # its first point that wide is x = 115; halfway from there to 180 is 147.5
    assert segments[0].end == pytest.approx(147.5)


def test_a_lane_is_kept_where_nothing_asks_for_another():
    there = carriageway(3, 0, 80, 160, 240)
    points = [(5, WIDTH), (100, WIDTH + 1.0), (230, WIDTH - 1.0)]
    assert {lane.lane_id for lane in raw_lanes(there, match(there, points, None))} == {-2}


def test_waypoints_right_behind_one_another_make_a_route():
    there = carriageway(1, 0, 50)
    assert total(match(there, [(10, 0), (10, 0)], [EAST, EAST])) == 0.0
    assert int(route_of(there, [(10, 0), (10, 0)], [EAST, EAST]).num_points) == 1


@pytest.fixture(scope="module")
def longest6(shared_data):
    """{id: (town, route, yaw or None)} and the reference."""
    folder = shared_data / "routes"
    v1 = leaderboard_files.read_routes(folder / "longest6_v1_Town01_02_06.xml")
    names = {route.town for route in v1}
    towns = {name: town.load(shared_data / "maps" / f"{name}.xodr") for name in sorted(names)}
    lengths = json.loads((shared_data / "oracle" / "route_lengths.json").read_text())
    with np.load(shared_data / "oracle" / "route_paths.npz") as file:
        paths = dict(file)
    return v1, towns, lengths, paths


@pytest.mark.parametrize("has_yaw", [True, False])
def test_longest6_is_as_long_as_with_carla(longest6, has_yaw):
    routes, towns, lengths, _ = longest6
    assert len(routes) == 18
    for route in routes:
        there, expected = towns[route.town], lengths[route.id]
        found = route_of(there, route.xy, route.yaw if has_yaw else None)
        assert float(found.length) == pytest.approx(expected["lane_m"], rel=0.02), route.id
        step = np.hypot(*np.diff(found.xy.astype(float), axis=0).T)
        assert (step > 2.0).sum() <= expected["lane_changes"], route.id
        assert step.max() < 4.5


def test_longest6_takes_the_roads_that_carla_takes(longest6):
    routes, towns, _, paths = longest6
    for route in routes:
        there = towns[route.town]
        found = route_of(there, route.xy, route.yaw)
        row = int(np.flatnonzero(paths["route_id"] == int(route.id))[0])
        path = paths["xy_yaw"][paths["ptr"][row] : paths["ptr"][row + 1], :2].astype(float)
        ours = found.xy.astype(float) + there.offset
        path *= (1.0, -1.0)  # CARLA's frame
        # The reference may change lane elsewhere: it may be three lanes aside for a while.
        away = np.hypot(*(path[:, None] - ours[None]).transpose(2, 0, 1)).min(axis=1)
        assert away.max() < 3 * 3.6 + 1.0, route.id
        assert (away > 1.0).mean() < 0.25, route.id
