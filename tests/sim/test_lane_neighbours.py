"""The lane beside: by hand, and against a search among all lane points in the bundled towns."""

import pathlib

import numpy as np
import pytest
from small_world import link, network, straight

from carljax.sim import lane_neighbours, lane_table, road_map_builder, town
from carljax.sim.road_network import MARK_BROKEN, MARK_SOLID, RoadMark

DATA = pathlib.Path(__file__).parents[2].parent / "shared" / "data" / "maps"


def two_lanes(marks=(), **fields):
    """Lanes of 40 m to the east at y = 0 (right, in two pieces) and y = 3.5 (left, one piece)."""
    beside = {"right": 2, "right_is_same_direction": True} | fields
    lanes = [
        straight((0, 0), (20, 0), left=1, left_is_same_direction=True),
        straight((0, 3.5), (20, 3.5), right=0, right_is_same_direction=True),
        straight((20, 0), (40, 0), left=3, left_is_same_direction=True, section=1),
        straight((20, 3.5), (40, 3.5), section=1, **beside),
    ]
    return network(link(lanes, [(0, 2), (1, 3)]), marks=tuple(marks))


def line(kind, *ends, y=1.75):
    x = np.linspace(*ends, 1 + int(ends[1] - ends[0]))
    return RoadMark(np.column_stack([x, np.full(len(x), y)]), kind, "white", np.zeros(len(x)))


def neighbours(net):
    table = lane_table.build(net)
    return table, lane_neighbours.build(net, table)


def test_points_side_by_side_are_neighbours_across_joined_pieces():
    table, found = neighbours(two_lanes())
    assert len(table.length) == 2  # two lanes of 41 points each, one a metre
    right, left = table.points(table.raw_lane[0]), table.points(table.raw_lane[1])
    np.testing.assert_array_equal(found.left[right], np.arange(41) + left.start)
    np.testing.assert_array_equal(found.right[left], np.arange(41) + right.start)
    assert (found.right[right] == -1).all() and (found.left[left] == -1).all()


def test_no_change_across_a_solid_line():
    _, found = neighbours(two_lanes([line(MARK_SOLID, 0, 15), line(MARK_BROKEN, 15, 40)]))
    # metres 0 to 15 lie at the solid line
    assert (found.left[:16] == -1).all() and (found.left[16:41] >= 0).all()


def test_a_solid_line_on_the_other_side_or_above_does_not_matter():
    above = line(MARK_SOLID, 0, 40)
    above = RoadMark(above.xy, above.kind, above.colour, above.z + 6.0)
    _, found = neighbours(two_lanes([line(MARK_SOLID, 0, 40, y=-1.75), above]))
    assert (found.left[:41] >= 0).all()


def test_no_change_to_oncoming_or_narrow_lanes_nor_in_junctions():
    table, found = neighbours(two_lanes(right_is_same_direction=False))
    left = table.points(table.raw_lane[3])
    assert (found.right[left][21:] == -1).all() and (found.right[left][:21] >= 0).all()
    narrow = straight((0, 3.5), (20, 3.5), width=np.linspace(0.0, 4.0, 21))
    lanes = [straight((0, 0), (20, 0), left=1, left_is_same_direction=True), narrow]
    _, found = neighbours(network(lanes))
    # 0.2 m wider each metre: 2.5 m wide from 12.5 m on
    np.testing.assert_array_equal(found.left[:21] >= 0, np.arange(21) > 12)
    inside = [
        straight((0, 0), (9, 0), left=1, left_is_same_direction=True, junction="1"),
        straight((0, 3.5), (9, 3.5), junction="1"),
    ]
    assert (neighbours(network(inside))[1].left == -1).all()


def test_the_shared_table_keeps_neighbours_within_their_town():
    towns = [town.from_network(two_lanes()) for _ in range(2)]
    road_map = road_map_builder.build(towns)
    size = len(towns[0].lanes.point_lane)
    left = np.asarray(road_map.point_left).reshape(2, size)
    np.testing.assert_array_equal(left[1], np.where(left[0] >= 0, left[0] + size, -1))
    assert (left[0] >= 0).sum() == 41


def crosses_solid(solid, a, b):
    """Whether a solid line's piece (S, 2, 2) crosses from a to b: signs of four areas."""

    def side(p, q, r):
        return np.sign(
            (q[..., 0] - p[..., 0]) * (r[..., 1] - p[..., 1])
            - (q[..., 1] - p[..., 1]) * (r[..., 0] - p[..., 0])
        )

    p, q = solid[:, 0], solid[:, 1]
    return ((side(p, q, a) != side(p, q, b)) & (side(a, b, p) != side(a, b, q))).any()


def oracle(the_town, point, sign):
    """The lane point straight beside, 2 to 5 m to the left (1) or right, going the same way."""
    table = the_town.lanes
    outside = np.array([name is None for name in table.junction])[table.point_lane]
    yaw = table.point_yaw[point]
    offset = table.point_xyz - table.point_xyz[point]
    ahead = offset[:, 0] * np.cos(yaw) + offset[:, 1] * np.sin(yaw)
    beside = sign * (offset[:, 1] * np.cos(yaw) - offset[:, 0] * np.sin(yaw))
    turned = np.abs((table.point_yaw - yaw + np.pi) % (2 * np.pi) - np.pi)
    fits = outside & (np.abs(ahead) < 0.8) & (beside > 2.0) & (beside < 5.0)
    fits &= (turned < 0.15) & (np.abs(offset[:, 2]) < 2.0)
    return np.flatnonzero(fits)


def check(the_town, num):
    table, net = the_town.lanes, the_town.network
    solid = [m.xy for m in net.marks if m.kind == MARK_SOLID]
    solid = np.concatenate([np.stack([xy[:-1], xy[1:]], axis=1) for xy in solid])
    road = np.array([net.lanes[chain[0]].road_id for chain in table.members])
    rng = np.random.default_rng(0)
    points = rng.choice(len(table.point_lane), min(num, len(table.point_lane)), replace=False)
    num_beside = num_missed = num_solid = 0
    for point in points:
        if table.junction[table.point_lane[point]] is not None:
            continue
        for sign, beside in ((1.0, the_town.neighbours.left), (-1.0, the_town.neighbours.right)):
            want, got = oracle(the_town, point, sign), beside[point]
            near = solid[np.hypot(*(solid[:, 0] - table.point_xyz[point, :2]).T) < 10.0]
            here = table.point_xyz[point, :2]
            blocked = [crosses_solid(near, here, table.point_xyz[w, :2]) for w in want]
            if got >= 0:
                num_beside += 1
                assert got in want and not blocked[list(want).index(got)]
                continue
            num_solid += any(blocked)
            same_road = road[table.point_lane[want]] == road[table.point_lane[point]]
            wide = table.point_width[want] > 2.6
            num_missed += (same_road & wide & ~np.array(blocked, bool)).any()
    return num_beside, num_missed, num_solid


def test_neighbours_in_the_highway_town_match_the_oracle(bundled):
    num_beside, num_missed, _ = check(bundled["highway"], 3000)
    # A change is missing only where a piece of road or a painted line ends.
    assert num_beside > 1000 and num_missed < 0.01 * num_beside


def test_neighbours_in_town06_match_the_oracle():
    path = DATA / "Town06.xodr"
    if not path.exists():
        pytest.skip(f"{path} is not there: CARLA's maps are not part of the package")
    num_beside, num_missed, num_solid = check(town.load(path), 1500)
    assert num_beside > 500 and num_missed < 0.02 * num_beside
    assert num_solid > 5  # lanes parted by solid lines are seen as such
