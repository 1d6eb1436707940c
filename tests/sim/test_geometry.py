"""Angles, frames and oriented boxes against hand-worked values and a float64 polygon oracle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from carljax.sim import geometry

WITH_AND_WITHOUT_JIT = [lambda f: f, jax.jit]


def corners_oracle(xy, yaw, length, width):
    """Corners in float64, by complex numbers."""
    offsets = np.array([1 + 1j, -1 + 1j, -1 - 1j, 1 - 1j])
    offsets = offsets.real * length / 2 + 1j * offsets.imag * width / 2
    points = complex(*xy) + offsets * np.exp(1j * yaw)
    return np.stack([points.real, points.imag], axis=-1)


def clip_area(subject, clip):
    """Area of the intersection of two convex counter-clockwise polygons (Sutherland-Hodgman)."""
    polygon = [np.asarray(p, float) for p in subject]
    for start, end in zip(clip, np.roll(clip, -1, axis=0), strict=True):
        (ax, ay), edge = start, end - start
        side = [edge[0] * (p[1] - ay) - edge[1] * (p[0] - ax) for p in polygon]
        clipped = []
        for i, point in enumerate(polygon):
            j = (i + 1) % len(polygon)
            if side[i] >= 0:
                clipped.append(point)
            if side[i] * side[j] < 0:
                clipped.append(point + side[i] / (side[i] - side[j]) * (polygon[j] - point))
        polygon = clipped
        if not polygon:
            return 0.0
    x, y = np.array(polygon).T
    return 0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))


@pytest.mark.parametrize("variant", WITH_AND_WITHOUT_JIT)
@pytest.mark.parametrize(
    ("angle", "expected"),
    [
        (0.0, 0.0),
        (3.5, 3.5 - 2 * np.pi),
        (-3.5, 2 * np.pi - 3.5),
        (7.0, 7.0 - 2 * np.pi),
        (np.pi, -np.pi),
    ],
)
def test_wrap_angle_lands_in_half_open_interval(variant, angle, expected):
    wrapped = variant(geometry.wrap_angle)(jnp.float32(angle))
    assert wrapped.dtype == jnp.float32
    np.testing.assert_allclose(wrapped, expected, atol=1e-6)


def test_quarter_turn_takes_forward_to_left():
    np.testing.assert_allclose(
        geometry.rotate(jnp.array([2.0, 0.0]), jnp.float32(np.pi / 2)), [0.0, 2.0], atol=1e-6
    )


def test_point_ahead_and_left_of_a_car_facing_north():
    # The car at (10, 5) faces north; (8, 9) is 4 m ahead and 2 m to its left.
    seen = geometry.to_frame(jnp.array([8.0, 9.0]), jnp.array([10.0, 5.0]), jnp.float32(np.pi / 2))
    np.testing.assert_allclose(seen, [4.0, 2.0], atol=1e-5)


def test_from_frame_undoes_to_frame():
    rng = np.random.default_rng(0)
    xy = jnp.asarray(rng.normal(size=(50, 2)) * 100, jnp.float32)
    origin, yaw = jnp.array([30.0, -70.0]), jnp.float32(2.1)
    back = geometry.from_frame(geometry.to_frame(xy, origin, yaw), origin, yaw)
    np.testing.assert_allclose(back, xy, atol=1e-4)


def test_corners_of_a_box_facing_east():
    corners = geometry.box_corners(jnp.array([1.0, 2.0]), 0.0, 4.0, 2.0)
    np.testing.assert_allclose(corners, [[3, 3], [-1, 3], [-1, 1], [3, 1]], atol=1e-6)


def test_corners_of_many_boxes_match_oracle():
    rng = np.random.default_rng(1)
    xy, yaw = rng.normal(size=(7, 2)) * 50, rng.uniform(-4, 4, 7)
    length, width = rng.uniform(1, 8, 7), rng.uniform(0.5, 3, 7)
    got = geometry.box_corners(*(jnp.asarray(a, jnp.float32) for a in (xy, yaw, length, width)))
    want = [corners_oracle(*args) for args in zip(xy, yaw, length, width, strict=True)]
    np.testing.assert_allclose(got, want, atol=2e-5)


@pytest.mark.parametrize(
    ("xy", "yaw", "expected"),
    [
        ((4.1, 0.0), 0.0, False),  # 2 m + 2 m < 4.1 m ahead
        ((3.9, 0.0), 0.0, True),
        ((0.0, 2.1), 0.0, False),  # 1 m + 1 m beside
        ((2.9, 0.0), np.pi / 2, True),  # crosswise: half length 2 + half width 1
        ((3.1, 0.0), np.pi / 2, False),
        # A diagonal box whose bounding box overlaps ours while the boxes are apart: corner (2, 1)
        # projects to 3/sqrt(2) = 2.12 on the diagonal, the other's near side lies at
        # (3 + 2.5)/sqrt(2) - 1 = 2.89.
        ((3.0, 2.5), -np.pi / 4, False),
        ((0.0, 0.0), 1.0, True),
    ],
)
def test_overlap_of_two_cars_by_hand(xy, yaw, expected):
    overlap = geometry.boxes_overlap(
        jnp.zeros(2), jnp.float32(0), 4.0, 2.0, jnp.array(xy), jnp.float32(yaw), 4.0, 2.0
    )
    assert bool(overlap) is expected


@pytest.mark.parametrize("variant", WITH_AND_WITHOUT_JIT)
def test_one_box_against_many_matches_polygon_clipping(variant):
    rng = np.random.default_rng(2)
    ego_xy, ego_yaw = np.array([150.0, -80.0]), 0.7
    num = 400
    xy = ego_xy + rng.normal(size=(num, 2)) * 4
    yaw = rng.uniform(-np.pi, np.pi, num)
    length, width = rng.uniform(0.5, 9, num), rng.uniform(0.4, 3, num)
    ego_box = corners_oracle(ego_xy, ego_yaw, 4.9, 1.8)
    area = np.array(
        [
            clip_area(corners_oracle(*box), ego_box)
            for box in zip(xy, yaw, length, width, strict=True)
        ]
    )
    clear = (area == 0) | (area > 1e-3)  # float32 can't decide a touch
    got = variant(geometry.boxes_overlap)(
        *(jnp.asarray(a, jnp.float32) for a in (ego_xy, ego_yaw, 4.9, 1.8, xy, yaw, length, width))
    )
    assert got.shape == (num,)
    assert 50 < (area > 0).sum() < 350
    np.testing.assert_array_equal(np.asarray(got)[clear], (area > 0)[clear])


def test_overlap_is_symmetric_and_survives_moving_the_world():
    rng = np.random.default_rng(3)
    num = 200
    ones = np.ones(num)
    a = (rng.normal(size=(num, 2)) * 3, rng.uniform(-3, 3, num), 4.0 * ones, 2.0 * ones)
    b = (rng.normal(size=(num, 2)) * 3, rng.uniform(-3, 3, num), 5.0 * ones, 2.5 * ones)
    f32 = [jnp.asarray(v, jnp.float32) for v in (*a, *b)]
    forth = geometry.boxes_overlap(*f32)
    back = geometry.boxes_overlap(*f32[4:], *f32[:4])
    moved = list(f32)
    for i in (0, 4):
        moved[i] = geometry.rotate(f32[i], jnp.float32(0.9)) + jnp.array([20.0, -10.0])
        moved[i + 1] = f32[i + 1] + 0.9
    np.testing.assert_array_equal(forth, back)
    np.testing.assert_array_equal(forth, geometry.boxes_overlap(*moved))


def test_squared_distances_are_those_of_numpy():
    rng = np.random.default_rng(5)
    a, b = rng.normal(size=(4, 1, 2)) * 100, rng.normal(size=(7, 2)) * 100
    found = geometry.squared_distance(jnp.float32(a), jnp.float32(b))
    np.testing.assert_allclose(found, np.linalg.norm(a - b, axis=-1) ** 2, rtol=1e-4, atol=1e-2)
