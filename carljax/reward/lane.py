"""Lane centre: the factor falls from 1 on the centre line to 0 on the lane marking."""

from __future__ import annotations

import jax
import jax.numpy as jnp

NARROW = 1e-3  # m, so that nothing is divided by 0 on a lane as narrow as the room


def factor(lateral: jax.Array, width: jax.Array, in_junction: jax.Array) -> jax.Array:
    """Soft factor 1 - |lateral| / (width / 2), not below 0; 1 in junctions.

    source: paper, Soft Penalties.

    Args:
      lateral: () m, offset from the nearest driving lane's centre.
      width: () m, of that lane.
      in_junction: () bool.

    Returns:
      () in [0, 1].
    """
    share = jnp.clip(jnp.abs(lateral) / (0.5 * width), 0.0, 1.0)
    return jnp.where(in_junction, 1.0, 1.0 - share)


def factor_with_room(
    lateral: jax.Array,
    width: jax.Array,
    in_junction: jax.Array,
    room: jax.Array | float,
    weight: jax.Array | float,
) -> jax.Array:
    """Soft factor that is 1 within some room about the centre; nuPlan's.

    It falls from 1 at `room` to 1 - weight on the lane marking; 1 in junctions. source: paper,
    nuPlan Specific Adaptations.

    Args:
      lateral: () m, offset from the nearest driving lane's centre.
      width: () m, of that lane.
      in_junction: () bool.
      room: m to either side that cost nothing.
      weight: what is lost on the marking.

    Returns:
      () in [0, 1].
    """
    span = jnp.maximum(0.5 * width - room, NARROW)
    share = jnp.clip((jnp.abs(lateral) - room) / span, 0.0, 1.0)
    return jnp.where(in_junction, 1.0, 1.0 - weight * share)
