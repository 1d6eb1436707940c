"""Speeding: the factor falls from 1 at the limit to 0 at 8 km/h above it."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def factor(speed: jax.Array, limit: jax.Array, span: jax.Array | float) -> jax.Array:
    """Soft factor 1 - (speed - limit) / span, cut to [0, 1]. source: paper, Soft Penalties.

    Args:
      speed: () m/s.
      limit: () m/s.
      span: m/s, excess at which it is 0.

    Returns:
      () in [0, 1].
    """
    return 1.0 - jnp.clip((speed - limit) / span, 0.0, 1.0)
