"""The first convolution, over an image of bytes: few channels in, few out.

It takes most of the time of the paper's networks on a CPU, where a convolution or its gradient
copies each pixel, as a float, once for each place in the kernel that it meets. So a CPU gets a
product of matrices (see `bands`): a row for each block of pixels, `stride` rows high, a column for
each output that sees it. The products of neighbouring blocks are then added up. Each pixel is
copied once, and at 256 px value and weight gradient take three quarters of the time that they take
with a kernel that slides over the image. GPUs and TPUs get the plain convolution.
"""

from __future__ import annotations

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np

from carljax.ppo import bands, pieces
from carljax.ppo.conv import plain_conv

_VECTOR = 8  # floats


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
        cpu=functools.partial(_by_blocks, stride=stride),
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


def _by_blocks(x: jax.Array, w: jax.Array, stride: int) -> jax.Array:
    kernel_size, num_out = w.shape[0], w.shape[-1]
    columns, seen = _num_outputs(x.shape[2], kernel_size, stride), _rows_seen(kernel_size, stride)
    kernel = _block_kernel(w, stride)

    def outputs(x: jax.Array) -> jax.Array:
        blocks = _blocks(x, kernel_size, stride)
        matrices = _matrices(blocks, w.dtype)
        parts = [
            jnp.matmul(matrix, rows, preferred_element_type=jnp.float32)
            for matrix, rows in zip(matrices, jnp.split(kernel, len(matrices)), strict=True)
        ]
        shape = (*blocks.shape[:2], blocks.shape[3], seen, 2, kernel.shape[1] // (2 * seen))
        out = _add_up([part.reshape(shape) for part in parts])
        return out.reshape(*out.shape[:2], -1, num_out)[:, :, :columns].astype(w.dtype)

    return pieces.map_over(outputs, _images_at_once(x, w, stride), x)


def _add_up(parts: list[jax.Array]) -> jax.Array:
    """(N, rows, columns, outputs * O) from what each block gives to those who see it.

    Args:
      parts: (N, rows of blocks, columns of blocks, R, 2, outputs * O), to be added up too.
    """
    _, height, width, seen = parts[0].shape[:4]
    rows, columns = height - seen + 1, width - 1
    shifts = itertools.product(parts, range(seen), range(2))
    seen_parts = [part[:, i : i + rows, j : j + columns, i, j] for part, i, j in shifts]
    return functools.reduce(jnp.add, seen_parts)


def _weight_gradient(x: jax.Array, w: jax.Array, g: jax.Array, stride: int) -> jax.Array:
    """The product of each block's pixels and the cotangents of the outputs that see it."""

    def product(x: jax.Array, g: jax.Array) -> jax.Array:
        blocks = _blocks(x, w.shape[0], stride)
        # Tall matrices are multiplied several times faster with the first one transposed.
        seeing = _seeing(g, blocks, w.shape[0], stride)
        return jnp.concatenate([seeing @ m for m in _matrices(blocks, w.dtype)], axis=1)

    products = pieces.sum_over(product, _images_at_once(x, w, stride), x, g)
    block_kernel = functools.partial(_block_kernel, stride=stride)
    return jax.linear_transpose(block_kernel, w)(products.T)[0]


def _seeing(g: jax.Array, blocks: jax.Array, kernel: int, stride: int) -> jax.Array:
    """(outputs that see a block * O, blocks) cotangents.

    As one long row of blocks: an output so many blocks further is so many numbers further.
    """
    num, rows, columns, num_out = g.shape
    side, seen = bands.outputs_at_once(kernel, stride), _rows_seen(kernel, stride)
    width = blocks.shape[3]
    g = jnp.pad(g, ((0, 0), (0, seen - 1), (0, width * side - columns), (0, 0)))
    g = g.reshape(-1, side * num_out)
    ahead = [i * width + j for i, j in itertools.product(range(seen), range(2))]
    row = jax.lax.optimization_barrier(jnp.pad(g.T, ((0, 0), (ahead[-1], 0))))
    shifted = [row[:, ahead[-1] - n :][:, : g.shape[0]] for n in ahead]
    return jax.lax.optimization_barrier(jnp.concatenate(shifted))


def _blocks(x: jax.Array, kernel: int, stride: int) -> jax.Array:
    """(N, rows, stride, columns, pixels * I): the image in blocks, `stride` rows high."""
    rows = _num_outputs(x.shape[1], kernel, stride) + _rows_seen(kernel, stride) - 1
    x = jnp.pad(x, ((0, 0), (0, max(rows * stride - x.shape[1], 0)), (0, 0), (0, 0)))
    x = bands.blocks(x[:, : rows * stride], kernel, stride)
    return x.reshape(x.shape[0], rows, stride, *x.shape[2:])


def _matrices(blocks: jax.Array, dtype: jnp.dtype) -> list[jax.Array]:
    """(blocks, pixels of a block * I): one of them, or one for each row of a block.

    Rows that are no whole vectors take six times as long to copy side by side.
    """
    num, rows, stride, columns, width = blocks.shape
    if width % _VECTOR == 0:
        parts = [blocks.transpose(0, 1, 3, 2, 4)]
    else:
        parts = [blocks[:, :, i] for i in range(stride)]
    parts = [x.astype(dtype).reshape(num * rows * columns, -1) for x in parts]
    # The barrier keeps XLA from folding the conversion into the product, which would be slower.
    return [jax.lax.optimization_barrier(x) for x in parts]


def _block_kernel(w: jax.Array, stride: int) -> jax.Array:
    """(pixels of a block * I, outputs that see it * O): the weights by which they do, or zero."""
    seen = _rows_seen(w.shape[0], stride)
    w = bands.banded(w, stride)
    w = jnp.pad(w, ((0, seen * stride - w.shape[0]), (0, 0), (0, 0), (0, 0)))
    w = w.reshape(seen, stride, *w.shape[1:]).transpose(1, 3, 0, 2, 4)
    return w.reshape(w.shape[0] * w.shape[1], -1)


def _images_at_once(x: jax.Array, w: jax.Array, stride: int) -> int:
    """So many that their products fit the cache.

    A loop over them ends what the compiler fuses: else it would add the products up anew wherever
    the outputs are looked at, and make a cotangent anew for each of its copies.
    """
    kernel = jax.eval_shape(functools.partial(_block_kernel, stride=stride), w)
    pixels = x[0, :, :, 0].size * w.shape[2]
    return pieces.size_of(x.shape[0], 4 * kernel.shape[1] * pixels // kernel.shape[0])


def _rows_seen(kernel: int, stride: int) -> int:
    """Of blocks, by an output."""
    return -(-kernel // stride)


def _num_outputs(size: int, kernel: int, stride: int) -> int:
    return (size - kernel) // stride + 1
