"""Blocked: the ego has stood for too long."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def standing_time(
    before: jax.Array, speed: jax.Array, stand_speed: jax.Array | float, dt: float
) -> jax.Array:
    """Time the ego has stood without a break.

    Args:
      before: () s, up to the step before.
      speed: () m/s.
      stand_speed: m/s below which it stands.
      dt: s.

    Returns:
      () s.
    """
    return jnp.where(speed < stand_speed, before + dt, 0.0)


def is_blocked(standing: jax.Array, limit: jax.Array | float, dt: float) -> jax.Array:
    """Whether that is more than allowed; half a step of slack absorbs the sum's rounding.

    Args:
      standing: () s, from `standing_time`.
      limit: s.
      dt: s.

    Returns:
      () bool.
    """
    return standing > limit + 0.5 * dt
