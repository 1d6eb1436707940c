"""Marks against loops in NumPy, alone and in batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from carljax.sim import raster_marks

PIXELS, MARKS, SAMPLES = 50, 7, 5


def scene(*batch: int, seed: int = 0):
    """Canvas, indices (a fifth of them outside) and values."""
    rng = np.random.default_rng(seed)
    canvas = rng.integers(0, 100, (*batch, PIXELS)).astype(np.uint8)
    index = rng.integers(0, PIXELS * 5 // 4, (*batch, MARKS, SAMPLES)).astype(np.int32)
    value = rng.integers(0, 256, (*batch, MARKS)).astype(np.uint8)
    return canvas, index, value


def by_hand(canvas, index, value):
    out = canvas.copy()
    for mark, samples in enumerate(index):
        for pixel in samples:
            if pixel < PIXELS:
                out[pixel] = max(out[pixel], value[mark])
    return out


def test_spread_sums_products():
    rng = np.random.default_rng(1)
    parts, grid = rng.normal(size=(3, 6)), rng.normal(size=(3, 9))
    got = raster_marks.spread(list(jnp.asarray(parts)), list(grid))
    np.testing.assert_allclose(got, np.einsum("ck,cs->ks", parts, grid), rtol=2e-6, atol=1e-6)
    whole = jnp.array([0, 1, 255, 65_537, (1 << 24) - 1])
    got = raster_marks.spread((whole, jnp.zeros(5)), (1.0, np.arange(4)))
    np.testing.assert_array_equal(got, np.repeat(np.asarray(whole)[:, None], 4, axis=1))


def test_the_largest_value_stays():
    given = scene()
    np.testing.assert_array_equal(raster_marks.draw(*given), by_hand(*given))


def test_batches_are_their_canvases_one_by_one():
    canvas, index, value = scene(3, 4)
    expected = [
        [by_hand(*one) for one in zip(*row, strict=True)]
        for row in zip(canvas, index, value, strict=True)
    ]
    got = jax.jit(jax.vmap(jax.vmap(raster_marks.draw)))(canvas, index, value)
    np.testing.assert_array_equal(got, expected)


@pytest.mark.parametrize("shared", range(3))
def test_what_is_not_of_a_batch_is_shared(shared):
    given = [
        x if place == shared else y
        for place, (x, y) in enumerate(zip(scene(), scene(4), strict=True))
    ]
    axes = [None if place == shared else 0 for place in range(3)]
    got = jax.vmap(raster_marks.draw, in_axes=axes)(*given)
    for number in range(4):
        one = [x if place == shared else x[number] for place, x in enumerate(given)]
        np.testing.assert_array_equal(got[number], by_hand(*one))


def test_more_pixels_than_an_index_counts_are_drawn_batch_by_batch():
    def loops(num):
        given = [
            jax.ShapeDtypeStruct(shape, dtype)
            for shape, dtype in [
                ((num, 1 << 20), jnp.uint8),
                ((num, 2, 3), jnp.int32),
                ((num, 2), jnp.uint8),
            ]
        ]
        return "scan" in str(jax.make_jaxpr(jax.vmap(raster_marks.draw))(*given))

    assert not loops(2047)
    assert loops(2048)


def test_channels_of_an_image():
    _, index, value = scene(2, seed=3)
    channel = np.random.default_rng(4).integers(0, 3, (2, MARKS)).astype(np.int32)
    image = np.random.default_rng(5).integers(0, 100, (2, PIXELS, 3)).astype(np.uint8)
    got = jax.vmap(raster_marks.draw_channel)(image, index, channel, value)
    expected = image.copy()
    for b, mark, sample in np.ndindex(index.shape):
        if (at := index[b, mark, sample]) < PIXELS:
            pixel = expected[b, at]
            pixel[channel[b, mark]] = max(pixel[channel[b, mark]], value[b, mark])
    np.testing.assert_array_equal(got, expected)
    alone = jax.tree.map(jnp.asarray, (image[0], index[0], value[0]))
    one = raster_marks.draw_channel(alone[0], alone[1], 1, alone[2])
    same = raster_marks.draw_channel(*alone[:2], jnp.ones(MARKS, jnp.int32), alone[2])
    np.testing.assert_array_equal(one, same)
    np.testing.assert_array_equal(one[:, 0], image[0, :, 0])
