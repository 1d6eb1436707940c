"""Terminal penalty that grows with speed: 1 for any end, and the speed on top for a violation."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def penalty(is_end: jax.Array, is_violation: jax.Array, speed: jax.Array) -> jax.Array:
    """What the end of an episode costs. source: Roach.

    Args:
      is_end: () bool, an end that costs.
      is_violation: () bool, one that costs the speed too.
      speed: () m/s.

    Returns:
      () 0, 1 or 1 + speed.
    """
    return is_end.astype(jnp.float32) + jnp.where(is_violation, speed, 0.0)
