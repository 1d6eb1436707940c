"""The static world in pixels: areas, lines and nearest lane points."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from crossing_world import lane, network

from carljax.sim import atlas
from carljax.sim.road_map import (
    LAYER_JUNCTION,
    LAYER_MARK_BROKEN,
    LAYER_MARK_SOLID,
    LAYER_PARKING,
    LAYER_ROAD,
    LAYER_SHOULDER,
)


def inside_polygon(point, corners) -> bool:
    """Ray casting in float64, one point and one polygon (the oracle)."""
    x, y = point
    inside = False
    for (ax, ay), (bx, by) in zip(np.roll(corners, 1, axis=0), corners, strict=True):
        if (ay <= y) != (by <= y) and x < ax + (y - ay) / (by - ay) * (bx - ax):
            inside = not inside
    return inside


def bits_at(bits, origin, x, y):
    column, row = np.round((np.array([x, y]) - origin) * 2).astype(int)
    return int(bits[row, column])


@pytest.fixture(scope="module")
def town():
    net = network()
    origin, shape = atlas.frame(net)
    return net, origin, shape, atlas.layers(net, origin, shape)


def test_random_polygons_match_ray_casting_at_every_pixel():
    rng = np.random.default_rng(0)
    centre = rng.uniform(-5, 65, (40, 1, 2))
    corners = centre + rng.uniform(-14, 14, (40, 4, 2))  # some cross themselves, some leave
    filled = atlas.fill_polygons(corners, (50, 60))
    snapped = np.round(corners * 256) / 256
    expected = [
        [any(inside_polygon((column, row), quad) for quad in snapped) for column in range(60)]
        for row in range(50)
    ]
    assert 0.2 < filled.mean() < 0.98
    np.testing.assert_array_equal(filled, expected)


def test_two_polygons_that_share_an_edge_cover_each_pixel_once():
    # A fan of triangles around a point between the pixels tiles the square from 0.3 to 39.8.
    rim = [(x, 0.3) for x in np.linspace(0.3, 39.8, 8)]
    rim += [(39.8, y) for y in np.linspace(0.3, 39.8, 8)]
    rim += [(x, 39.8) for x in np.linspace(39.8, 0.3, 8)]
    rim += [(0.3, y) for y in np.linspace(39.8, 0.3, 8)]
    count = np.zeros((41, 41), int)
    for a, b in zip(rim, np.roll(rim, -1, axis=0), strict=True):
        if tuple(a) != tuple(b):
            count += atlas.fill_polygons(np.array([[(17.4, 22.2), a, b]]), (41, 41))
    expected = np.zeros((41, 41), int)
    expected[1:40, 1:40] = 1  # centres 1 ... 39 lie inside
    np.testing.assert_array_equal(count, expected)


def test_nothing_to_fill_is_an_empty_picture_and_a_huge_polygon_is_refused():
    assert not atlas.fill_polygons(np.zeros((0, 4, 2)), (5, 6)).any()
    with pytest.raises(ValueError, match="101 pixels is too large"):
        atlas.fill_polygons(np.array([[(0, 0), (100, 0), (0, 100)]]), (200, 200))


def test_layers_at_places_known_by_heart(town):
    _, origin, _, bits = town
    expected = {
        (-50.0, 1.5): LAYER_ROAD,
        (50.0, -2.0): LAYER_ROAD,
        (1.5, 50.0): LAYER_ROAD,
        (0.0, 0.0): LAYER_ROAD | LAYER_JUNCTION,
        (9.0, -3.0): LAYER_ROAD | LAYER_JUNCTION,
        (-50.0, 0.0): LAYER_ROAD | LAYER_MARK_BROKEN,
        (50.0, 3.0): LAYER_ROAD | LAYER_MARK_SOLID,
        (-50.0, -4.5): LAYER_SHOULDER,
        (50.0, -4.5): 0,
        (4.5, 50.0): LAYER_ROAD | LAYER_PARKING,
        (8.0, 8.0): 0,
        (-50.0, 20.0): 0,
    }
    assert {place: bits_at(bits, origin, *place) for place in expected} == expected


def test_area_of_the_roads_in_pixels(town):
    bits = town[3]
    # Four arms of 100 x 7 m, a cross of 20 x 7 m strips, a parking lane of 100 x 2 m; 4 px/m^2.
    cross = 2 * 20 * 7 - 7 * 7
    assert np.count_nonzero(bits & LAYER_ROAD) == pytest.approx(
        4 * (4 * 100 * 7 + cross + 100 * 2), rel=0.01
    )
    assert np.count_nonzero(bits & LAYER_JUNCTION) == pytest.approx(4 * cross, rel=0.04)
    assert np.count_nonzero(bits & LAYER_SHOULDER) == pytest.approx(4 * 100 * 2, rel=0.02)
    # Each arm of the road along x has 101 m (half a width more at either end) of line, 2 px thick.
    assert np.count_nonzero(bits & LAYER_MARK_BROKEN) == pytest.approx(2 * 4 * 101, rel=0.02)


def test_layers_of_a_bend_match_point_in_polygon():
    angle = np.linspace(0.2, 2.4, 60)
    centre = 30 * np.column_stack([np.cos(angle), np.sin(angle)])
    bend = dataclasses.replace(
        lane((0, 0), (59, 0)),
        xyz=np.column_stack([centre, np.zeros(60)]),
        yaw=angle + np.pi / 2,
        width=np.linspace(3.0, 5.0, 60),
    )
    net = dataclasses.replace(network(), lanes=(bend,), marks=())
    origin, shape = atlas.frame(net, margin=5.0)
    bits = atlas.layers(net, origin, shape)
    row, column = np.mgrid[: shape[0], : shape[1]]
    x, y = column / 2 + origin[0], row / 2 + origin[1]
    along = np.arctan2(y, x)
    half = np.interp(along, angle, bend.width) / 2
    off = np.abs(np.hypot(x, y) - 30)
    sure = (np.abs(off - half) > 0.02) & (np.abs(along - 0.2) > 0.01) & (np.abs(along - 2.4) > 0.01)
    expected = (off < half) & (along > 0.2) & (along < 2.4)
    assert sure.mean() > 0.95
    np.testing.assert_array_equal((bits & LAYER_ROAD > 0)[sure], expected[sure])


def test_the_frame_keeps_its_margin_on_all_sides(town):
    _, origin, shape, bits = town
    # Lanes reach from -110 to 110 m on both axes (the sidewalk is not drawn).
    np.testing.assert_array_equal(origin, [-190.0, -190.0])
    assert shape == (761, 761)  # 380 m at 2 px/m, both ends included
    row, column = np.nonzero(bits)
    assert row.min() >= 155 and column.min() >= 155
    assert row.max() <= 605 and column.max() <= 605


def test_a_long_lane_of_two_points_is_filled_like_one_of_many():
    short = lane((0.2, 0.1), (150.3, 40.2))
    long = dataclasses.replace(
        short, **{name: getattr(short, name)[[0, -1]] for name in ("xyz", "width", "s", "yaw")}
    )
    nets = [dataclasses.replace(network(), lanes=(x,), marks=()) for x in (short, long)]
    origin, shape = atlas.frame(nets[0], margin=10.0)
    a, b = (atlas.layers(net, origin, shape) for net in nets)
    assert np.count_nonzero(a) > 2000
    assert np.count_nonzero(a != b) <= 2  # centres within 1/512 px of a border may fall either way


def test_nearest_point_equals_brute_force():
    rng = np.random.default_rng(1)
    points = rng.uniform(-20, 60, (200, 2)) * [1, 0.4]
    origin, shape = np.array([-60.0, -40.0]), (130, 250)
    index = atlas.nearest_point(points, origin, shape, max_distance=15.0)
    row, column = np.mgrid[: shape[0], : shape[1]]
    places = np.stack([column, row], axis=-1) / 2 + origin
    distance = np.linalg.norm(places[:, :, None] - points, axis=-1)
    expected = np.where(distance.min(axis=-1) < 15.0, distance.argmin(axis=-1), -1)
    assert 0.1 < (expected < 0).mean() < 0.9
    np.testing.assert_array_equal(index, expected)
