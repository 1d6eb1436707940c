"""Time limit of an episode."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def is_timeout(step_count: jax.Array, limit: jax.Array | float, dt: float) -> jax.Array:
    """Whether the time limit has passed; half a step of slack absorbs rounding.

    Args:
      step_count: () int32, steps done.
      limit: s.
      dt: s.

    Returns:
      () bool.
    """
    return step_count.astype(jnp.float32) * dt > limit + 0.5 * dt
