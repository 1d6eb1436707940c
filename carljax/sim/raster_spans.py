"""Boxes filled row by row: one mark where a row enters a box, one where it leaves, then a sum.

For fine images, where the sample points of `raster_canvas.box_pixels` would be many: a car of 5 x
2 m at 5 px/m takes 50 marks instead of 500 points. A pixel belongs to a box that holds its centre.
Four planes share the bytes of one 32-bit word, so one sum along the rows fills them all.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from carljax.sim.raster_canvas import RasterConfig, pixel
from carljax.sim.raster_marks import SCATTER
from carljax.sim.types import EgoState

PLANES_PER_WORD = 4
MOST_BOXES = 255  # over one pixel of a plane; a byte counts them
_LEAST_SLOPE = 1e-6  # stands for a side that runs along the rows


def marks(
    xy: jax.Array,
    turn: jax.Array,
    length: jax.Array,
    width: jax.Array,
    shown: jax.Array,
    plane: jax.Array,
    longest: float,
    ego: EgoState,
    config: RasterConfig,
) -> tuple[jax.Array, jax.Array]:
    """Where rows of the image enter and leave boxes.

    Args:
      xy: (K, 2) m, centres.
      turn: (K,) rad, direction of their length relative to the ego's.
      length: (K,) m.
      width: (K,) m.
      shown: (K,) bool.
      plane: (K,) int32, the plane each belongs to.
      longest: m, diagonal up to which a box is whole; it fixes the number of rows.
      ego: pose of the image.
      config: its size.

    Returns:
      (2, K, R) int32 places and uint32 what to add there, for `fill`.
    """
    px = config.pixels_per_metre
    rows = jnp.arange(math.ceil(longest * px) + 1, dtype=jnp.float32)
    half_length, half_width = 0.5 * px * length[:, None], 0.5 * px * width[:, None]
    cos, sin = jnp.cos(turn)[:, None], jnp.sin(turn)[:, None]
    middle_row, middle_column = (x[:, None] for x in pixel(xy, ego, config))
    half_height = jnp.abs(cos) * half_length + jnp.abs(sin) * half_width
    row = jnp.ceil(middle_row - half_height - 0.5) + rows
    down = row + 0.5 - middle_row
    # A point so far down and x to the right lies -cos down - sin x along, sin down - cos x across.
    first, last = _between(cos * down, sin, half_length)
    first_across, last_across = _between(-sin * down, cos, half_width)
    first = jnp.maximum(first, first_across) + middle_column - 0.5
    last = jnp.minimum(last, last_across) + middle_column - 0.5
    enter = jnp.clip(jnp.ceil(first), 0.0, config.width)
    leave = jnp.clip(jnp.floor(last) + 1.0, 0.0, config.width)
    drawn = shown[:, None] & (leave > enter) & (row >= 0.0) & (row < config.height)
    begin = (plane // PLANES_PER_WORD)[:, None] * config.height + row.astype(jnp.int32)
    columns = jnp.stack([enter, leave]).astype(jnp.int32)
    at = begin * (config.width + 1) + columns
    one = jnp.uint32(1) << (8 * (plane % PLANES_PER_WORD)).astype(jnp.uint32)[:, None]
    add = jnp.stack([one, -one])
    far = jnp.iinfo(jnp.int32).max
    return jnp.where(drawn, at, far), jnp.broadcast_to(add, at.shape)


def fill(
    marked: list[tuple[jax.Array, jax.Array]], num_planes: int, config: RasterConfig
) -> jax.Array:
    """Fills planes: `covered` tells them apart.

    Args:
      marked: from `marks`.
      num_planes: of them all.
      config: the image's size.

    Returns:
      (words, H * W) uint32, in each byte how many boxes of a plane cover a pixel.
    """
    num_words = -(-num_planes // PLANES_PER_WORD)
    words = jnp.zeros(num_words * config.height * (config.width + 1), jnp.uint32)
    for at, add in marked:  # put together first, they take XLA's CPU code seven times as long
        words = words.at[at].add(add, **SCATTER)
    words = words.reshape(num_words, config.height, config.width + 1)
    return jnp.cumsum(words, axis=2, dtype=jnp.uint32)[:, :, :-1].reshape(num_words, -1)


def covered(counts: jax.Array, plane: int) -> jax.Array:
    """(H * W,) bool, whether a box of a plane covers a pixel; counts as from `fill`."""
    word, byte = divmod(plane, PLANES_PER_WORD)
    return (counts[word] >> (8 * byte)) & 255 > 0


def _between(offset: jax.Array, slope: jax.Array, half: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The x between which |offset + slope x| is at most `half`."""
    slope = jnp.where(slope < 0.0, -1.0, 1.0) * jnp.maximum(jnp.abs(slope), _LEAST_SLOPE)
    one, other = (-half - offset) / slope, (half - offset) / slope
    return jnp.minimum(one, other), jnp.maximum(one, other)
