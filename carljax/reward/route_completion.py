"""Route completion: the percentage of the route that a step has added."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def increment(before: jax.Array, after: jax.Array, length: jax.Array) -> jax.Array:
    """Percentage points gained; never negative.

    Args:
      before: () m along the route, furthest progress paid so far.
      after: () m, progress now.
      length: () m, of the route.

    Returns:
      () percentage points.
    """
    return 100.0 * jnp.maximum(after - before, 0.0) / length


def rounded_increment(before: jax.Array, after: jax.Array, length: jax.Array) -> jax.Array:
    """As `increment`, between completions rounded to 0.01 %. source: the authors' code.

    Args:
      before: () m along the route, furthest progress paid so far.
      after: () m, progress now.
      length: () m, of the route.

    Returns:
      () percentage points, a multiple of 0.01.
    """
    hundredths_before = jnp.round(1e4 * before / length)
    hundredths_after = jnp.round(1e4 * jnp.maximum(after, before) / length)
    return (hundredths_after - hundredths_before) / 100.0


def is_finished(route_idx: jax.Array, num_points: jax.Array) -> jax.Array:
    """Whether fewer than two points are left. source: the authors' code.

    Args:
      route_idx: () int32, last passed point.
      num_points: () int32, of the route.

    Returns:
      () bool.
    """
    return num_points - 1 - route_idx < 2


def is_near_goal(
    route_s: jax.Array, route_length: jax.Array, distance: jax.Array | float
) -> jax.Array:
    """Whether no more than a distance is left. source: the paper's reproduction of Think2Drive.

    Args:
      route_s: () m along the route.
      route_length: () m.
      distance: m.

    Returns:
      () bool.
    """
    return route_length - route_s <= distance
