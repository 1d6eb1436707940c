"""Action: moving the steering wheel costs a fixed price."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def penalty(
    before: jax.Array, after: jax.Array, threshold: jax.Array | float, price: jax.Array | float
) -> jax.Array:
    """-price where the steering changed by more than the threshold. source: Roach.

    Args:
      before: () steering in [-1, 1] a step ago.
      after: () steering now.
      threshold: change up to which nothing is paid.
      price: what is paid beyond.

    Returns:
      () 0 or -price.
    """
    return -jnp.asarray(price, jnp.float32) * (jnp.abs(after - before) > threshold)
