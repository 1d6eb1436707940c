"""Outside lanes: on the sidewalk, or in a lane against the ego's direction.

The authors' code tracks the wrong lane through lane changes; what it means to find is said here
without memory: outside junctions, the nearest lane runs against the ego.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.sim import geometry


def is_off_lanes(
    lateral: jax.Array, width: jax.Array, on_parking: jax.Array, margin: jax.Array | float
) -> jax.Array:
    """Whether the ego's centre is on no lane.

    Args:
      lateral: () m, offset from the nearest driving lane's centre.
      width: () m, of that lane.
      on_parking: () bool, the centre is on a parking lane.
      margin: m past the lane's edge that is still on it.

    Returns:
      () bool.
    """
    return (jnp.abs(lateral) > 0.5 * width + margin) & ~on_parking


def is_wrong_way(
    yaw: jax.Array, lane_yaw: jax.Array, in_junction: jax.Array, angle: jax.Array | float
) -> jax.Array:
    """Whether the ego drives against its lane; lanes cross in junctions, so not there.

    Args:
      yaw: () rad, the ego's.
      lane_yaw: () rad, the lane's direction of travel.
      in_junction: () bool, of the lane.
      angle: rad between the two from which it is the wrong way.

    Returns:
      () bool.
    """
    return (jnp.abs(geometry.wrap_angle(lane_yaw - yaw)) >= angle) & ~in_junction


def factor(is_outside: jax.Array) -> jax.Array:
    """Soft factor: 0 outside lanes, else 1. source: paper, Soft Penalties.

    Args:
      is_outside: () bool.

    Returns:
      () 0 or 1.
    """
    return 1.0 - is_outside.astype(jnp.float32)
