"""Roach's image: by hand, against a dense float64 drawing, and in a batch."""

from __future__ import annotations

import functools

import chex
import jax
import jax.numpy as jnp
import kinds_oracle
import numpy as np
import pytest
from crossing_world import agents_of, ego_at, road_map, route_east

from carljax.sim import raster_roach, raster_spans
from carljax.sim.raster_canvas import RasterConfig
from carljax.sim.road_map import picture
from carljax.sim.types import (
    KIND_NONE,
    KIND_PEDESTRIAN,
    KIND_STATIC,
    KIND_VEHICLE,
    LIGHT_GREEN,
    LIGHT_RED,
    LIGHT_YELLOW,
    STOP_LIGHT,
    STOP_SIGN,
    Trail,
)

CONFIG = raster_roach.RASTER
SMALL = RasterConfig(height=64, width=48, pixels_per_metre=2.0, ego_from_bottom_px=20)
CAR = {"length": 4.0, "width": 2.0, "kind": KIND_VEHICLE}
CAR_NOW, WALKER_NOW, SIGNAL_NOW = 6, 10, 14
GREEN = [LIGHT_GREEN] * 4


@pytest.fixture(scope="module")
def world():
    return road_map()


def trail_of(moments, ego_z=0.0):
    """A trail in which each moment stands for the steps up to it."""
    rows = np.repeat(np.arange(4), [1, 5, 5, 5])
    agents = [m[0] for m in moments]

    def steps(name):
        return jnp.stack([getattr(a, name) for a in agents])[rows]

    far = jnp.abs(steps("z") - ego_z) >= 8.0
    return Trail(
        **{name: steps(name) for name in ("xy", "yaw", "length", "width")},
        kind=jnp.where(far, KIND_NONE, steps("kind")).astype(jnp.int8),
        light=jnp.asarray(np.array([m[1] for m in moments])[rows], jnp.int8),
        stop=jnp.asarray(np.array([m[2] for m in moments])[rows], jnp.int32),
    )


@functools.partial(jax.jit, static_argnames="config")
def _render(ego, trail, world, route, idx, config):
    return raster_roach.render(ego, trail, world, route, idx, config)


def draw(world, ego, moments, route=None, idx=0, config=CONFIG):
    """The image as int; moments are (agents, colours, sign that asks), the oldest first."""
    route = route_east() if route is None else route
    trail = trail_of(moments, float(ego.z))
    image = _render(ego, trail, world, route, jnp.int32(idx), config)
    assert image.shape == (config.height, config.width, 15) and image.dtype == jnp.uint8
    return np.asarray(image).astype(int)


def stops(kinds, places):
    return route_east(
        stop_kind=np.array(kinds, np.int32),
        stop_idx=np.array(places, np.int32),
        stop_xy=np.stack([np.array(places) - 100.0, np.full(4, -1.75)], -1),
        stop_width=np.full(4, 3.5),
    )


def test_a_car_that_comes_nearer_is_seen_four_times(world):
    # Ahead 20, 16, 12, 8 m: row 152 - 5 (d +- 2), columns 96 - 5 (0.14 +- 1) = 90.3 ... 100.3.
    ego = ego_at(-60.25, -1.75)
    moments = [
        (agents_of(CAR | {"x": -60.25 + d, "y": -1.61}), GREEN, -1) for d in (20.0, 16.0, 12.0, 8.0)
    ]
    image = draw(world, ego, moments)
    for m, d in enumerate((20, 16, 12, 8)):
        rows, columns = np.nonzero(image[..., 3 + m])
        assert (rows.min(), rows.max()) == (152 - 5 * (d + 2), 152 - 5 * (d - 2) - 1)
        assert (columns.min(), columns.max()) == (90, 99)
        assert len(rows) == 20 * 10 and set(image[rows, columns, 3 + m]) == {255}
    assert not image[..., 7:].any()


def test_the_ego_is_40_px_above_the_bottom_and_left_is_left(world):
    ego = ego_at(-60.0, -1.75, 0.5)
    ahead, left = np.array([np.cos(0.5), np.sin(0.5)]), np.array([-np.sin(0.5), np.cos(0.5)])
    x, y = np.array([-60.0, -1.75]) + 10.14 * ahead + 5.14 * left
    walker = {"x": x, "y": y, "yaw": 0.5, "length": 0.5, "width": 0.5, "kind": KIND_PEDESTRIAN}
    image = draw(world, ego, [(agents_of(walker), GREEN, -1)] * 4)
    # 0.5 m twice is less than 1.6 m: rows 152 - 5 (10.14 +- 0.8), columns 96 - 5 (5.14 +- 0.8).
    rows, columns = np.nonzero(image[..., WALKER_NOW])
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (97, 104, 66, 73)
    tall = agents_of(walker | {"length": 1.2, "width": 1.2})
    image = draw(world, ego, [(tall, GREEN, -1)] * 4)
    assert np.count_nonzero(image[..., WALKER_NOW]) == 12 * 12  # 2.4 m


def test_lights_and_the_stop_sign_change_from_moment_to_moment(world):
    ego = ego_at(-40.25, -1.75)
    route = stops([STOP_LIGHT, STOP_SIGN, 0, 0], [70, 80, -1, -1])
    nobody = agents_of()
    moments = [
        (nobody, [LIGHT_GREEN] * 4, -1),
        (nobody, [LIGHT_YELLOW] * 4, 1),
        (nobody, [LIGHT_RED] * 4, 1),
        (nobody, [LIGHT_RED] * 4, -1),
    ]
    image = draw(world, ego, moments, route, idx=59)[..., 11:]
    # The line at x = -30 is 10.25 m ahead, 1.2 m thick: rows 152 - 51.25 +- 3; 2.8 m wide.
    for m, value in enumerate((80, 170, 255, 255)):
        rows, columns = np.nonzero(image[90:, :, m])
        assert (rows.min() + 90, rows.max() + 90) in ((98, 103), (97, 103), (98, 104))
        assert (columns.min(), columns.max()) == (89, 102)
        assert set(image[rows + 90, columns, m]) == {value}
    sign = np.count_nonzero(image[:75], axis=(0, 1))
    assert sign[0] == sign[3] == 0 and sign[1] == sign[2] and abs(sign[1] - 17.5**2) < 40


def random_moments(seed, x, y, slots=20):
    """Road users that move a little between moments, of all kinds and heights."""
    rng = np.random.default_rng(seed)
    kinds = rng.choice([KIND_VEHICLE, KIND_VEHICLE, KIND_PEDESTRIAN, KIND_STATIC], slots)
    start = rng.uniform([x - 10, y - 20], [x + 30, y + 20], (slots, 2))
    yaw, size = rng.uniform(-3, 3, slots), rng.uniform([0.5, 0.4], [1.0, 1.0], (slots, 2))
    size[kinds == KIND_VEHICLE] *= [10.0, 2.5]
    z = rng.choice([0.0, 2.0, 9.0], slots)
    moments = []
    for step in range(4):
        users = [
            {
                "x": start[n, 0] + 2 * step * np.cos(yaw[n]),
                "y": start[n, 1] + 2 * step * np.sin(yaw[n]),
                "yaw": yaw[n] + 0.1 * step,
                "length": size[n, 0],
                "width": size[n, 1],
                "kind": int(kinds[n]),
                "z": z[n],
            }
            for n in range(slots)
        ]
        moments.append((agents_of(*users, slots=slots), rng.integers(0, 3, 4), (1, 1, -1, 3)[step]))
    return moments


@pytest.mark.parametrize("config", [CONFIG, SMALL], ids=["192 at 5 px/m", "64 x 48 at 2 px/m"])
@pytest.mark.parametrize("seed", [0, 1])
def test_random_scenes_match_the_oracle(world, config, seed):
    ego = ego_at(-34.3 + 11 * seed, -1.1, 0.4 - 0.9 * seed)
    moments = random_moments(seed, float(ego.xy[0]), float(ego.xy[1]))
    kinds = [STOP_LIGHT, STOP_SIGN, STOP_LIGHT, STOP_SIGN]
    route = stops(kinds, [72 + 8 * seed, 76, 84, 90])
    image = draw(world, ego, moments, route, 66, config)
    layers, origin = picture(world, 1, world.layers), np.asarray(world.origin[1])
    expected = kinds_oracle.roach(ego, moments, layers, origin, route, 66, config)
    assert (image == expected).all(axis=-1).mean() > 0.99
    for channel, name in enumerate(raster_roach.CHANNELS):
        ours, theirs = image[..., channel], expected[..., channel]
        both = np.count_nonzero((ours == theirs) & (theirs > 0))
        either = np.count_nonzero(ours | theirs)
        # The route ends square here and round there; of small things a pixel is much at 2 px/m.
        assert both >= (0.97 if config is CONFIG else 0.9) * either - 3, name
    assert np.count_nonzero(expected.any(axis=(0, 1))) >= 13


def test_a_route_that_changes_lanes_has_no_hole(world):
    shifted = np.where(np.arange(201) < 60, -1.75, 1.75)
    xy = np.stack([np.arange(201) - 100.0, shifted], -1)
    image = draw(world, ego_at(-50.0, 0.0), [(agents_of(), GREEN, -1)] * 4, route_east(xy=xy), 50)
    # From the line 10 m ahead the route goes 3.5 m to the left within a metre.
    assert (image[100:105, 90:103, 1] == 255).all()


def test_crowds_show_the_nearest(world):
    crowd = [CAR | {"x": -40.0 + 0.1 * k, "y": 5.0} for k in range(60)]
    agents = agents_of(*crowd, slots=60)
    assert raster_roach.num_nearest(CONFIG, 60) == 25  # 38.4^2 m^2 / 60
    image = draw(world, ego_at(-60.0, 0.0), [(agents, GREEN, -1)] * 4)
    rows = np.flatnonzero(image[..., CAR_NOW].any(axis=1))
    # The image's middle is 11.2 m ahead, so the first cars: 18 m to 24.4 + 2 m ahead.
    assert rows.max() == 152 - 90 - 1 and rows.min() == 152 - 122


def test_a_batch_is_its_scenes_one_by_one_with_one_trace(world):
    @jax.jit
    @chex.assert_max_traces(n=1)
    def batch(egos, trails, idx):
        def one(ego, trail, idx):
            return raster_roach.render(ego, trail, world, route_east(), idx, SMALL)

        return jax.vmap(one)(egos, trails, idx)

    for first in (4, 6):
        egos = [ego_at(-30.0 + s, -1.0, 0.1 * s) for s in (first, first + 1)]
        moments = [random_moments(s, -30.0, 0.0) for s in (first, first + 1)]
        stack = functools.partial(jax.tree.map, lambda *x: jnp.stack(x))
        images = batch(stack(*egos), stack(*map(trail_of, moments)), jnp.array([70, 70]))
        for image, ego, scene in zip(images, egos, moments, strict=True):
            alone = draw(world, ego, scene, idx=70, config=SMALL)
            assert (alone != np.asarray(image)).any(axis=-1).mean() < 0.002


def test_spans_of_a_box_along_and_across():
    config = RasterConfig(height=20, width=30, pixels_per_metre=1.0, ego_from_bottom_px=10)
    ego = ego_at(0.0, 0.0)

    def filled(turn, x=0.0):
        one = functools.partial(jnp.full, 1)
        xy = jnp.array([[x, 0.0]], jnp.float32)
        shown, plane = one(True), one(5)
        marks = raster_spans.marks(
            xy, one(turn), one(6.0), one(4.0), shown, plane, 8.0, ego, config
        )
        counts = raster_spans.fill([marks], 6, config)
        assert not raster_spans.covered(counts, 4).any()
        return np.argwhere(np.asarray(raster_spans.covered(counts, 5)).reshape(20, 30))

    assert filled(0.0).min(0).tolist() == [7, 13] and filled(0.0).max(0).tolist() == [12, 16]
    across = filled(np.pi / 2)
    assert across.min(0).tolist() == [8, 12] and across.max(0).tolist() == [11, 17]
    # Half of it beyond the upper edge, and beyond the lower one.
    assert len(filled(0.0, 10.0)) == len(filled(0.0, -10.0)) == 12
