"""The first convolution, over an image of bytes: few channels in, few out.

It takes most of the time of the paper's networks on a CPU, since a product of matrices with eight
columns is slow. So a CPU gets one with more of them: the image is read in blocks of columns, and
from two neighbouring blocks some neighbouring outputs are made at once, by a kernel that holds the
weights once for each. At 5 x 5, stride 2, three eighths are zeros, multiplied in vain, and still
value and weight gradient together take half to three fifths of the time (10 channels, 64 to 128
px, two cores), the value alone 0.8 to 0.93 of it. GPUs and TPUs get the plain convolution.
"""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np

from carljax.ppo import pieces
from carljax.ppo.conv import plain_conv


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def image_conv(x: jax.Array, w: jax.Array, stride: int) -> jax.Array:
    """Convolves without padding; there is no gradient for the image.

    Args:
      x: (N, H, W, I) uint8.
      w: (K, K, I, O) float32 or bfloat16.
      stride: step in both directions.

    Returns:
      (N, (H - K) // stride + 1, (W - K) // stride + 1, O) of `w`'s type.
    """
    return jax.lax.platform_dependent(
        x,
        w,
        cpu=functools.partial(_wide, stride=stride),
        default=functools.partial(_plain, stride=stride),
    )


def _image_conv_fwd(
    x: jax.Array, w: jax.Array, stride: int
) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    return image_conv(x, w, stride), (x, w)


def _image_conv_bwd(
    stride: int, residuals: tuple[jax.Array, jax.Array], g: jax.Array
) -> tuple[np.ndarray, jax.Array]:
    x, w = residuals

    def plain(x: jax.Array, w: jax.Array, g: jax.Array) -> jax.Array:
        return jax.vjp(lambda w: _plain(x, w, stride), w)[1](g)[0]

    fast = functools.partial(_weight_gradient, stride=stride)
    dw = jax.lax.platform_dependent(x, w, g, cpu=fast, default=plain)
    return np.zeros(x.shape, jax.dtypes.float0), dw


image_conv.defvjp(_image_conv_fwd, _image_conv_bwd)


def _plain(x: jax.Array, w: jax.Array, stride: int) -> jax.Array:
    return plain_conv(x.astype(w.dtype), w, stride)


def _wide(x: jax.Array, w: jax.Array, stride: int) -> jax.Array:
    """A convolution whose pixels are blocks of columns and whose channels are outputs side by side.

    The blocks and the outputs are reshapes, so nothing is copied but the image to floats.
    """
    columns = _num_outputs(x.shape[2], w.shape[0], stride)
    out = jax.lax.conv_general_dilated(
        _blocks(x, w.shape[0], stride).astype(w.dtype),
        _banded(w, stride),
        (stride, 1),
        "VALID",
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )
    return out.reshape(*out.shape[:2], -1, w.shape[-1])[:, :, :columns]


def _weight_gradient(x: jax.Array, w: jax.Array, g: jax.Array, stride: int) -> jax.Array:
    """One product of matrices for each row of the kernel: the cotangent by the image's blocks.

    A block is the first of its own outputs' two and the second of the ones before: so each meets
    the cotangents of both. What makes the cotangent is done before the loop over pieces begins;
    without one the compiler would do it anew wherever the cotangent is looked at.
    """
    kernel = w.shape[0]
    width = _outputs_at_once(kernel, stride) * stride * w.shape[2]

    def products(x: jax.Array, g: jax.Array) -> jax.Array:
        both = _own_and_before(g, kernel, stride)
        blocks = _blocks(x, kernel, stride)
        last = stride * (g.shape[1] - 1) + 1
        rows = [blocks[:, i : i + last : stride] for i in range(kernel)]
        rows = [row.reshape(-1, width).astype(w.dtype) for row in rows]
        # The barriers keep XLA from folding the conversions back into the products.
        return jnp.stack([both @ jax.lax.optimization_barrier(row) for row in rows])

    num_blocks = -(-g.shape[2] // _outputs_at_once(kernel, stride)) + 1
    row_bytes = g.shape[1] * num_blocks * width * w.dtype.itemsize
    size = pieces.size_of(x.shape[0], row_bytes)
    banded = pieces.sum_over(products, size, x, g)
    banded = banded.reshape(kernel, 2, -1, width).transpose(0, 1, 3, 2)
    return jax.linear_transpose(functools.partial(_banded, stride=stride), w)(banded)[0]


def _own_and_before(g: jax.Array, kernel: int, stride: int) -> jax.Array:
    """(2 * outputs * O, blocks): each block's cotangents of its own outputs and of those before."""
    num, rows, columns, num_out = g.shape
    side = _outputs_at_once(kernel, stride)
    g = jnp.pad(g, ((0, 0), (0, 0), (0, -columns % side), (0, 0)))
    g = g.reshape(num, rows, -1, side * num_out)
    own, before = (jnp.pad(g, ((0, 0), (0, 0), room, (0, 0))) for room in ((0, 1), (1, 0)))
    both = jnp.concatenate([own, before], axis=-1)
    return jax.lax.optimization_barrier(both.reshape(-1, both.shape[-1]).T)


def _outputs_at_once(kernel: int, stride: int) -> int:
    """Outputs side by side that see no more than two blocks of so many strides; two at least."""
    return max(2, math.ceil(kernel / stride) - 1)


def _num_outputs(size: int, kernel: int, stride: int) -> int:
    return (size - kernel) // stride + 1


def _blocks(x: jax.Array, kernel: int, stride: int) -> jax.Array:
    """(N, H, B, block * I): the image's columns in blocks, one more than blocks of outputs."""
    num, height, width, channels = x.shape
    side = _outputs_at_once(kernel, stride)
    count = -(-_num_outputs(width, kernel, stride) // side) + 1
    needed = count * side * stride
    x = jnp.pad(x, ((0, 0), (0, 0), (0, max(needed - width, 0)), (0, 0)))[:, :, :needed]
    return x.reshape(num, height, count, side * stride * channels)


def _banded(w: jax.Array, stride: int) -> jax.Array:
    """(K, 2, block * I, outputs * O): the weights once for each output, where it sees them."""
    kernel, _, num_in, num_out = w.shape
    side = _outputs_at_once(kernel, stride)
    columns = 2 * side * stride
    shifted = [
        jnp.pad(w, ((0, 0), (p * stride, columns - kernel - p * stride), (0, 0), (0, 0)))
        for p in range(side)
    ]
    banded = jnp.stack(shifted, axis=3)
    return banded.reshape(kernel, 2, side * stride * num_in, side * num_out)
