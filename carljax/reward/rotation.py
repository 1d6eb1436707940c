"""Rotation: the more the ego is turned away from its route, the more it costs."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.sim import geometry


def penalty(yaw: jax.Array, route_yaw: jax.Array) -> jax.Array:
    """-|difference|, in radians. source: Roach.

    Args:
      yaw: () rad, the ego's.
      route_yaw: () rad, the route's.

    Returns:
      () in [-pi, 0].
    """
    return -jnp.abs(geometry.wrap_angle(yaw - route_yaw))
