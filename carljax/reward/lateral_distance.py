"""Lateral distance: farther from the route than allowed, and farther than a step before.

Who is too far may come back: the limit follows the distance inwards. A jump, as where the route's
nearest point changes at a turn, does not count. source: Roach's terminal condition.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

SLACK = 0.01  # m beyond the limit. source: Roach
JUMP_ROOM = 0.5  # m by which the limit lies beyond a jump. source: Roach


def limit(
    before: jax.Array, now: jax.Array, least: jax.Array | float, jump: jax.Array | float
) -> jax.Array:
    """The limit that holds in this step.

    Args:
      before: () m from the route a step ago.
      now: () m from the route.
      least: m that are always allowed.
      jump: change in m beyond which it is a jump.

    Returns:
      () m.
    """
    jumped = jnp.abs(now - before) > jump
    return jnp.where(jumped, now + JUMP_ROOM, jnp.maximum(before, least))


def is_beyond(now: jax.Array, limit: jax.Array) -> jax.Array:
    """Whether the ego is farther than the limit.

    Args:
      now: () m from the route.
      limit: () m, from `limit`.

    Returns:
      () bool.
    """
    return now - limit > SLACK
