"""Survival: every step of an episode pays the same, together the share s of a perfect reward."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def num_steps(time_limit: jax.Array | float, dt: float) -> jax.Array:
    """Steps of the longest episode: 150 in nuPlan's clips of 15 s at 10 Hz.

    Args:
      time_limit: s.
      dt: s.

    Returns:
      () float32, at least 1.
    """
    return jnp.maximum(jnp.asarray(time_limit, jnp.float32) / dt, 1.0)


def bonus(
    ratio: jax.Array | float, num_steps: jax.Array, is_paid: jax.Array, total: float = 100.0
) -> jax.Array:
    """The bonus of one step, s * 100 / N. source: paper, Survival Bonus.

    Args:
      ratio: s, in [0, 1].
      num_steps: () N, from `num_steps`.
      is_paid: () bool.
      total: what N steps would pay at s = 1, percentage points.

    Returns:
      () percentage points.
    """
    return is_paid * jnp.asarray(ratio, jnp.float32) * total / num_steps
