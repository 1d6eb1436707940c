"""Convolutions with few channels as products of larger matrices, for CPUs.

A product of matrices with eight columns is slow. So the image is read in blocks of columns, and
from two neighbouring blocks some neighbouring outputs are made at once, by a kernel that holds the
weights once for each output. At 5 x 5, stride 2, three eighths of it are zeros, multiplied in vain.
"""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp

from carljax.ppo import pieces


def outputs_at_once(kernel: int, stride: int) -> int:
    """Returns how many outputs side by side see no more than two blocks of so many strides.

    Args:
      kernel: its side.
      stride: of the convolution.

    Returns:
      Two at least.
    """
    return max(2, math.ceil(kernel / stride) - 1)


def blocks(x: jax.Array, kernel: int, stride: int) -> jax.Array:
    """Reads images in blocks of columns.

    Args:
      x: (N, H, W, I).
      kernel: its side.
      stride: of the convolution.

    Returns:
      (N, H, B, block * I): one block more than blocks of outputs; zeros where it has no pixels.
    """
    num, height, width, channels = x.shape
    side = outputs_at_once(kernel, stride)
    count = -(-((width - kernel) // stride + 1) // side) + 1
    needed = count * side * stride
    x = jnp.pad(x, ((0, 0), (0, 0), (0, max(needed - width, 0)), (0, 0)))[:, :, :needed]
    return x.reshape(num, height, count, side * stride * channels)


def banded(w: jax.Array, stride: int) -> jax.Array:
    """Holds the weights once for each output, where it sees them.

    Args:
      w: (K, K, I, O).
      stride: of the convolution.

    Returns:
      (K, 2, block * I, outputs * O): of each row, for the outputs' own block and the next.
    """
    kernel, _, num_in, num_out = w.shape
    side = outputs_at_once(kernel, stride)
    columns = 2 * side * stride
    shifted = [
        jnp.pad(w, ((0, 0), (p * stride, columns - kernel - p * stride), (0, 0), (0, 0)))
        for p in range(side)
    ]
    stacked = jnp.stack(shifted, axis=3)
    return stacked.reshape(kernel, 2, side * stride * num_in, side * num_out)


def weight_gradient(x: jax.Array, w: jax.Array, g: jax.Array, stride: int) -> jax.Array:
    """Multiplies, for each row of the kernel, the cotangent by the image's blocks.

    A block is the first of its own outputs' two and the second of the ones before: so each meets
    the cotangents of both. A few images at a time, which also has what makes the cotangent done
    before; else the compiler would do it anew wherever the cotangent is looked at.

    Args:
      x: (N, H, W, I) float32 or bfloat16.
      w: (K, K, I, O) of the same type.
      g: (N, H', W', O) cotangent of the convolution without padding.
      stride: of the convolution.

    Returns:
      Gradient for `w`.
    """
    kernel = w.shape[0]
    width = outputs_at_once(kernel, stride) * stride * w.shape[2]

    def products(x: jax.Array, g: jax.Array) -> jax.Array:
        both = _own_and_before(g, kernel, stride)
        columns = blocks(x, kernel, stride)
        last = stride * (g.shape[1] - 1) + 1
        rows = [columns[:, i : i + last : stride].reshape(-1, width) for i in range(kernel)]
        return jnp.stack([both @ row for row in rows])

    num_blocks = -(-g.shape[2] // outputs_at_once(kernel, stride)) + 1
    size = pieces.size_of(x.shape[0], g.shape[1] * num_blocks * width * w.dtype.itemsize)
    product = pieces.sum_over(products, size, x, g)
    product = product.reshape(kernel, 2, -1, width).transpose(0, 1, 3, 2)
    return jax.linear_transpose(functools.partial(banded, stride=stride), w)(product)[0]


def _own_and_before(g: jax.Array, kernel: int, stride: int) -> jax.Array:
    """(2 * outputs * O, blocks): each block's cotangents of its own outputs and of those before."""
    num, rows, columns, num_out = g.shape
    side = outputs_at_once(kernel, stride)
    g = jnp.pad(g, ((0, 0), (0, 0), (0, -columns % side), (0, 0)))
    g = g.reshape(num, rows, -1, side * num_out)
    own, before = (jnp.pad(g, ((0, 0), (0, 0), room, (0, 0))) for room in ((0, 1), (1, 0)))
    both = jnp.concatenate([own, before], axis=-1)
    # The barrier keeps XLA from folding the transpose into the product, which would be slower.
    return jax.lax.optimization_barrier(both.reshape(-1, both.shape[-1]).T)
