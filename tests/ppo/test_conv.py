"""Our convolutions against the plain ones: values, gradients, compiled form."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from carljax.ppo import pieces
from carljax.ppo.conv import conv, matmul, patch_conv
from carljax.ppo.image_conv import image_conv


def _plain(x, w, stride):
    x = x.astype(jnp.float32)
    return jax.lax.conv_general_dilated(
        x, w, (stride, stride), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


def _data(shape_x, shape_w):
    rng = np.random.default_rng(0)
    return rng.normal(size=shape_x).astype(np.float32), rng.normal(size=shape_w).astype(np.float32)


@pytest.mark.parametrize(
    ("height", "width", "kernel", "stride"),
    [(13, 13, 5, 2), (12, 9, 5, 2), (8, 8, 3, 2), (6, 4, 3, 1), (11, 11, 3, 3), (10, 11, 2, 3)],
    ids=["odd", "rows left over", "k3 s2", "stride 1", "stride = kernel", "stride > kernel"],
)
@pytest.mark.parametrize("channels", [4, 9], ids=["few channels", "more"])
def test_conv_equals_the_plain_one_inside_a_scan(height, width, kernel, stride, channels):
    x, w = _data((2, 3, height, width, channels), (kernel, kernel, channels, 5))

    def total(function, x, w):
        def step(carry, x):
            out = function(x, w, stride)
            return carry + jnp.sum(jnp.sin(out)), out

        return jax.lax.scan(step, jnp.float32(0.0), x)

    ours, plain = (
        jax.jit(jax.value_and_grad(lambda x, w, f=f: total(f, x, w), argnums=(0, 1), has_aux=True))
        for f in (conv, _plain)
    )
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-4), ours(x, w), plain(x, w))


@pytest.mark.parametrize(
    ("height", "width", "kernel", "stride"),
    [(13, 13, 5, 2), (11, 16, 5, 2), (12, 10, 3, 2), (9, 9, 5, 1), (8, 20, 8, 4), (7, 9, 2, 3)],
    ids=["odd", "columns left over", "k3 s2", "stride 1", "k8 s4", "stride > kernel"],
)
@pytest.mark.parametrize("channels", [4, 3], ids=["whole vectors", "others"])
@pytest.mark.parametrize("room", [1 << 20, 1], ids=["all images at once", "one by one"])
def test_image_conv_equals_the_plain_one_inside_a_scan(
    monkeypatch, height, width, kernel, stride, channels, room
):
    monkeypatch.setattr(pieces, "CACHE_BYTES", room)
    x, w = _data((2, 3, height, width, channels), (kernel, kernel, channels, 5))
    x = (10 * np.abs(x)).astype(np.uint8)

    def total(function, w):
        def step(carry, x):
            out = function(x, w, stride)
            return carry + jnp.sum(jnp.sin(0.1 * out)), out

        return jax.lax.scan(step, jnp.float32(0.0), x)

    ours, plain = (
        jax.jit(jax.value_and_grad(lambda w, f=f: total(f, w), has_aux=True))
        for f in (image_conv, _plain)
    )
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-4), ours(w), plain(w))


def test_image_conv_of_several_networks_side_by_side():
    """As seeds of an experiment train, by vmap."""
    x, w = _data((2, 3, 9, 9, 4), (2, 3, 3, 4, 5))
    x = (10 * np.abs(x)).astype(np.uint8)
    grad = jax.grad(lambda w, x: jnp.sum(jnp.sin(0.1 * image_conv(x, w, 2))))
    together = jax.jit(jax.vmap(grad))(w, x)
    for one, (w_one, x_one) in zip(together, zip(w, x, strict=True), strict=True):
        np.testing.assert_allclose(one, grad(w_one, x_one), atol=1e-4)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_patch_conv_equals_the_plain_one(dtype):
    x, w = _data((3, 8, 12, 5), (4, 4, 5, 6))
    x = (10 * np.abs(x)).astype(dtype)

    def grad(function):
        def total(x, w):
            out = function(x, w, 4)
            return jnp.sum(jnp.sin(0.1 * out)), out

        argnums = (1,) if dtype == np.uint8 else (0, 1)
        return jax.jit(jax.value_and_grad(total, argnums=argnums, has_aux=True))(x, w)

    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=1e-4), grad(patch_conv), grad(_plain)
    )


def test_matmul_equals_the_plain_one():
    x, w = _data((6, 5), (5, 7))
    total = lambda f: lambda x, w: jnp.sum(jnp.sin(f(x, w)))  # noqa: E731
    ours, plain = (
        jax.jit(jax.value_and_grad(total(f), argnums=(0, 1)))(x, w) for f in (matmul, jnp.matmul)
    )
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), ours, plain)


@pytest.mark.parametrize("function", [conv, image_conv, patch_conv])
def test_other_platforms_get_the_plain_convolution(function):
    """Lowered for a GPU, neither the barriers nor the loops over rows of the CPU's form remain."""
    x, w = _data((2, 8, 8, 3), (2, 2, 3, 4))
    x = np.abs(x).astype(np.uint8) if function is image_conv else x

    def grad(x, w):
        return jax.grad(lambda w: jnp.sum(function(x, w, 2) ** 2))(w)

    def lowered(platform):
        return jax.jit(grad).trace(x, w).lower(lowering_platforms=(platform,)).as_text()

    # Value and weight gradient, one convolution each.
    assert lowered("cuda").count("stablehlo.convolution") == 2
    assert "optimization_barrier" not in lowered("cuda")
    assert lowered("cpu") != lowered("cuda")
