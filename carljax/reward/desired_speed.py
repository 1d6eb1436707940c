"""Desired speed: what a rule would drive at, and how near the ego is to it.

Source: Roach's reward, and the paper's reproduction of Think2Drive's, which is made like it.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp


def approaching(
    distance: jax.Array,
    margin: jax.Array | float,
    span: jax.Array | float,
    free_speed: jax.Array | float,
) -> jax.Array:
    """Speed at a distance from a hazard: free beyond margin + span, 0 within the margin.

    Args:
      distance: () m, infinity where there is no hazard.
      margin: m.
      span: m over which the speed falls linearly.
      free_speed: m/s.

    Returns:
      () m/s.
    """
    return free_speed * jnp.clip(distance - margin, 0.0, span) / span


def match(speed: jax.Array, desired: jax.Array, span: jax.Array | float) -> jax.Array:
    """1 - |speed - desired| / span; below 0 for who is off by more than the span.

    Args:
      speed: () m/s.
      desired: () m/s.
      span: m/s.

    Returns:
      () at most 1.
    """
    return 1.0 - jnp.abs(speed - desired) / span
