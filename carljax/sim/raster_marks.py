"""Marks on the bird's-eye view: sample points of many things at once, scattered onto a canvas.

Both steps are written for XLA:CPU. Element by element, it finds the row of each sample by a
division, which takes longer than what is computed there; here rows are spread by matrix products.
And it knows no batch of scatters but gives each index its canvas's number as a second coordinate;
`draw` makes a batch of canvases one long canvas. That is for canvases that begin blank: where one
has been computed, the same divisions would go into what computed it, so `draw_channel` leaves a
batch of images as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

SCATTER: dict[str, Any] = {"mode": "drop", "wrap_negative_indices": False}


def spread(parts: Sequence[jax.Array], grid: Sequence[np.ndarray | float]) -> jax.Array:
    """Sums over i of `parts[i]` x `grid[i]`, for each row of the parts and column of the grid.

    Args:
      parts: (K,) each.
      grid: (S,) each, or a number for all columns; one at least is an array.

    Returns:
      (K, S) float32; whole numbers up to 2^24 stay exact.
    """
    columns = np.stack(np.broadcast_arrays(*grid)).astype(np.float32)
    rows = jnp.stack([part.astype(jnp.float32) for part in parts], axis=-1)
    return jnp.dot(rows, columns, precision=jax.lax.Precision.HIGHEST)


@jax.custom_batching.custom_vmap
def draw(canvas: jax.Array, index: jax.Array, value: jax.Array) -> jax.Array:
    """Draws marks; where several meet, or one is there already, the largest value stays.

    Args:
      canvas: (P,) uint8 pixels, blank or from here.
      index: (K, S) int32, the pixels of each mark; P or more for none.
      value: (K,) uint8, of each mark.

    Returns:
      The canvas.
    """
    return canvas.at[index].max(_each(value, index).astype(jnp.uint8), **SCATTER)


@draw.def_vmap
def _draw_batch(num: int, batched: Sequence[bool], *args: jax.Array) -> tuple[jax.Array, bool]:
    canvas, index, value = (
        x if is_batched else jnp.broadcast_to(x, (num, *x.shape))
        for x, is_batched in zip(args, batched, strict=True)
    )
    size = canvas.shape[1]
    if num * size > jnp.iinfo(jnp.int32).max:
        return jax.lax.map(lambda one: draw(*one), (canvas, index, value)), True
    number = jnp.repeat(jnp.arange(num), index.shape[1])
    index = index.reshape(-1, index.shape[2])
    begin = _each(number, index).astype(jnp.int32) * size
    index = jnp.where(index < size, index + begin, num * size)
    return draw(canvas.reshape(-1), index, value.reshape(-1)).reshape(canvas.shape), True


def draw_channel(
    image: jax.Array, index: jax.Array, channel: jax.Array | int, value: jax.Array
) -> jax.Array:
    """Draws marks as `draw` does, each on one channel of an image.

    Args:
      image: (P, C) uint8.
      index: (K, S) int32 pixels; P or more for none.
      channel: (K,) int32, or one for all.
      value: (K,), of each mark, to become uint8.

    Returns:
      The image.
    """
    channel = jnp.asarray(channel)[..., None]
    return image.at[index, channel].max(value.astype(jnp.uint8)[:, None], **SCATTER)


def _each(value: jax.Array, index: jax.Array) -> jax.Array:
    """(K, S) float32: the values (K,) of marks for each of their samples."""
    # Two parts, since XLA makes a product of one column into what `spread` is there to avoid.
    return spread((value, jnp.zeros_like(value)), (1.0, np.arange(index.shape[1])))
