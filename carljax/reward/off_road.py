"""Off road: nearly all of the ego's footprint is off the drivable area."""

from __future__ import annotations

import jax


def is_off_road(off_road_frac: jax.Array, limit: jax.Array | float) -> jax.Array:
    """Whether the ego has left the road.

    Args:
      off_road_frac: () fraction of the footprint on neither road, parking lane nor shoulder.
      limit: () fraction above which it is off.

    Returns:
      () bool.
    """
    return off_road_frac > limit


def has_corner_off(corner_off_road: jax.Array) -> jax.Array:
    """Whether the ego has left the road with one corner. source: the authors' code for nuPlan.

    Args:
      corner_off_road: (4,) bool, corners on neither road, parking lane nor shoulder.

    Returns:
      () bool.
    """
    return corner_off_road.any()
