"""Timers that keep a soft penalty up for a number of steps after its violation."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def tick(left: jax.Array, violated: jax.Array, duration: jax.Array | int) -> jax.Array:
    """Counts down, then starts anew on a violation; the penalty holds while the result is above 0.

    So one violation holds for exactly `duration` steps, the present one included.

    Args:
      left: int32, steps left after the step before.
      violated: bool of the same shape.
      duration: steps.

    Returns:
      int32 of the same shape.
    """
    return jnp.where(violated, duration, jnp.maximum(left - 1, 0))


LATCHED = 500  # steps shown as left of what holds for good; the critic's inputs are scaled by it


def latch(left: jax.Array, violated: jax.Array) -> jax.Array:
    """Keeps a penalty up until the end of the episode. source: paper, Soft Penalties (nuPlan).

    Args:
      left: int32, from the step before.
      violated: bool of the same shape.

    Returns:
      int32 of the same shape, `LATCHED` from the first violation on, else 0.
    """
    return jnp.where(violated, jnp.int32(LATCHED), left)
