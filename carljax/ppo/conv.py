"""Convolutions whose gradients are fast on XLA:CPU inside `lax.scan`, where the plain ones are not.

On a CPU the weight gradient of a convolution in a loop body keeps a layout that no fast kernel
takes (22 to 75 times slower), input gradients run on one thread, and a matrix product that
contracts over the rows of two tall matrices is three times slower than the same with one of them
transposed. The functions here write out the fast forms. GPUs and TPUs have no such trouble and get
the plain ones.

The platform is chosen at lowering (`lax.platform_dependent`), not by `jax.default_backend()` at
trace time: a program traced on a machine with a GPU may still be compiled for its CPU devices.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from carljax.ppo import bands

_NHWC = ("NHWC", "HWIO", "NHWC")
_FEW_CHANNELS = 8  # of the input: twice as fast by products; no faster with 16


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def conv(x: jax.Array, w: jax.Array, stride: int) -> jax.Array:
    """Convolves without padding.

    Args:
      x: (N, H, W, I) float32 or bfloat16.
      w: (K, K, I, O) of the same type.
      stride: step in both directions.

    Returns:
      (N, (H - K) // stride + 1, (W - K) // stride + 1, O) of that type.
    """
    return plain_conv(x, w, stride)


def plain_conv(x: jax.Array, w: jax.Array, stride: int) -> jax.Array:
    """Returns what `conv` does, by XLA's own convolution and with its gradients."""
    strides = (stride, stride)
    return jax.lax.conv_general_dilated(x, w, strides, "VALID", dimension_numbers=_NHWC)


def _conv_fwd(
    x: jax.Array, w: jax.Array, stride: int
) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    return plain_conv(x, w, stride), (x, w)


def _conv_bwd(
    stride: int, residuals: tuple[jax.Array, jax.Array], g: jax.Array
) -> tuple[jax.Array, jax.Array]:
    x, w = residuals

    def plain(x: jax.Array, w: jax.Array, g: jax.Array) -> tuple[jax.Array, jax.Array]:
        _, pull_back = jax.vjp(lambda x, w: plain_conv(x, w, stride), x, w)
        return pull_back(g)

    def fast(x: jax.Array, w: jax.Array, g: jax.Array) -> tuple[jax.Array, jax.Array]:
        dx = _dense_gradient(x, w, g) if stride == 1 else _strided_gradient(x, w, g, stride)
        return dx, _weight_gradient(x, w, g, stride)

    return jax.lax.platform_dependent(x, w, g, cpu=fast, default=plain)


conv.defvjp(_conv_fwd, _conv_bwd)


def _weight_gradient(x: jax.Array, w: jax.Array, g: jax.Array, stride: int) -> jax.Array:
    """Weight gradient as a convolution over the batch axis, in the one layout that Eigen takes.

    With few channels products of matrices are faster.
    """
    if w.shape[2] <= _FEW_CHANNELS:
        return bands.weight_gradient(x, w, g, stride)
    dw = jax.lax.conv_general_dilated(
        x.transpose(3, 1, 2, 0),  # (I, H, W, N): the batch is what is summed over
        g.transpose(1, 2, 0, 3),  # (H', W', N, O)
        (1, 1),
        "VALID",
        rhs_dilation=(stride, stride),
        dimension_numbers=_NHWC,
    )
    kernel = w.shape[0]  # rows of x that no output reaches make dw larger than the kernel
    return dw[:, :kernel, :kernel].transpose(1, 2, 0, 3)


def _dense_gradient(x: jax.Array, w: jax.Array, g: jax.Array) -> jax.Array:
    """Input gradient at stride 1: one matrix product, then each tap added where it came from.

    Eigen's convolution is up to a hundred times slower on the small, deep images that need this.
    """
    kernel, _, num_in, num_out = w.shape
    num, rows, cols, _ = g.shape
    taps = g.reshape(-1, num_out) @ w.reshape(-1, num_out).T
    taps = taps.reshape(num, rows, cols, kernel, kernel, num_in)
    dx = jnp.zeros(x.shape, x.dtype)
    for i in range(kernel):
        for j in range(kernel):
            below, right = x.shape[1] - rows - i, x.shape[2] - cols - j
            dx += jnp.pad(taps[:, :, :, i, j], ((0, 0), (i, below), (j, right), (0, 0)))
    return dx


def _strided_gradient(x: jax.Array, w: jax.Array, g: jax.Array, stride: int) -> jax.Array:
    """Input gradient as one stride-1 convolution, then depth to space.

    Pixel s p + a of x gets sum_q g[p - q] w[s q + a]: each of the s x s phases a is one group of
    output channels.
    """
    kernel, _, num_in, num_out = w.shape
    taps = -(-kernel // stride)
    pad = taps * stride - kernel
    phases = jnp.pad(w, ((0, pad), (0, pad), (0, 0), (0, 0)))
    phases = phases.reshape(taps, stride, taps, stride, num_in, num_out)[::-1, :, ::-1]
    phases = phases.transpose(0, 2, 5, 1, 3, 4)
    phases = phases.reshape(taps, taps, num_out, stride * stride * num_in)
    padding = ((taps - 1, taps - 1), (taps - 1, taps - 1))
    dx = jax.lax.conv_general_dilated(g, phases, (1, 1), padding, dimension_numbers=_NHWC)
    num, rows, cols, _ = dx.shape
    dx = dx.reshape(num, rows, cols, stride, stride, num_in).transpose(0, 1, 3, 2, 4, 5)
    dx = dx.reshape(num, rows * stride, cols * stride, num_in)[:, : x.shape[1], : x.shape[2]]
    # Pixels beyond the last window had no influence.
    missing = [(0, size - have) for size, have in zip(x.shape, dx.shape, strict=True)]
    return jnp.pad(dx, missing)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def patch_conv(x: jax.Array, w: jax.Array, size: int) -> jax.Array:
    """Convolves with a stride equal to the kernel: one matrix product over the patches.

    Args:
      x: (N, H, W, I) uint8 or `w`'s type; H and W are multiples of `size`.
      w: (size, size, I, O) float32 or bfloat16.
      size: side of a patch.

    Returns:
      (N, H / size, W / size, O) of `w`'s type.
    """
    return jax.lax.platform_dependent(
        x, w, cpu=_by_rows(size), default=lambda x, w: plain_conv(x.astype(w.dtype), w, size)
    )


def _patch_rows(x: jax.Array, size: int, dtype: jnp.dtype) -> list[jax.Array]:
    """Returns, for each row of a patch, (patches, size * I) of a type.

    A row of a patch is contiguous in the image. To work on one at a time costs no transpose, and
    the float32 copy of a small image's row fits the cache where that of the image doesn't.
    """
    num, height, width, channels = x.shape
    x = x.reshape(num, height // size, size, width // size, size * channels)
    return [x[:, :, i].reshape(-1, size * channels).astype(dtype) for i in range(size)]


def _by_rows(size: int) -> Callable[[jax.Array, jax.Array], jax.Array]:
    def product(x: jax.Array, w: jax.Array) -> jax.Array:
        num, height, width, _ = x.shape
        kernels = w.reshape(size, -1, w.shape[-1])
        rows = _patch_rows(x, size, w.dtype)
        out = sum(row @ kernel for row, kernel in zip(rows, kernels, strict=True))
        return jnp.reshape(out, (num, height // size, width // size, w.shape[-1]))

    return product


def _patch_conv_fwd(
    x: jax.Array, w: jax.Array, size: int
) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    return patch_conv(x, w, size), (x, w)


def _patch_conv_bwd(
    size: int, residuals: tuple[jax.Array, jax.Array], g: jax.Array
) -> tuple[Any, jax.Array]:
    x, w = residuals
    flat = g.reshape(-1, g.shape[-1])

    def plain(x: jax.Array, w: jax.Array, g: jax.Array) -> jax.Array:
        x = x.astype(w.dtype)
        return jax.vjp(lambda w: plain_conv(x, w, size), w)[1](g)[0]

    def fast(x: jax.Array, w: jax.Array, g: jax.Array) -> jax.Array:
        # Contracting over the rows of both is three times slower on a CPU than with one transposed;
        # the barriers keep XLA from folding the transposes back into the products.
        transposed = jax.lax.optimization_barrier(g.reshape(-1, g.shape[-1]).T)
        rows = _patch_rows(x, size, w.dtype)
        products = jax.lax.optimization_barrier([transposed @ row for row in rows])
        return jnp.stack([product.T for product in products]).reshape(w.shape)

    dw = jax.lax.platform_dependent(x, w, g, cpu=fast, default=plain)
    if not jnp.issubdtype(x.dtype, jnp.floating):
        return np.zeros(x.shape, jax.dtypes.float0), dw
    num, height, width, channels = x.shape
    rows = [flat @ kernel.T for kernel in w.reshape(size, -1, w.shape[-1])]
    rows = [row.reshape(num, height // size, width // size, size * channels) for row in rows]
    return jnp.stack(rows, axis=2).reshape(x.shape), dw


patch_conv.defvjp(_patch_conv_fwd, _patch_conv_bwd)


@jax.custom_vjp
def matmul(x: jax.Array, w: jax.Array) -> jax.Array:
    """Multiplies samples by weights.

    Args:
      x: (N, I) float32 or bfloat16.
      w: (I, O) of the same type.

    Returns:
      (N, O) of that type.
    """
    return x @ w


def _matmul_fwd(x: jax.Array, w: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    return x @ w, (x, w)


def _matmul_bwd(
    residuals: tuple[jax.Array, jax.Array], g: jax.Array
) -> tuple[jax.Array, jax.Array]:
    x, w = residuals

    def plain(w: jax.Array, g: jax.Array) -> jax.Array:
        return g @ w.T

    def fast(w: jax.Array, g: jax.Array) -> jax.Array:
        # A transposed copy of the weights, kept apart by the barrier, pays up to three times.
        return g @ jax.lax.optimization_barrier(w.T)

    return jax.lax.platform_dependent(w, g, cpu=fast, default=plain), x.T @ g


matmul.defvjp(_matmul_fwd, _matmul_bwd)
