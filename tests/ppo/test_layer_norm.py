"""Our LayerNorm of images against flax's: values, gradients, parameters."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from carljax.ppo.layer_norm import LayerNorm, layer_norm

EPS = 1e-5


@pytest.fixture(scope="module")
def case():
    rng = np.random.default_rng(0)
    x = 3.0 + 2.0 * rng.normal(size=(4, 5, 3, 7))
    scale, bias = 1.0 + 0.3 * rng.normal(size=(2, 5, 3, 7))
    return [jnp.asarray(value, jnp.float32) for value in (x, scale, bias, rng.normal(size=x.shape))]


def flax_norm(dtype="float32"):
    axes = (-3, -2, -1)
    return nn.LayerNorm(EPS, dtype, reduction_axes=axes, feature_axes=axes)


def test_values_and_gradients_are_flaxs(case):
    x, scale, bias, g = case

    def theirs(x, scale, bias):
        return flax_norm().apply({"params": {"scale": scale, "bias": bias}}, x)

    def both(norm):
        value, pull_back = jax.vjp(norm, x, scale, bias)
        return value, pull_back(g)

    ours = jax.jit(lambda: both(lambda *given: layer_norm(*given, EPS)))()
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-5), ours, both(theirs))


def test_the_gradient_is_that_of_float64(case):
    x, scale, bias, g = (np.asarray(value, np.float64) for value in case)

    def loss(x):
        mean = x.mean(axis=(1, 2, 3), keepdims=True)
        variance = x.var(axis=(1, 2, 3), keepdims=True)
        return (g * ((x - mean) / np.sqrt(variance + EPS) * scale + bias)).sum()

    dx = jax.grad(lambda x: (case[3] * layer_norm(x, case[1], case[2], EPS)).sum())(case[0])
    for place in ((0, 0, 0, 0), (1, 4, 2, 6), (3, 2, 1, 5)):
        step = np.zeros_like(x)
        step[place] = 1e-5
        slope = (loss(x + step) - loss(x - step)) / 2e-5
        np.testing.assert_allclose(dx[place], slope, atol=1e-5)


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_the_module_has_flaxs_parameters_and_type(case, dtype):
    x = case[0].astype(dtype)
    ours, theirs = LayerNorm(EPS, dtype), flax_norm(dtype)
    params = ours.init(jax.random.key(0), x)
    like = theirs.init(jax.random.key(0), x)
    assert jax.tree.structure(params) == jax.tree.structure(like)
    jax.tree.map(np.testing.assert_array_equal, params, like)
    got, want = ours.apply(params, x), theirs.apply(params, x)
    assert got.dtype == want.dtype == dtype
    tolerance = {"float32": 1e-5, "bfloat16": 2e-2}[dtype]
    np.testing.assert_allclose(got.astype("float32"), want.astype("float32"), atol=tolerance)


def test_bfloat16_is_kept_as_such_for_the_gradient(case):
    x = case[0].astype("bfloat16")
    pull_back = jax.vjp(lambda x: layer_norm(x, case[1], case[2], EPS), x)[1]
    kept = [leaf for leaf in jax.tree.leaves(pull_back) if leaf.shape == x.shape]
    assert [leaf.dtype for leaf in kept] == ["bfloat16"]
    dx = pull_back(case[3])[0]
    assert dx.dtype == "bfloat16"
    want = jax.vjp(lambda x: layer_norm(x, case[1], case[2], EPS), x.astype("float32"))[1]
    np.testing.assert_allclose(dx.astype("float32"), want(case[3])[0], atol=2e-2)
