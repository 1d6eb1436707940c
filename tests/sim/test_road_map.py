"""Look-ups in the map against float64 brute force, and several towns in one table."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_world import arc, crossing, link, network, road, straight

from carljax.sim import road_map, road_map_builder, spawn, town
from carljax.sim.road_map import LAYER_JUNCTION, LAYER_ROAD, PIXELS_PER_METRE, picture
from carljax.sim.types import STOP_LIGHT

REACH = 30.0  # m, documented reach of the nearest-lane query
nearest_lanes = jax.jit(jax.vmap(road_map.nearest_lane, in_axes=(None, None, 0)))
layer_bits = jax.jit(road_map.layer_bits)
pose_at = jax.jit(road_map.pose_at)


@pytest.fixture(scope="module")
def grid(bundled):
    return bundled["grid"], road_map_builder.build([bundled["grid"]])


def random_points(rows, num, on_centres):
    """Points in the town's picture, and around it where they need not be pixel centres."""
    rng = np.random.default_rng(0)
    height, width = rows.picture_size[0]
    origin = np.asarray(rows.origin[0], float)
    if on_centres:
        return origin + rng.integers(0, [width, height], (num, 2)) / PIXELS_PER_METRE
    size = np.array([width, height]) / PIXELS_PER_METRE
    return origin + rng.uniform(-20, size + 20, (num, 2))


@pytest.mark.parametrize("on_centres", [True, False])
def test_nearest_lane_is_that_of_brute_force(grid, on_centres):
    there, rows = grid
    table = there.lanes
    xy = random_points(rows, 800, on_centres)
    got = jax.tree.map(np.asarray, nearest_lanes(rows, jnp.int32(0), jnp.asarray(xy, jnp.float32)))
    distance = np.hypot(*(xy[:, None] - table.point_xyz[None, :, :2]).transpose(2, 0, 1))
    # Off the pixel centres the answer is that of the centre, up to 0.354 m away: 0.71 m farther.
    slack = 1e-3 if on_centres else 0.71
    height, width = rows.picture_size[0]
    pixel = (xy - np.asarray(rows.origin[0])) * PIXELS_PER_METRE
    outside = ((pixel < -0.5) | (pixel > np.array([width, height]) - 0.5)).any(axis=1)
    num_found = 0
    for i in range(len(xy)):
        least = distance[i].min()
        if got.lane[i] < 0:
            assert outside[i] or least > REACH - slack
            assert got.lateral[i] == REACH
            continue
        num_found += 1
        points = table.points(got.lane[i])
        mine = distance[i, points]
        assert least < REACH + slack and mine.min() <= least + slack
        k = int(np.argmin(mine))
        if not on_centres or np.sort(mine)[1] - mine[k] < 2e-3:
            continue  # another point may be as near
        yaw = table.point_yaw[points][k]
        offset = xy[i] - table.point_xyz[points][k, :2]
        length = table.length[got.lane[i]]
        s = k * length / (len(mine) - 1) + offset @ [np.cos(yaw), np.sin(yaw)]
        want = [np.clip(s, 0, length), offset @ [-np.sin(yaw), np.cos(yaw)]]
        np.testing.assert_allclose([got.s[i], got.lateral[i]], want, atol=2e-3)
        want = [np.cos(yaw), np.sin(yaw), table.point_width[points][k]]
        measured = [np.cos(got.yaw[i]), np.sin(got.yaw[i]), got.width[i]]
        np.testing.assert_allclose(measured, want, atol=1e-4)
        assert got.in_junction[i] == (table.junction[got.lane[i]] is not None)
    assert num_found > 250


def test_outside_the_picture_there_is_nothing(grid):
    rows = grid[1]
    height, width = (int(size) for size in rows.picture_size[0])
    low = np.asarray(rows.origin[0])
    high = low + np.array([width - 1, height - 1]) / PIXELS_PER_METRE
    middle = (low + high) / 2
    outside = [(low[0] - 1, middle[1]), (middle[0], low[1] - 1)]
    outside += [(high[0] + 1, middle[1]), (middle[0], high[1] + 1), (1e6, -1e6)]
    xy = jnp.asarray(outside, jnp.float32)
    assert (layer_bits(rows, jnp.int32(0), xy) == 0).all()
    assert layer_bits(rows, jnp.int32(0), xy).dtype == jnp.uint8
    assert (road_map.pixel(rows, jnp.int32(0), xy) == -1).all()
    assert (nearest_lanes(rows, jnp.int32(0), xy).lane == -1).all()
    corners = jnp.asarray([low, high], jnp.float32)
    assert road_map.pixel(rows, jnp.int32(0), corners).tolist() == [0, height * width - 1]


def lane_offsets(one, xy):
    """Of each point: distance to a lane's centre line, half its width there, is it beside it."""
    a, b = one.xyz[:-1, :2], one.xyz[1:, :2]
    piece = b - a
    size = np.maximum((piece**2).sum(axis=1), 1e-12)
    along = ((xy[:, None] - a) * piece).sum(axis=2) / size
    on = np.clip(along, 0, 1)
    gap = np.hypot(*(xy[:, None] - a - on[..., None] * piece).transpose(2, 0, 1))
    near = np.argmin(gap, axis=1)
    each = np.arange(len(xy))
    beyond = (along[:, 0] < 0) | (along[:, -1] > 1)
    return gap[each, near], one.width[near] / 2, ~beyond


def test_layers_are_those_of_brute_force(grid):
    there, rows = grid
    xy = random_points(rows, 1500, on_centres=False)
    bits = np.asarray(layer_bits(rows, jnp.int32(0), jnp.asarray(xy, jnp.float32)))
    inside, inside_junction = np.zeros(len(xy), bool), np.zeros(len(xy), bool)
    away, away_from_junctions = np.ones(len(xy), bool), np.ones(len(xy), bool)
    for one in there.network.lanes:
        low, high = one.xyz[:, :2].min(axis=0) - 8, one.xyz[:, :2].max(axis=0) + 8
        close = np.flatnonzero(((xy > low) & (xy < high)).all(axis=1))
        if len(close) == 0:
            continue
        gap, half, beside = lane_offsets(one, xy[close])
        # Half a pixel's diagonal, and half the 1 m of a painted line beside the lane.
        far = gap > half + 1.0
        away[close] &= far
        if one.kind == "driving":
            within = beside & (gap < half - 0.4)
            inside[close] |= within
            if one.junction is not None:
                inside_junction[close] |= within
                away_from_junctions[close] &= far
    assert inside.sum() > 50 and inside_junction.sum() > 5 and away.sum() > 500
    assert (bits[inside] & LAYER_ROAD).all()
    assert (bits[inside_junction] & LAYER_JUNCTION).all()
    assert not (bits[away_from_junctions] & LAYER_JUNCTION).any()
    assert not bits[away].any()


def test_pose_is_linear_between_points(grid):
    there, rows = grid
    table = there.lanes
    rng = np.random.default_rng(1)
    lane = rng.integers(0, len(table.length), 300)
    s = rng.uniform(-0.1, 1.1, 300) * table.length[lane]  # clipped to the lane
    got = pose_at(rows, jnp.asarray(lane, jnp.int32), jnp.asarray(s, jnp.float32))
    for i in range(300):
        points = table.points(lane[i])
        known = np.linspace(0, table.length[lane[i]], int(table.num_points[lane[i]]))
        xyz = [np.interp(s[i], known, table.point_xyz[points][:, k]) for k in range(3)]
        np.testing.assert_allclose(got.xy[i], xyz[:2], atol=2e-3)
        np.testing.assert_allclose(got.z[i], xyz[2], atol=1e-3)
        yaw = np.interp(s[i], known, np.unwrap(table.point_yaw[points]))
        turned = (np.asarray(got.yaw[i], float) - yaw + np.pi) % (2 * np.pi) - np.pi
        np.testing.assert_allclose(turned, 0, atol=2e-4)
        assert -np.pi <= got.yaw[i] <= np.pi


def test_curvature_of_an_arc():
    net = network([arc((0, 0), 3.0, 20.0, 1.0), arc((0, 0), 1.0, 25.0, -1.0)])
    rows = road_map_builder.build([town.from_network(net)])
    got = pose_at(rows, jnp.asarray([0, 1], jnp.int32), jnp.asarray([7.3, 11.8], jnp.float32))
    np.testing.assert_allclose(got.curvature, [1 / 20, -1 / 25], rtol=1e-3)


@pytest.fixture(scope="module")
def pair():
    """Two towns of different sizes, alone and together."""
    bend = [straight((0, 0), (150, 0)), arc((150, 0), 0.0, 30.0, 2.0), straight((0, 9), (150, 9))]
    both = [
        town.from_network(crossing({"east": "light", "north": "stop"})),
        town.from_network(network(link(bend, [(0, 1)]))),
    ]
    return both, [road_map_builder.build([t]) for t in both], road_map_builder.build(both)


# Which table each index points into; -1 stays apart.
POINTS_TO = {
    "lane_start": "point_lane",
    "lane_successors": "lane_length",
    "lane_light": "light_cycle",
    "point_lane": "lane_length",
}
PER_LANE = [name for name in road_map.RoadMap.__dataclass_fields__ if name.startswith("lane_")]
PER_POINT = [name for name in road_map.RoadMap.__dataclass_fields__ if name.startswith("point_")]
PER_LIGHT = ["light_cycle", "light_start"]


@pytest.mark.parametrize("number", [0, 1])
@pytest.mark.parametrize("name", PER_LANE + PER_POINT + PER_LIGHT)
def test_towns_together_are_each_alone_with_rows_shifted(pair, name, number):
    _, alone, together = pair
    mine, rows = np.asarray(getattr(alone[number], name)), np.asarray(getattr(together, name))
    before = sum(len(getattr(m, name)) for m in alone[:number])
    rows = rows[before : before + len(mine)]
    if name in ("lane_successors", "lane_meeting"):  # padded to the wider town
        pad = rows[..., mine.shape[-1] :]
        assert (pad == (-1 if name == "lane_successors" else 0)).all()
        rows = rows[..., : mine.shape[-1]]
    if name == "lane_town":
        assert (rows == number).all()
    elif name in ("lane_junction",):  # names: what is equal must stay so
        same = mine[:, None] == mine[None, :]
        np.testing.assert_array_equal(rows[:, None] == rows[None, :], same)
        np.testing.assert_array_equal(rows < 0, mine < 0)
    elif name in POINTS_TO:
        shift = sum(len(getattr(m, POINTS_TO[name])) for m in alone[:number])
        np.testing.assert_array_equal(rows, np.where(mine >= 0, mine + shift, mine))
    else:
        np.testing.assert_array_equal(rows, mine)


def test_names_of_junctions_are_not_shared_between_towns(pair):
    both, _, together = pair
    num, values = len(both[0].lanes.length), together.lane_junction
    first, second = (set(x.tolist()) - {-1} for x in (values[:num], values[num:]))
    assert first.isdisjoint(second)


@pytest.mark.parametrize("number", [0, 1])
def test_pictures_and_grids_of_towns_lie_one_after_another(pair, number):
    _, alone, together = pair
    mine = alone[number]
    np.testing.assert_array_equal(together.origin[number], mine.origin[0])
    assert len(together.layers) == sum(len(m.layers) for m in alone)
    assert picture(mine, 0, mine.layers).shape == tuple(mine.picture_size[0])
    np.testing.assert_array_equal(
        picture(together, number, together.layers), picture(mine, 0, mine.layers)
    )
    shift = sum(len(m.point_lane) for m in alone[:number])
    nearest = picture(mine, 0, mine.nearest_point)
    np.testing.assert_array_equal(
        picture(together, number, together.nearest_point),
        np.where(nearest >= 0, nearest + shift, nearest),
    )
    assert together.grid_start[number] == sum(len(m.spawn_lane) for m in alone[:number])
    np.testing.assert_array_equal(together.grid_size[number], mine.grid_size[0])
    assert mine.grid_size[0].prod() == len(mine.spawn_lane)
    rows = int(together.grid_start[number]) + np.arange(len(mine.spawn_lane))
    shift = sum(len(m.lane_length) for m in alone[:number])
    lane = np.asarray(mine.spawn_lane)
    assert (lane >= 0).any()
    np.testing.assert_array_equal(
        together.spawn_lane[rows], np.where(lane >= 0, lane + shift, lane)
    )
    np.testing.assert_array_equal(together.spawn_s[rows], mine.spawn_s)


def test_the_cell_of_a_place_is_the_one_around_it_or_the_nearest(pair):
    _, _, together = pair
    for number in range(2):
        rows, columns = (int(size) for size in together.grid_size[number])
        start, origin = int(together.grid_start[number]), together.origin[number]
        for row, column in ((0, 0), (1, 2), (rows - 1, columns - 1)):
            middle = origin + 20.0 * (jnp.array([column, row]) + 0.5)
            cell = road_map.grid_cell(together, jnp.int32(number), middle, 20.0)
            assert cell == start + row * columns + column
        far = road_map.grid_cell(together, jnp.int32(number), origin - 500.0, 20.0)
        assert far == start
        far = road_map.grid_cell(together, jnp.int32(number), origin + 1e4, 20.0)
        assert far == start + rows * columns - 1


def test_look_ups_stay_in_their_town(pair):
    both, alone, together = pair
    xy = jnp.asarray(np.random.default_rng(2).uniform(-100, 100, (200, 2)), jnp.float32)
    num = len(both[0].lanes.length)
    for number, shift in ((0, 0), (1, num)):
        want = nearest_lanes(alone[number], jnp.int32(0), xy)
        got = nearest_lanes(together, jnp.int32(number), xy)
        found = np.asarray(want.lane) >= 0
        assert found.any()
        np.testing.assert_array_equal(np.asarray(got.lane)[found], want.lane[found] + shift)
        np.testing.assert_array_equal(got.lateral, want.lateral)
        bits = layer_bits(alone[number], jnp.int32(0), xy)
        np.testing.assert_array_equal(layer_bits(together, jnp.int32(number), xy), bits)


def test_a_town_keeps_its_shape_far_from_the_origin():
    # At UTM coordinates float32 resolves 0.25 m; towns are moved to the origin before rounding.
    near, far = road(0, 100), network([straight((5e5, 4.6e6), (5e5 + 100, 4.6e6))])
    one, other = town.from_network(near), town.from_network(far)
    np.testing.assert_allclose(other.offset - one.offset, [5e5, 4.6e6])
    np.testing.assert_allclose(other.lanes.point_xyz, one.lanes.point_xyz, atol=1e-6)
    np.testing.assert_allclose(other.lanes.point_xyz[[0, -1], 0], [-50, 50])


def test_stop_kinds_and_lights_reach_the_device(pair):
    both, _, together = pair
    held = np.asarray(together.lane_stop_kind) == STOP_LIGHT
    assert held.sum() == 3 and (np.asarray(together.lane_light)[held] == 0).all()
    assert (np.asarray(together.lane_light)[~held] == -1).all()


def test_places_for_traffic():
    # A lane of 40 m: 6 m from its ends, every 8 m.
    found = spawn.places(town.from_network(road(0, 40)).lanes)
    np.testing.assert_allclose(found.s, [6, 14, 22, 30])
    np.testing.assert_allclose(found.xy[:, 0], found.s - 20)  # moved to the origin


def test_no_places_in_junctions_or_where_a_lane_is_narrow():
    lanes = [
        straight((0, 0), (40, 0), width=np.linspace(0.0, 4.0, 41)),  # 2.5 m wide from 25 m on
        straight((0, 9), (40, 9), junction="9"),
    ]
    found = spawn.places(town.from_network(network(lanes)).lanes)
    np.testing.assert_allclose(found.s, [30])
    alone = spawn.places(town.from_network(network(lanes[1:])).lanes)
    assert alone.xy.shape == (0, 2)


def test_respawn_places_lie_in_a_ring_around_each_cell():
    there = town.from_network(road(0, 400))
    rng = np.random.default_rng(0)
    origin = np.array([-240.0, -40.0])
    lane, s = spawn.respawn_table(spawn.places(there.lanes), origin, (480.0, 80.0), 0)
    assert lane.shape == s.shape == (4, 24, 16)
    for row, column in rng.integers(0, [4, 24], (30, 2)):
        centre = origin + 20.0 * np.array([column + 0.5, row + 0.5])
        used = lane[row, column] >= 0
        away = np.hypot(s[row, column] - 200 - centre[0], centre[1])[used]
        assert ((away > 60) & (away < 140)).all()
        all_s = np.arange(6, 394, 8)
        every = np.hypot(all_s - 200 - centre[0], centre[1])
        assert used.sum() == min(16, ((every > 60) & (every < 140)).sum())
        assert len(set(s[row, column][used])) == used.sum()
