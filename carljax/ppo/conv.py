"""Convolutions whose gradients are fast on XLA:CPU inside `lax.scan`, where the plain ones are not.

On a CPU the weight gradient of a convolution in a loop body keeps a layout that no fast kernel takes
(22 to 75 times slower), the input gradient of a strided one runs on one thread, and a tall matrix
product that contracts over its rows is three times slower than the same with transposed operands. The
functions here write out the fast forms. GPUs and TPUs have no such trouble and get the plain ones.

The platform is chosen at lowering (`lax.platform_dependent`), not by `jax.default_backend()` at trace
time: a program traced on a machine with a GPU may still be compiled for its CPU devices.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

_NHWC = ("NHWC", "HWIO", "NHWC")


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def conv(x: jax.Array, w: jax.Array, stride: int) -> jax.Array:
    """Convolves without padding.

    Args:
      x: (N, H, W, I) float32.
      w: (K, K, I, O) float32.
      stride: step in both directions.

    Returns:
      (N, (H - K) // stride + 1, (W - K) // stride + 1, O) float32.
    """
    return _plain(x, w, stride)


def _plain(x: jax.Array, w: jax.Array, stride: int) -> jax.Array:
    strides = (stride, stride)
    return jax.lax.conv_general_dilated(x, w, strides, "VALID", dimension_numbers=_NHWC)


def _conv_fwd(
    x: jax.Array, w: jax.Array, stride: int
) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    return _plain(x, w, stride), (x, w)


def _conv_bwd(
    stride: int, residuals: tuple[jax.Array, jax.Array], g: jax.Array
) -> tuple[jax.Array, jax.Array]:
    x, w = residuals

    def plain(x: jax.Array, w: jax.Array, g: jax.Array) -> tuple[jax.Array, jax.Array]:
        _, pull_back = jax.vjp(lambda x, w: _plain(x, w, stride), x, w)
        return pull_back(g)

    def fast(x: jax.Array, w: jax.Array, g: jax.Array) -> tuple[jax.Array, jax.Array]:
        return _input_gradient(x, w, g, stride), _weight_gradient(x, w, g, stride)

    return jax.lax.platform_dependent(x, w, g, cpu=fast, default=plain)


conv.defvjp(_conv_fwd, _conv_bwd)


def _weight_gradient(x: jax.Array, w: jax.Array, g: jax.Array, stride: int) -> jax.Array:
    """Weight gradient as a convolution over the batch axis, in the one layout that Eigen takes."""
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


def _input_gradient(x: jax.Array, w: jax.Array, g: jax.Array, stride: int) -> jax.Array:
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


def patches(x: jax.Array, size: int) -> jax.Array:
    """Cuts images into square patches.

    Args:
      x: (N, H, W, C); H and W are multiples of `size`.
      size: side of a patch.

    Returns:
      (N, H / size, W / size, size * size * C), each patch row by row.
    """
    num, height, width, channels = x.shape
    rows = x.reshape(num, height // size, size, width // size, size * channels)
    # Slices joined together: on a CPU three times faster than the transpose they amount to.
    return jnp.concatenate([rows[:, :, i] for i in range(size)], axis=-1)


@jax.custom_vjp
def tall_matmul(x: jax.Array, w: jax.Array) -> jax.Array:
    """Multiplies matrices; made for many more rows than columns.

    Args:
      x: (R, I) float32.
      w: (I, O) float32.

    Returns:
      (R, O) float32.
    """
    return x @ w


def _tall_matmul_fwd(
    x: jax.Array, w: jax.Array
) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    return x @ w, (x, w)


def _tall_matmul_bwd(
    residuals: tuple[jax.Array, jax.Array], g: jax.Array
) -> tuple[jax.Array, jax.Array]:
    x, w = residuals

    def plain(x: jax.Array, g: jax.Array) -> jax.Array:
        return x.T @ g

    def fast(x: jax.Array, g: jax.Array) -> jax.Array:
        # The barrier keeps XLA from folding the transpose back into the product.
        return (jax.lax.optimization_barrier(g.T) @ x).T

    return g @ w.T, jax.lax.platform_dependent(x, g, cpu=fast, default=plain)


tall_matmul.defvjp(_tall_matmul_fwd, _tall_matmul_bwd)
