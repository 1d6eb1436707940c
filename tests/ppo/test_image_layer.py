"""The first layer, piece by piece, against the same layer written with XLA's own convolution."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from carljax.ppo import image_layer, pieces
from carljax.ppo.conv import plain_conv

EPS, STRIDE = 1e-5, 2


def _params(key, out, with_norm, dtype):
    keys = jax.random.split(key, 4)
    kernel = 0.01 * jax.random.normal(keys[0], (5, 5, 3, 4))
    norm = None
    if with_norm:
        shape = (*out, 4)
        norm = 1.0 + 0.1 * jax.random.normal(keys[1], shape), jax.random.normal(keys[2], shape)
    bias = jax.random.normal(keys[3], (4,))
    return image_layer.Params(kernel.astype(dtype), bias.astype(dtype), norm)


def _plain(x, params):
    """The layer in one go, its LayerNorm by the definition."""
    z = plain_conv(x.astype(params.kernel.dtype), params.kernel, STRIDE) + params.bias
    if params.norm is not None:
        scale, bias = params.norm
        wide = z.astype(jnp.float32)
        mean = wide.mean(axis=(1, 2, 3), keepdims=True)
        var = jnp.square(wide - mean).mean(axis=(1, 2, 3), keepdims=True)
        z = ((wide - mean) / jnp.sqrt(var + EPS) * scale + bias).astype(z.dtype)
    return jnp.maximum(z, 0)


@pytest.mark.parametrize("with_norm", [True, False])
@pytest.mark.parametrize("size", [(20, 20), (19, 24)])  # an even and an odd number of outputs
@pytest.mark.parametrize("room", [1 << 20, 4000, 1])  # all at once, a few, one by one
def test_value_and_gradient_are_those_of_the_whole_batch(monkeypatch, with_norm, size, room):
    monkeypatch.setattr(pieces, "CACHE_BYTES", room)
    x = jax.random.randint(jax.random.key(0), (8, *size, 3), 0, 256).astype(jnp.uint8)
    out = [(n - 5) // STRIDE + 1 for n in size]
    params = _params(jax.random.key(1), out, with_norm, jnp.float32)
    towards = jax.random.normal(jax.random.key(2), (8, *out, 4))

    def ours(params):
        return jnp.sum(towards * image_layer.image_layer(x, params, STRIDE, EPS))

    def plain(params):
        return jnp.sum(towards * _plain(x, params))

    y = jax.jit(lambda p: image_layer.image_layer(x, p, STRIDE, EPS))(params)
    np.testing.assert_allclose(y, jax.jit(_plain)(x, params), rtol=1e-4, atol=1e-4)
    found, expected = jax.jit(jax.grad(ours))(params), jax.jit(jax.grad(plain))(params)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-4 * float(jnp.abs(b).max()))


def test_bfloat16_stays_bfloat16():
    x = jax.random.randint(jax.random.key(0), (4, 20, 20, 3), 0, 256).astype(jnp.uint8)
    params = _params(jax.random.key(1), (8, 8), True, jnp.bfloat16)
    y = image_layer.image_layer(x, params, STRIDE, EPS)
    assert y.dtype == jnp.bfloat16
    np.testing.assert_allclose(
        y.astype(np.float32), _plain(x, params).astype(np.float32), rtol=0.05, atol=0.05
    )


@pytest.mark.parametrize(
    ("num", "bytes_each", "size"),
    [(64, 1 << 19, 2), (64, (1 << 19) + 1, 1), (64, 1 << 30, 1), (64, 1, 64), (48, 1 << 14, 16)],
)
def test_as_many_samples_at_once_as_fit_and_divide(num, bytes_each, size):
    assert pieces.size_of(num, bytes_each) == size


def test_pieces_give_what_the_whole_gives():
    x, y = jnp.arange(12.0).reshape(6, 2), jnp.arange(6.0)

    def function(x, y):
        return {"row": x.sum(axis=1) * y, "twice": 2 * x}

    made = pieces.map_over(function, 2, x, y)
    jax.tree.map(np.testing.assert_array_equal, made, function(x, y))
    total = pieces.sum_over(lambda x, y: x.T @ y, 3, x, y)
    np.testing.assert_array_equal(total, x.T @ y)
