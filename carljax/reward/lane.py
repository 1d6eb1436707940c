"""Lane centre: the factor falls from 1 on the centre line to 0 on the lane marking."""

from __future__ import annotations

import jax
import jax.numpy as jnp


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
