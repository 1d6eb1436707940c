"""The OpenDRIVE importer against values worked by hand and curves integrated apart."""

import copy
import math
import random
import xml.etree.ElementTree as ET

import numpy as np
import opendrive_files as of
import pytest
from scipy.integrate import quad

from carljax.sim import opendrive, opendrive_lanes
from carljax.sim.road_network import MARK_BROKEN, MARK_SOLID, MapError


@pytest.fixture
def read(tmp_path):
    """Writes the parts of a file and loads it."""

    def load(*parts, whole=None, **kwargs):
        path = tmp_path / "town.xodr"
        path.write_text(of.document(*parts, **kwargs) if whole is None else whole, encoding="utf-8")
        return opendrive.load(path)

    return load


def lanes_of(network):
    return {(x.road_id, x.section, x.lane_id): x for x in network.lanes}


def leads_to(network):
    """The lane graph by OpenDRIVE keys."""
    key = [(x.road_id, x.section, x.lane_id) for x in network.lanes]
    return {key[i]: {key[j] for j in x.successors} for i, x in enumerate(network.lanes)}


def middle_line(network):
    """The reference line itself: the common border of the lanes 1 and -1 of road 1."""
    lane = lanes_of(network)["1", 0, -1]
    normal = np.stack([-np.sin(lane.yaw), np.cos(lane.yaw)], axis=-1)
    return lane.s, lane.xyz[:, :2] + normal * 1.75, lane.yaw


# ------------------------------------------------------------------------------------- geometry


@pytest.mark.parametrize(
    ("k0", "k1", "length"),
    [
        (0.0, 0.0, 40.0),
        (0.03, 0.03, 40.0),
        (0.01, 0.09, 40.0),
        (0.05, -0.05, 60.0),
        (-0.1, 0.0, 30.0),
        (0.02, 0.02 + 1e-9, 80.0),
        (1e-7, 2e-7, 50.0),
        (0.2, -0.3, 25.0),
    ],
    ids="line arc spiral s_spiral out_of_bend nearly_arc nearly_line tight".split(),
)
def test_line_arc_and_spiral_are_the_integral_of_their_curvature(read, k0, k1, length):
    shape = "<line/>" if k0 == k1 == 0.0 else f'<arc curvature="{k0!r}"/>' if k0 == k1 else None
    shape = shape or f'<spiral curvStart="{k0!r}" curvEnd="{k1!r}"/>'
    network = read(of.road(1, length, of.geometry(shape, length, 10.0, -20.0, 0.5)))
    s, xy, yaw = middle_line(network)

    def heading(t):
        return 0.5 + k0 * t + (k1 - k0) / length * t * t / 2

    for i in (0, len(s) // 3, len(s) // 2, len(s) - 1):
        x, y = (quad(lambda t, f=f: f(heading(t)), 0, s[i], limit=400)[0] for f in (np.cos, np.sin))
        np.testing.assert_allclose(xy[i], (10.0 + x, -20.0 + y), atol=1e-6)
        assert math.remainder(yaw[i] - heading(s[i]), 2 * math.pi) == pytest.approx(0.0, abs=1e-9)
    assert s[0] == 0.0
    assert s[-1] == length


def dense_curve(u, v, p_end):
    """A cubic curve cut in 200,000 chords: arc length, u, v at each."""
    p = np.linspace(0.0, p_end, 200_001)
    points = np.stack([np.polyval(c[::-1], p) for c in (u, v)])
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=1)))])
    return arc, points


@pytest.mark.parametrize("p_range", ["arcLength", "normalized", None])
def test_param_poly3_is_read_by_arc_length(read, p_range):
    p_end = 25.0 if p_range == "arcLength" else 1.0
    if p_range == "arcLength":
        u, v = (0.0, 1.0, 0.0, -1e-4), (0.0, 0.0, 0.01, -1e-5)
    else:
        u, v = (0.0, 30.0, 2.0, -4.0), (0.0, 0.0, 12.0, -5.0)
    arc, (du, dv) = dense_curve(u, v, p_end)
    # For arcLength the file's length is the range of p, even where p is not quite the arc length.
    length = p_end if p_range == "arcLength" else float(arc[-1])
    names = [f'{"abcd"[i]}{axis}="{c[i]!r}"' for axis, c in (("U", u), ("V", v)) for i in range(4)]
    p_text = f'pRange="{p_range}"' if p_range else ""
    shape = f"<paramPoly3 {p_text} {' '.join(names)}/>"
    s, xy, _ = middle_line(read(of.road(1, length, of.geometry(shape, length, 3.0, 4.0, 0.7))))
    at = s * arc[-1] / length
    local = np.stack([np.interp(at, arc, du), np.interp(at, arc, dv)], axis=-1)
    c, n = np.cos(0.7), np.sin(0.7)
    np.testing.assert_allclose(xy, local @ np.array([[c, n], [-n, c]]) + (3.0, 4.0), atol=1e-5)


def test_poly3_is_read_by_arc_length(read):
    arc, (u, v) = dense_curve((0.0, 1.0, 0.0, 0.0), (0.5, 0.1, 0.02, -0.0004), 30.0)
    length = float(arc[-1])
    shape = '<poly3 a="0.5" b="0.1" c="0.02" d="-0.0004"/>'
    s, xy, yaw = middle_line(read(of.road(1, length, of.geometry(shape, length))))
    expected = np.stack([np.interp(s, arc, u), np.interp(s, arc, v)], axis=-1)
    np.testing.assert_allclose(xy, expected, atol=1e-5)
    # dv/du at u = 30: 0.1 + 2 * 0.02 * 30 - 3 * 0.0004 * 900 = 0.22
    assert yaw[-1] == pytest.approx(math.atan(0.22), abs=1e-5)


def test_pieces_follow_each_other_and_elevation_gives_z(read):
    bend = of.geometry("<line/>", 10.0) + of.geometry(
        '<arc curvature="0.1"/>', 5 * math.pi, 10.0, 0.0, 0.0, s=10.0
    )
    hill = of.cubic("elevation", 0.0, 1.0, 0.1) + of.cubic("elevation", 10.0, 2.0, 0.0, 0.01)
    network = read(of.road(1, 10 + 5 * math.pi, bend, elevation=hill))
    lane = lanes_of(network)["1", 0, -1]
    # A quarter circle of radius 10 m about (10, 10); the right lane's centre runs 1.75 m outside.
    np.testing.assert_allclose(lane.xyz[-1, :2], (21.75, 10.0), atol=1e-9)
    z = np.where(lane.s < 10.0, 1.0 + 0.1 * lane.s, 2.0 + 0.01 * (lane.s - 10.0) ** 2)
    np.testing.assert_allclose(lane.xyz[:, 2], z, atol=1e-9)
    assert not network.warnings


# ---------------------------------------------------------------------------------------- lanes


def test_right_hand_traffic_runs_along_s_on_the_right(read):
    lanes = lanes_of(read(of.road(1, 20.0)))
    right, left = lanes["1", 0, -1], lanes["1", 0, 1]
    np.testing.assert_allclose(right.xyz[[0, -1], :2], [(0.0, -1.75), (20.0, -1.75)])
    np.testing.assert_allclose(left.xyz[[0, -1], :2], [(20.0, 1.75), (0.0, 1.75)])
    np.testing.assert_allclose(np.cos(right.yaw), 1.0)
    np.testing.assert_allclose(np.cos(left.yaw), -1.0)
    np.testing.assert_allclose(left.s[[0, -1]], (20.0, 0.0))


def test_left_hand_traffic_runs_along_s_on_the_left(read):
    network = read(whole=of.FILES["left_hand"])
    assert network.left_hand_traffic
    lanes = lanes_of(network)
    np.testing.assert_allclose(lanes["1", 0, 1].xyz[[0, -1], :2], [(0.0, 1.75), (12.0, 1.75)])
    np.testing.assert_allclose(lanes["1", 0, -1].xyz[[0, -1], :2], [(12.0, -1.75), (0.0, -1.75)])
    graph = leads_to(network)
    assert graph["1", 0, 1] == {("1", 1, 1)}
    assert graph["1", 1, -1] == {("1", 0, -1)}
    assert graph["1", 0, -1] == graph["1", 1, 1] == set()


def test_lanes_lie_beside_each_other_from_the_offset_outwards(read):
    section = of.section(
        [of.lane(2, of.width(2.0), kind="shoulder"), of.lane(1, of.width(3.0)),
         of.lane(-1, of.width(3.0, 0.1)), of.lane(-2, of.width(1.0) + of.width(2.0, start=5.0))]
    )  # fmt: skip
    network = read(
        of.road(1, 10.0, sections=section, offsets=of.cubic("laneOffset", 0.0, 0.5, 0.02))
    )
    lanes = lanes_of(network)
    s = lanes["1", 0, -1].s
    offset = 0.5 + 0.02 * s
    width = 3.0 + 0.1 * s
    np.testing.assert_allclose(lanes["1", 0, -1].width, width)
    np.testing.assert_allclose(lanes["1", 0, -1].xyz[:, 1], offset - width / 2)
    np.testing.assert_allclose(lanes["1", 0, 1].xyz[::-1, 1], offset + 1.5)
    np.testing.assert_allclose(lanes["1", 0, 2].xyz[::-1, 1], offset + 3.0 + 1.0)
    far = np.abs(s - 5.0) > 0.6  # the width of lane -2 jumps at s = 5 m: a ramp over 1 m
    outer = np.where(s < 5.0, 1.0, 2.0)
    np.testing.assert_allclose(lanes["1", 0, -2].width[far], outer[far])
    np.testing.assert_allclose(
        lanes["1", 0, -2].xyz[far, 1], (offset - width - outer / 2)[far], atol=1e-9
    )
    # Slopes: the centre of lane -1 falls by 0.05 - 0.02 a metre.
    np.testing.assert_allclose(lanes["1", 0, -1].yaw, math.atan(-0.03), atol=1e-9)


def test_border_gives_the_outer_edge_whatever_lies_inside(read):
    section = of.section(
        [of.lane(1, of.width(3.0, tag="border")), of.lane(-1, of.width(-3.0, tag="border")),
         of.lane(-2, of.width(-3.0, -0.1, tag="border"))]
    )  # fmt: skip
    lanes = lanes_of(read(of.road(1, 20.0, sections=section)))
    np.testing.assert_allclose(lanes["1", 0, 1].xyz[:, 1], 1.5)
    np.testing.assert_allclose(lanes["1", 0, -1].width, 3.0)
    outer = lanes["1", 0, -2]
    np.testing.assert_allclose(outer.width, 0.1 * outer.s, atol=1e-12)
    np.testing.assert_allclose(outer.xyz[:, 1], -3.0 - 0.05 * outer.s)


def test_points_are_dense_enough_for_the_outermost_lane(read):
    lanes = [of.lane(-i, of.width(3.5)) for i in range(1, 6)] + [of.lane(1)]
    shape = '<arc curvature="0.05"/>'
    network = read(of.road(1, 60.0, of.geometry(shape, 60.0), of.section(lanes)))
    for lane in network.lanes:
        xy = lane.xyz[:, :2]
        chord = np.hypot(*np.diff(xy, axis=0).T)
        assert chord.max() <= opendrive_lanes.STEP + 1e-9
        assert chord.min() > 0.0
        radius = np.hypot(xy[:, 0], xy[:, 1] - 20.0)  # about (0, 20)
        np.testing.assert_allclose(radius, radius[0], atol=1e-9)
        sagitta = radius[0] - np.sqrt(radius[0] ** 2 - (chord / 2) ** 2)
        assert sagitta.max() < 0.01


def test_at_a_sections_end_the_records_before_it_still_hold(read):
    sections = of.section([of.lane(-1, succ=-1)]) + of.section([of.lane(-1, pred=-1)], s=10.0)
    offsets = of.cubic("laneOffset", 0.0) + of.cubic("laneOffset", 10.0, 2.0)
    lanes = lanes_of(read(of.road(1, 20.0, sections=sections, offsets=offsets)))
    np.testing.assert_allclose(lanes["1", 0, -1].xyz[-1, :2], (10.0, -1.75))
    np.testing.assert_allclose(lanes["1", 1, -1].xyz[0, :2], (10.0, 0.25))


def test_of_two_records_at_one_s_the_last_holds(read):
    offsets = of.cubic("laneOffset", 0.0, 7.0) + of.cubic("laneOffset", 0.0, 1.0)
    lanes = lanes_of(read(of.road(1, 20.0, offsets=offsets)))
    np.testing.assert_allclose(lanes["1", 0, -1].xyz[:, 1], 1.0 - 1.75)


def test_a_corner_is_rounded_on_its_outside(read):
    bend = of.geometry("<line/>", 10.0) + of.geometry(
        "<line/>", 10.0, 10.0, 0.0, math.pi / 2, s=10.0
    )
    lane = lanes_of(read(of.road(1, 20.0, bend)))["1", 0, -1]
    chord = np.diff(lane.xyz[:, :2], axis=0)
    turn = np.diff(np.unwrap(np.arctan2(chord[:, 1], chord[:, 0])))
    assert 0.0 < turn.max() < math.radians(40)
    corner = np.abs(lane.s - 10.0) < 1e-6
    radius = np.hypot(lane.xyz[corner, 0] - 10.0, lane.xyz[corner, 1])
    np.testing.assert_allclose(radius, 1.75, atol=1e-9)


def test_a_lane_inside_a_bend_too_tight_for_it_does_not_run_backwards(read):
    # A quarter circle of radius 2 m to the left between two lines, with a lane centre 4 m left of
    # it: that comes along y = 4 and leaves along x = 18, and would run round a loop in between.
    arc = math.pi
    bend = (
        of.geometry("<line/>", 20.0)
        + of.geometry('<arc curvature="0.5"/>', arc, 20.0, 0.0, 0.0, s=20.0)
        + of.geometry("<line/>", 20.0, 22.0, 2.0, math.pi / 2, s=20.0 + arc)
    )
    section = of.section([of.lane(-1), of.lane(1, of.width(2.5)), of.lane(2, of.width(3.0))])
    lane = lanes_of(read(of.road(1, 40.0 + arc, bend, section)))["1", 0, 2]
    np.testing.assert_allclose(lane.xyz[[0, -1], :2], [(18.0, 22.0), (0.0, 4.0)], atol=1e-9)
    step = np.diff(lane.xyz[:, :2], axis=0)
    heading = np.stack([np.cos(lane.yaw), np.sin(lane.yaw)], axis=-1)
    assert ((step * (heading[1:] + heading[:-1])).sum(axis=-1) > 0.0).all()
    assert lane.xyz[:, 0].max() < 19.0
    assert lane.xyz[:, 1].min() > 3.0


def test_a_section_of_no_length_keeps_its_lanes_and_links(read):
    def lanes(pred, succ):
        return [of.lane(-1, pred=-1 if pred else (), succ=-1 if succ else ())]

    sections = (
        of.section(lanes(False, True))
        + of.section(lanes(True, True), s=10.0)
        + of.section(lanes(True, False), s=10.0)
    )
    network = read(of.road(1, 20.0, sections=sections))
    graph = leads_to(network)
    assert graph["1", 0, -1] == {("1", 1, -1)}
    assert graph["1", 1, -1] == {("1", 2, -1)}
    np.testing.assert_allclose(lanes_of(network)["1", 1, -1].xyz, [(10.0, -1.75, 0.0)] * 2)


# ---------------------------------------------------------------------------------------- links


@pytest.mark.parametrize("first", ["end", "start"])
@pytest.mark.parametrize("second", ["start", "end"])
def test_roads_meet_at_any_two_ends(read, first, second):
    network = read(whole=of.FILES[f"contact_{first}_{second}"])
    sign = 1 if first != second else -1
    # Lanes of road 1 that run towards x = 30: along s (id < 0) if its end lies there.
    onward = [-1] if first == "end" else [1, 2]
    expected = {("1", 0, i): {("2", 0, sign * i)} for i in onward}
    back = [1, 2] if first == "end" else [-1]
    expected |= {("2", 0, sign * i): {("1", 0, i)} for i in back}
    graph = leads_to(network)
    assert {k: v for k, v in graph.items() if v} == expected
    for lane in network.lanes:
        for j in lane.successors:
            np.testing.assert_allclose(lane.xyz[-1], network.lanes[j].xyz[0], atol=1e-9)
            assert network.lanes.index(lane) in network.lanes[j].predecessors
    assert not network.warnings


def test_sections_are_joined_by_their_links_not_by_equal_ids(read):
    graph = leads_to(read(whole=of.FILES["sections"]))
    assert {k: v for k, v in graph.items() if v} == {
        ("1", 0, -1): {("1", 1, -2)},
        ("1", 0, -2): {("1", 1, -4)},
        ("1", 1, 1): {("1", 0, 1)},
        ("1", 1, -1): {("1", 2, -1)},
        ("1", 1, -2): {("1", 2, -2)},
        ("1", 1, -4): {("1", 2, -4)},
        ("1", 2, 2): {("1", 1, 1)},
    }


def test_a_junction_joins_its_arms_through_its_connections(read):
    network = read(whole=of.FILES["crossing"])
    graph = leads_to(network)
    assert {k: v for k, v in graph.items() if v} == {
        ("1", 0, 1): {("11", 0, -1)},
        ("1", 0, 2): {("11", 0, -2)},
        ("11", 0, -1): {("3", 0, -1)},
        ("2", 0, 1): {("12", 0, -1)},
        ("12", 0, -1): {("1", 0, -1)},
        # Road 13 is drawn the other way round: its traffic enters at its end.
        ("3", 0, 1): {("13", 0, 1)},
        ("13", 0, 1): {("2", 0, -1)},
    }
    for lane in network.lanes:
        for j in lane.successors:
            np.testing.assert_allclose(lane.xyz[-1], network.lanes[j].xyz[0], atol=1e-9)
    inside = {lane.road_id for lane in network.lanes if lane.junction == "100"}
    assert inside == {"11", "12", "13"}
    members = network.junctions["100"].lanes
    assert {network.lanes[i].road_id for i in members} == inside


def test_connections_without_lane_links_join_equal_ids(read):
    two = of.section([of.lane(-1), of.lane(-2)])
    ways = of.road(5, 10.0, of.geometry("<line/>", 10.0, 30.0), two,
                   of.link("predecessor", 1, "end"), 9)  # fmt: skip
    arm = of.road(
        1, 30.0, sections=of.section([of.lane(-1), of.lane(-2)]),
        links=of.link("successor", 9, kind="junction"),
    )  # fmt: skip
    graph = leads_to(read(arm, ways, of.junction(9, [(1, 5, "start", [])])))
    assert graph["1", 0, -1] == {("5", 0, -1)}
    assert graph["1", 0, -2] == {("5", 0, -2)}


def test_a_direct_junction_joins_roads_without_connecting_roads(read):
    arm = of.road(1, 30.0, links=of.link("successor", 9, kind="junction"))
    main = of.road(
        2,
        30.0,
        of.geometry("<line/>", 30.0, 30.0),
        links=of.link("predecessor", 9, kind="junction"),
    )
    direct = (
        '<junction id="9" type="direct"><connection id="0" incomingRoad="1" linkedRoad="2" '
        'contactPoint="start"><laneLink from="-1" to="-1"/><laneLink from="1" to="1"/>'
        "</connection></junction>"
    )
    graph = leads_to(read(arm, main, direct))
    assert graph["1", 0, -1] == {("2", 0, -1)}
    assert graph["2", 0, 1] == {("1", 0, 1)}
    assert graph["1", 0, 1] == graph["2", 0, -1] == set()


def test_a_lane_can_split_into_two(read):
    sections = of.section([of.lane(-1, succ=(-1, -2))]) + of.section(
        [of.lane(-1, pred=-1), of.lane(-2, of.width(0.0, 0.3), pred=-1)], s=10.0
    )
    graph = leads_to(read(of.road(1, 20.0, sections=sections)))
    assert graph["1", 0, -1] == {("1", 1, -1), ("1", 1, -2)}


def test_links_end_at_lanes_that_are_not_driven_on(read):
    sections = of.section([of.lane(-1, succ=-1)]) + of.section(
        [of.lane(-1, pred=-1, kind="shoulder")], s=10.0
    )
    network = read(of.road(1, 20.0, sections=sections))
    assert leads_to(network)["1", 0, -1] == set()


def test_neighbours_as_seen_by_the_driver(read):
    section = of.section(
        [of.lane(2, kind="shoulder"), of.lane(1), of.lane(-1), of.lane(-2), of.lane(-4)]
    )
    network = read(of.road(1, 20.0, sections=section))
    lanes = lanes_of(network)
    index = {k: i for i, k in enumerate(lanes)}
    first = lanes["1", 0, -1]
    assert (first.left, first.left_is_same_direction) == (index["1", 0, 1], False)
    assert (first.right, first.right_is_same_direction) == (index["1", 0, -2], True)
    oncoming = lanes["1", 0, 1]
    assert (oncoming.left, oncoming.left_is_same_direction) == (index["1", 0, -1], False)
    assert oncoming.right == -1
    # A jump in the ids is a jump in the ids, not on the road.
    assert lanes["1", 0, -2].right == index["1", 0, -4]
    assert lanes["1", 0, -4].right == -1


def test_a_wrong_contact_point_is_put_right_where_the_lanes_meet(read):
    roads = [
        of.road(1, 30.0, None, of.section([of.lane(-1, succ=-1)]), of.link("successor", 2, "end")),
        of.road(2, 30.0, of.geometry("<line/>", 30.0, 30.0), of.section([of.lane(-1)])),
    ]  # fmt: skip
    network = read(*roads)
    assert leads_to(network)["1", 0, -1] == {("2", 0, -1)}
    assert any("contact point names the wrong end" in w for w in network.warnings)


def test_a_link_that_leads_nowhere_is_named_not_followed(read):
    roads = [
        of.road(1, 30.0, None, of.section([of.lane(-1, succ=1)]), of.link("successor", 2, "start")),
        of.road(2, 30.0, of.geometry("<line/>", 30.0, 30.0)),
    ]  # fmt: skip
    network = read(*roads)
    assert leads_to(network)["1", 0, -1] == set()
    assert any(
        "is not followed" in w and "road 1, section 0, lane -1" in w for w in network.warnings
    )


# ------------------------------------------------------------------------- marks, speeds, signals


def mark(kind, start=0.0, colour="white", inner=""):
    paint = f'type="{kind}" color="{colour}" width="0.12"'
    return f'<roadMark sOffset="{start}" {paint}>{inner}</roadMark>'


def test_marks_follow_the_outer_borders(read):
    section = of.section(
        [of.lane(0, inner=mark("solid solid", colour="yellow"), kind="none"),
         of.lane(1, inner=mark("none") + mark("broken", 5.0)),
         of.lane(-1, of.width(3.0, 0.1), inner=mark("solid", 0, "standard") + mark("curb", 8.0))]
    )  # fmt: skip
    network = read(
        of.road(1, 20.0, sections=section, offsets=of.cubic("laneOffset", 0.0, 1.0, 0.02)),
        of.road(2, 20.0, of.geometry("<line/>", 20.0, 0.0, 50.0), section, junction=7),
        of.junction(7, []),
    )
    marks = {(m.kind, m.colour): m.xy for m in network.marks}
    assert len(network.marks) == len(marks) == 3  # none from road 2, in a junction
    middle = marks[MARK_SOLID, "yellow"]
    np.testing.assert_allclose(middle[:, 1], 1.0 + 0.02 * middle[:, 0])
    left = marks[MARK_BROKEN, "white"]
    np.testing.assert_allclose(left[[0, -1], 0], (5.0, 20.0))
    np.testing.assert_allclose(left[:, 1], 1.0 + 0.02 * left[:, 0] + 3.5)
    right = marks[MARK_SOLID, "white"]
    np.testing.assert_allclose(right[[0, -1], 0], (0.0, 8.0))
    np.testing.assert_allclose(right[:, 1], 1.0 + 0.02 * right[:, 0] - 3.0 - 0.1 * right[:, 0])


@pytest.mark.parametrize(
    ("space", "kind"), [("0", MARK_SOLID), ("6", MARK_BROKEN)], ids=["no gaps", "gaps"]
)
def test_custom_marks_are_judged_by_their_lines(read, space, kind):
    line = f'<line length="3" space="{space}" tOffset="0" sOffset="0"/>'
    inner = f'<type name="x" width="0.1">{line}</type>'
    section = of.section([of.lane(-1, inner=mark("custom", inner=inner))])
    assert [m.kind for m in read(of.road(1, 20.0, sections=section)).marks] == [kind]


@pytest.mark.parametrize(
    ("record", "expected"),
    [
        ('<speed sOffset="0" max="10"/>', 10.0),
        ('<speed sOffset="0" max="36" unit="km/h"/>', 10.0),
        ('<speed sOffset="0" max="10" unit="mph"/>', 4.4704),
        ('<speed sOffset="0" max="no limit"/>', 13.0),
        ('<speed sOffset="15" max="5"/>', 13.0),
        ("", 13.0),
    ],
)
def test_lane_speed_comes_before_road_speed(read, record, expected):
    section = of.section([of.lane(-1, inner=record)])
    kind = '<type s="0" type="town"><speed max="13" unit="m/s"/></type>'
    (lane,) = read(of.road(1, 20.0, sections=section, kind=kind)).lanes
    assert lane.speed_limit == pytest.approx(expected)


def signal(name, code, s, orientation, inner="", tag="signal", **attributes):
    more = "".join(f' {k}="{v}"' for k, v in attributes.items())
    dynamic = "yes" if code == "1000001" else "no"
    own = f' type="{code}" dynamic="{dynamic}" name="x"' if tag == "signal" else ""
    return (
        f'<{tag} id="{name}" s="{s}" t="-5" orientation="{orientation}"{own}{more}>{inner}</{tag}>'
    )


def validity(a, b):
    return f'<validity fromLane="{a}" toLane="{b}"/>'


FOUR = of.section([of.lane(2), of.lane(1), of.lane(-1), of.lane(-2), of.lane(-3, kind="shoulder")])


def governed(network, name):
    (found,) = [s for s in network.signals if s.id == name]
    lanes = [network.lanes[g.lane] for g in found.governed]
    return {
        (x.road_id, x.lane_id): round(g.distance, 6)
        for x, g in zip(lanes, found.governed, strict=True)
    }


def test_signals_rule_lanes_by_orientation_and_validity(read):
    signals = [
        signal("a", "1000001", 15, "+"),
        signal("b", "206", 5, "-"),
        signal("c", "205", 5, "none"),
        signal("d", "1000001", 15, "+", validity(-1, -1)),
        signal("e", "1000001", 15, "+", validity(-2, 2)),
        signal("f", "1000001", 5, "-", validity(2, 2)),
    ]
    network = read(of.road(1, 20.0, sections=FOUR, extra=f"<signals>{''.join(signals)}</signals>"))
    # Distance in the direction of travel: 15 along s, 20 - 5 = 15 against it.
    assert governed(network, "a") == {("1", -1): 15.0, ("1", -2): 15.0}
    assert governed(network, "b") == {("1", 1): 15.0, ("1", 2): 15.0}
    assert governed(network, "c") == {
        ("1", 1): 15.0,
        ("1", 2): 15.0,
        ("1", -1): 5.0,
        ("1", -2): 5.0,
    }
    assert governed(network, "d") == {("1", -1): 15.0}
    assert governed(network, "e") == {("1", -1): 15.0, ("1", -2): 15.0}
    assert governed(network, "f") == {("1", 2): 15.0}
    kinds = {s.id: s.kind for s in network.signals}
    assert kinds == {
        "a": "light",
        "b": "stop",
        "c": "yield",
        "d": "light",
        "e": "light",
        "f": "light",
    }
    yaw = {s.id: s.yaw for s in network.signals}
    assert yaw["a"] == pytest.approx(0.0)
    assert abs(yaw["b"]) == pytest.approx(math.pi)
    np.testing.assert_allclose(network.signals[0].xyz, (15.0, -5.0, 0.0))


def test_signal_references_rule_further_lanes_as_carla_writes_them(read):
    """CARLA's towns: the signal itself for no lane, references with orientation turned round."""
    control = '<control signalId="7"/>'
    own = signal("7", "1000001", 3, "-", validity(0, 0))
    lost = signal("8", "1000001", 3, "-", validity(0, 0))
    near = signal("7", "", 2, "-", validity(-1, -1), tag="signalReference")
    far = signal("7", "", 18, "+", validity(1, 2), tag="signalReference")
    network = read(
        of.road(1, 20.0, sections=FOUR, extra=f"<signals>{own}{lost}</signals>"),
        of.road(2, 20.0, of.geometry("<line/>", 20.0, 0.0, 50.0), FOUR,
                extra=f"<signals>{near}{far}</signals>"),
        f'<controller id="c" sequence="3">{control}{control}</controller>',
        of.junction(5, [], '<controller id="c"/>'),
    )  # fmt: skip
    assert governed(network, "7") == {("2", -1): 2.0, ("2", 1): 2.0, ("2", 2): 2.0}
    assert [s.id for s in network.signals] == ["7"]
    assert any("left out" in w for w in network.warnings)
    assert network.controllers["c"].signals == ("7",)
    assert network.controllers["c"].sequence == 3
    assert network.junctions["5"].controllers == ("c",)


@pytest.mark.parametrize(
    ("attributes", "expected"),
    [
        ({"value": "50", "unit": "km/h"}, 50 / 3.6),
        ({"value": "30", "unit": "mph"}, 30 * 0.44704),
        ({"value": "20", "unit": "m/s"}, 20.0),
        ({"value": "60"}, 60 / 3.6),
        ({"value": "-1", "subtype": "70"}, 70 / 3.6),
        ({"value": "-1", "subtype": "-1"}, None),
    ],
)
def test_speed_signs(read, attributes, expected):
    text = signal("a", "274", 5, "+", **attributes)
    (sign,) = read(of.road(1, 20.0, extra=f"<signals>{text}</signals>")).signals
    assert sign.kind == "speed"
    assert sign.value == (None if expected is None else pytest.approx(expected))


@pytest.mark.parametrize(
    ("vendor", "lane_id"), [("VectorZero", -1), ("someone", 1)], ids=["RoadRunner", "standard"]
)
def test_carlas_speed_objects_become_signs(read, vendor, lane_id):
    names = ["Speed_30", "speed_90", "Speed_50_b", "Speed_x", "SpeedLimit40Assembly"]
    objects = "".join(
        f'<object id="{n}" name="{n}" s="5" t="-4" orientation="-" type="-1"/>' for n in names
    )
    network = read(of.road(1, 20.0, extra=f"<objects>{objects}</objects>"), vendor=vendor)
    assert {s.id: s.value for s in network.signals} == {
        "Speed_30": pytest.approx(30 / 3.6),
        "speed_90": pytest.approx(25.0),
        "Speed_50_b": pytest.approx(50 / 3.6),
    }
    assert governed(network, "Speed_30") == {("1", lane_id): 5.0 if lane_id < 0 else 15.0}
    assert any("not read (2 times" in w for w in network.warnings)


def test_crosswalks_and_stop_lines(read):
    """A road towards +y from (100, 0): s runs along y, t to the left is -x."""
    closed = (-2, -1), (2, -1), (2, 1), (-2, 1), (-2, -1)
    local = "".join(f'<cornerLocal u="{u}" v="{v}" z="0.1"/>' for u, v in closed)
    on_road = "".join(
        f'<cornerRoad s="{s}" t="{t}" dz="0"/>' for s, t in ((8, -3), (8, 3), (10, 3), (10, -3))
    )
    place = 's="5" t="1" zOffset="0.2" hdg="1.5707963267948966"'
    objects = [
        f'<object id="1" type="crosswalk" {place}><outline>{local}</outline></object>',
        '<object id="2" type="crosswalk" s="9" t="0"><outlines><outline id="0" closed="true">'
        f"{on_road}</outline></outlines></object>",
        '<object id="3" type="crosswalk" s="15" t="0" length="2" width="6"/>',
        f'<object id="4" name="StopLine" type="-1" {place} length="4" width="0"/>',
        '<object id="5" type="crosswalk" s="9" t="0"><outlines><outline id="0">'
        f"{on_road}</outline></outlines></object>",
    ]
    extra = f"<objects>{''.join(objects)}</objects>"
    hill = of.cubic("elevation", 0.0, 3.0)
    network = read(
        of.road(
            1,
            20.0,
            of.geometry("<line/>", 20.0, 100.0, 0.0, math.pi / 2),
            elevation=hill,
            extra=extra,
        )
    )
    first, second, third = network.crosswalks
    # Object at (100 - 1, 5), turned by 90 degrees from the road, so by 180: u -> -x, v -> -y.
    expected = [(101.0, 6.0, 3.3), (97.0, 6.0, 3.3), (97.0, 4.0, 3.3), (101.0, 4.0, 3.3)]
    np.testing.assert_allclose(first, expected, atol=1e-9)
    np.testing.assert_allclose(second[:, :2], [(103, 8), (97, 8), (97, 10), (103, 10)], atol=1e-9)
    np.testing.assert_allclose(sorted(map(tuple, third[:, :2])),
                               [(97, 14), (97, 16), (103, 14), (103, 16)], atol=1e-9)  # fmt: skip
    (line,) = network.stop_lines
    np.testing.assert_allclose(sorted(map(tuple, line)), [(97, 5, 3.2), (101, 5, 3.2)], atol=1e-9)
    assert any('not closed="true"' in w for w in network.warnings)


def test_stop_line_signals_lie_across_the_lanes_they_rule(read):
    text = signal("a", "294", 18, "+", validity(-1, -1))
    (line,) = read(of.road(1, 20.0, extra=f"<signals>{text}</signals>")).stop_lines
    np.testing.assert_allclose(
        sorted(map(tuple, line[:, :2])), [(18.0, -3.5), (18.0, 0.0)], atol=1e-9
    )


# -------------------------------------------------------------------------- errors and warnings

GOOD = of.document(of.road(1, 20.0))


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ('length="20.0" id', 'length="-20.0" id', ["road 1", "length", "negative"]),
        ('length="20.0" id', 'length="nan" id', ["road 1", "length", "nan"]),
        ('length="20.0" id', 'length="1e8" id', ["road 1", "longest"]),
        ('length="20.0" id', "id", ["road 1", "no attribute 'length'"]),
        ('x="0.0"', 'x="abc"', ["road 1, geometry 0", "x='abc'"]),
        ('x="0.0"', 'x="1e300"', ["road 1, geometry 0", "1e300"]),
        ("<line/>", "", ["road 1, geometry 0", "holds no line"]),
        ("<line/>", "<arc/>", ["road 1, geometry 0", "curvature"]),
        ('<laneSection s="0.0">', '<laneSection s="30.0">', ["road 1, section 0", "off the road"]),
        ('id="-1" type', 'type="driving" x', ["road 1, section 0, lane ?", "'id'"]),
        ('id="-1" type', 'id="-1.5" type', ["road 1, section 0", "-1.5", "not a lane number"]),
        ('id="-1" type', 'id="1" type', ["road 1, section 0, lane 1", "<right>"]),
        ('<width sOffset="0.0" a="3.5"', '<x a="3.5"', ["section 0, lane 1", "neither width"]),
        ('a="3.5"', 'a="inf"', ["road 1, section 0, lane 1", "inf"]),
        ('a="3.5"', 'a="5000"', ["road 1, section 0, lane", "1000 m"]),
        ('junction="-1"', 'junction="77"', ["road 1", "junction 77"]),
        ("<link></link><planView>", of.link("successor", 5).join(["<link>", "</link><planView>"]),
         ["road 1", "successor", "road 5"]),
        ("</road>", "</road>" + of.road(1, 20.0), ["road 1", "twice"]),
        ("</OpenDRIVE>", of.junction(3, []) * 2 + "</OpenDRIVE>", ["junction 3", "twice"]),
        ("</OpenDRIVE>", of.junction(3, [(1, 8, "start", [])]) + "</OpenDRIVE>",
         ["junction 3", "road 8"]),
        ("</lanes>", '</lanes><signals><signalReference id="4" s="1"/></signals>',
         ["road 1, signalReference 4", "refers"]),
        ('type="driving"', 'type="sidewalk"', ["no lane of type 'driving'"]),
        ('version="1.0"', 'version="1.0" encoding="klingon"', ["klingon"]),
        ("<OpenDRIVE>", '<!DOCTYPE x [<!ENTITY a "b">]><OpenDRIVE>', ["entity 'a'"]),
        ("OpenDRIVE>", "Kml>", ["not OpenDRIVE", "Kml"]),
        ("</OpenDRIVE>", "", ["not well-formed"]),
    ],
)  # fmt: skip
def test_a_broken_file_is_one_line_that_says_where(read, tmp_path, old, new, parts):
    assert old in GOOD
    with pytest.raises(MapError) as e:
        read(whole=GOOD.replace(old, new))
    message = str(e.value)
    assert message.startswith(str(tmp_path / "town.xodr") + ": ")
    assert "\n" not in message
    for part in parts:
        assert part in message


def test_a_link_to_a_lane_that_nowhere_exists_is_an_error(read):
    lost = of.section([of.lane(-1, succ=-6)])
    roads = [
        of.road(1, 30.0, None, lost, of.link("successor", 2, "start")),
        of.road(2, 30.0, of.geometry("<line/>", 30.0, 30.0)),
    ]  # fmt: skip
    with pytest.raises(
        MapError, match="road 1, section 0, lane -1: is linked to lane -6 of road 2"
    ):
        read(*roads)


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda p: None, "can't be read"),
        (lambda p: p.write_bytes(b""), "is empty"),
        (lambda p: p.write_bytes(bytes(range(256))), "not well-formed"),
        (lambda p: p.mkdir(), "is a directory"),
    ],
    ids=["missing", "empty", "binary", "directory"],
)
def test_what_is_no_file_of_roads(tmp_path, make, reason):
    path = tmp_path / "town.xodr"
    make(path)
    with pytest.raises(MapError, match=reason):
        opendrive.load(path)


def test_what_is_not_read_is_named_once_with_its_count(read):
    tilted = of.road(1, 20.0).replace(
        "<lateralProfile/>",
        f"<lateralProfile>{of.cubic('superelevation', 0.0, 0.05)}</lateralProfile>",
    )
    flat = of.road(3, 20.0).replace(
        "<lateralProfile/>", f"<lateralProfile>{of.cubic('superelevation', 0.0)}</lateralProfile>"
    )
    twice = tilted.replace('id="1" junction', 'id="2" junction')
    network = read(tilted, twice, flat)
    assert network.warnings == (
        "superelevation is not read: roads are flat across (2 times; first: road 1)",
    )


def test_a_junction_outside_the_file_ends_the_road_with_a_warning(read):
    network = read(of.road(1, 20.0, links=of.link("successor", 4, kind="junction")))
    assert leads_to(network)["1", 0, -1] == set()
    assert len(network.warnings) == 1
    assert "junction that the file does not have" in network.warnings[0]


def test_namespaces_and_ids_that_are_no_numbers(read):
    text = GOOD.replace("<OpenDRIVE>", '<OpenDRIVE xmlns="http://www.opendrive.org">')
    assert len(read(whole=text).lanes) == 2
    network = read(of.road("main street", 20.0))
    assert {lane.road_id for lane in network.lanes} == {"main street"}


STRANGE = [
    "",
    "nan",
    "-inf",
    "1e400",
    "-1",
    "0",
    "abc",
    "99999999999",
    "start",
    "junction",
    "1e5",
    "-5.5",
]


def mutate(rng, root):
    """Drops, copies, or changes one thing at random."""
    elements = list(root.iter())
    parents = {child: parent for parent in elements for child in parent}
    element = rng.choice(elements)
    what = rng.random()
    if what < 0.2 and element.attrib:
        del element.attrib[rng.choice(sorted(element.attrib))]
    elif what < 0.7 and element.attrib:
        element.attrib[rng.choice(sorted(element.attrib))] = rng.choice(STRANGE)
    elif what < 0.85 and element in parents:
        parents[element].remove(element)
    elif element in parents:
        parents[element].append(copy.deepcopy(element))


@pytest.mark.parametrize("name", sorted(of.FILES))
def test_a_file_damaged_at_random_loads_or_says_why(tmp_path, name):
    rng = random.Random(name)
    path = tmp_path / "town.xodr"
    outcomes = set()
    for _ in range(60):
        root = ET.fromstring(of.FILES[name])
        for _ in range(rng.choice([1, 1, 2, 4])):
            mutate(rng, root)
        path.write_bytes(ET.tostring(root))
        try:
            network = opendrive.load(path)
        except MapError as e:
            assert str(e).startswith(str(path))
            assert str(e).isprintable()
            outcomes.add("error")
        else:
            assert all(np.isfinite(lane.xyz).all() for lane in network.lanes)
            outcomes.add("loaded")
    assert outcomes == {"error", "loaded"}
