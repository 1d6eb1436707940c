"""Route deviation: too far from the route, or advanced along it for too long while far away."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def far_advance(
    far_before: jax.Array, advance: jax.Array, distance: jax.Array, far: jax.Array | float
) -> jax.Array:
    """Route length advanced while far from it, so far.

    Args:
      far_before: () m, up to the step before.
      advance: () m, progress along the route in this step.
      distance: () m, to the route.
      far: m beyond which it counts.

    Returns:
      () m.
    """
    return far_before + jnp.where(distance > far, advance, 0.0)


def has_deviated(
    distance: jax.Array,
    limit: jax.Array | float,
    far_advanced: jax.Array,
    far_limit: jax.Array | float,
) -> jax.Array:
    """Whether the ego has lost its route.

    Args:
      distance: () m, to the route.
      limit: m from which the ego has left it.
      far_advanced: () m, from `far_advance`.
      far_limit: m of route that may be advanced far from it.

    Returns:
      () bool.
    """
    return (distance >= limit) | (far_advanced > far_limit)
