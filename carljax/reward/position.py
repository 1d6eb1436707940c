"""Position: the farther the ego is from its route, the more it costs."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def penalty(lateral: jax.Array, span: jax.Array | float) -> jax.Array:
    """-|lateral| / span. source: Roach (2 m); the paper's reproduction of Think2Drive (8 m).

    Args:
      lateral: () m, offset from the route.
      span: m that cost 1.

    Returns:
      () at most 0.
    """
    return -jnp.abs(lateral) / span
