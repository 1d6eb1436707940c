"""Where things lie on the bird's-eye view: its size, and the pixels of points and boxes.

`CHANNELS` are those of CaRL in CARLA; the other kinds of observation have their own.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from carljax.sim.geometry import to_frame
from carljax.sim.once import once
from carljax.sim.raster_marks import spread
from carljax.sim.types import EgoState

# source: the authors' code, CARLA bird's-eye view
CHANNELS = (
    "road",
    "route",
    "markings",
    "vehicles",
    "pedestrians",
    "lights",
    "stop_sign",
    "speed_signs",
    "static",
    "shoulder",
)
NUM_CHANNELS = len(CHANNELS)
# The values other than 0 of those channels that have few; the others take any.
LEVELS = {
    **dict.fromkeys(("road", "route", "stop_sign", "static", "shoulder"), (255,)),
    "markings": (127, 255),
}
ROUTE_AHEAD = 150  # route points. source: the authors' code

# No index here is negative, and saying so makes the gather over the atlas a fifth faster.
GATHER: dict[str, Any] = {"mode": "promise_in_bounds", "wrap_negative_indices": False}
NOWHERE = -1e6  # a row of what is not shown: outside any image, whatever is added


@dataclasses.dataclass(frozen=True)
class RasterConfig:
    """Size and content of the image.

    Attributes:
      height: px.
      width: px.
      pixels_per_metre: resolution.
      ego_from_bottom_px: rows behind the ego's centre, which lies where four pixels meet.
      route_everywhere: draw the whole route ahead; otherwise only its parts in junctions (paper).
        The observations `roach` and `nuplan` draw the whole route in any case.
    """

    height: int = 256
    width: int = 256
    pixels_per_metre: float = 2.0
    ego_from_bottom_px: int = 100
    route_everywhere: bool = False

    @property
    def shape(self) -> tuple[int, int, int]:
        """Rows, columns, channels."""
        return self.height, self.width, NUM_CHANNELS

    @property
    def num_route_points(self) -> int:
        """Route points looked at: 150 (paper), or all that a route reaches in a smaller image."""
        return min(ROUTE_AHEAD, self.reach_points)

    @property
    def reach_points(self) -> int:
        """Points, a metre apart, of a route that leaves the image.

        A route may wind, so half as much again as the distance to the farthest corner is taken.
        """
        ahead = max(self.height - self.ego_from_bottom_px, self.ego_from_bottom_px)
        reach = math.hypot(ahead, self.width / 2) / self.pixels_per_metre
        return math.ceil(1.5 * reach)

    def validate(self) -> None:
        """Checks that there is an image and that the ego is in it.

        Raises:
          ValueError: in one line, the field and what is wrong with it.
        """
        for name in ("height", "width"):
            if getattr(self, name) < 1:
                raise ValueError(
                    f"env.raster.{name}: {getattr(self, name)} is below the least allowed, 1"
                )
        if not 0.0 < self.pixels_per_metre < math.inf:
            raise ValueError(
                f"env.raster.pixels_per_metre: {self.pixels_per_metre} is not a number above 0"
            )
        if not 0 <= self.ego_from_bottom_px <= self.height:
            raise ValueError(
                f"env.raster.ego_from_bottom_px: {self.ego_from_bottom_px} puts the ego outside "
                f"an image of {self.height} rows"
            )


def pixel(xy: jax.Array, ego: EgoState, config: RasterConfig) -> tuple[jax.Array, jax.Array]:
    """Row and column, not rounded, of world points (..., 2) m; whole numbers are pixel borders."""
    ahead_left = to_frame(xy, ego.xy, ego.yaw) * config.pixels_per_metre
    row = config.height - config.ego_from_bottom_px - ahead_left[..., 0]
    return row, config.width / 2 - ahead_left[..., 1]


def flat_index(row: jax.Array, column: jax.Array, config: RasterConfig) -> jax.Array:
    """Flat pixel index, int32, of places (...) px; one past the image for what is outside."""
    row, column = jnp.floor(row).astype(jnp.int32), jnp.floor(column).astype(jnp.int32)
    # Unsigned, a negative number is larger than any size.
    inside = (row.astype(jnp.uint32) < config.height) & (column.astype(jnp.uint32) < config.width)
    return jnp.where(inside, row * config.width + column, config.height * config.width)


class Poses(NamedTuple):
    """Where things are on the image, (K,) each.

    Attributes:
      row, column: px, as from `pixel`.
      cos, sin: of their direction relative to the ego's.
    """

    row: jax.Array
    column: jax.Array
    cos: jax.Array
    sin: jax.Array


def poses(xy: jax.Array, yaw: jax.Array, ego: EgoState, config: RasterConfig) -> Poses:
    """Poses on the image.

    Args:
      xy: (K, 2) m.
      yaw: (K,) rad.
      ego: pose of the image.
      config: size and content.
    """
    turn = yaw - ego.yaw
    return once(Poses(*pixel(xy, ego, config), jnp.cos(turn), jnp.sin(turn)))


def moved(at: Poses, ahead: jax.Array | float, left: jax.Array | float) -> Poses:
    """Poses so many px ahead of and to the left of others, in the same direction."""
    row = at.row - at.cos * ahead + at.sin * left
    return at._replace(row=row, column=at.column - at.sin * ahead - at.cos * left)


def box_pixels(
    middle: Poses,
    length: jax.Array,
    width: jax.Array,
    shown: jax.Array,
    limits: tuple[float, float],
    config: RasterConfig,
) -> jax.Array:
    """Pixels of boxes, by sample points in each.

    The outermost samples lie half a pixel inside the border, so that a box along the axes covers
    just the pixels whose centres it holds.

    Args:
      middle: (K,).
      length: (K,) m.
      width: (K,) m.
      shown: (K,) bool.
      limits: m, length and width up to which no gap shows; they fix the number of samples.
      config: size and content.

    Returns:
      (K, S) int32 flat pixel indices.
    """
    px = config.pixels_per_metre
    along, across = _samples(*(max(limit * px - 1.0, 0.0) for limit in limits))
    half_length = jnp.maximum(0.5 * length * px - 0.5, 0.0)
    half_width = jnp.maximum(0.5 * width * px - 0.5, 0.0)
    row, column, cos, sin = middle
    row = jnp.where(shown, row, NOWHERE)
    grid = (1.0, along, across)
    return flat_index(
        spread((row, -cos * half_length, sin * half_width), grid),
        spread((column, -sin * half_length, -cos * half_width), grid),
        config,
    )


def _samples(length: float, width: float) -> np.ndarray:
    """(2, S) along and across, in -1 ... 1: as few points as leave no pixel within a box out.

    A pixel, whatever its rotation, holds a circle of diameter 1 px: so no place may be farther than
    half a pixel from all points. Fewest of them do that in rows, each second one shifted by half a
    step and with points at both ends: with rows h apart and steps w, the three points around a
    place are at most half a pixel from it where (w / 2)^2 + h^2 <= h.

    Args:
      length: px between the outermost points.
      width: px, likewise.
    """
    rows = [_rows(length, width, num) for num in range(2 * math.ceil(width) + 2)]
    rows += [_rows(width, length, num)[::-1] for num in range(2 * math.ceil(length) + 2)]
    return min((points for points in rows if points.size), key=lambda points: points.shape[1])


def _rows(length: float, width: float, num: int) -> np.ndarray:
    """(2, S) points on rows along the length, so many spaces apart; none where those are wide."""
    apart = width / max(num, 1)
    if apart >= 1.0 or (num == 0) != (width == 0.0):
        return np.zeros((2, 0))
    step = 2.0 * math.sqrt(apart - apart**2) if num else 1.0
    steps = math.ceil(length / step)
    ends = np.linspace(-1.0, 1.0, steps + 1) if steps else np.zeros(1)
    shifted = np.union1d(0.5 * (ends[1:] + ends[:-1]), ends[[0, -1]])
    along = [shifted if row % 2 else ends for row in range(num + 1)]
    across = np.linspace(-1.0, 1.0, num + 1) if num else np.zeros(1)
    return np.stack([np.concatenate(along), np.repeat(across, [len(points) for points in along])])


def ray_pixels(begin: Poses, length: jax.Array, longest: float, config: RasterConfig) -> jax.Array:
    """Pixels of rays, a sample point each pixel of their length.

    Args:
      begin: (K,), where they come from and their direction.
      length: (K,) m; below 0 for none.
      longest: m; longer rays end there.
      config: size and content.

    Returns:
      (K, S) int32 flat pixel indices.
    """
    px = config.pixels_per_metre
    grid = (1.0, np.arange(math.ceil(longest * px) + 1))
    left = spread((length * px, jnp.full_like(length, -1.0)), grid)
    row = jnp.where(left >= 0.0, spread((begin.row, -begin.cos), grid), NOWHERE)
    return flat_index(row, spread((begin.column, -begin.sin), grid), config)
