"""How fast to go on an empty road: the limit, bends, and braking early enough before both."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.planners.way import SAMPLES, Way

BEND_ACCEL = 3.0  # m/s^2 sideways in bends. source: ours, a third of CARLA's comfort limit
BEND_BRAKING = 2.0  # m/s^2 towards a bend or a lower limit. source: ours
SLOWEST = 1.5  # m/s. source: ours, so that no kink of a lane stops the car


def wanted(way: Way, limit_frac: float) -> jax.Array:
    """(K,) m/s, a fraction of the limit, less in bends, along the way."""
    bend = jnp.sqrt(BEND_ACCEL / jnp.maximum(jnp.abs(way.curvature), 1e-4))
    return jnp.maximum(jnp.minimum(limit_frac * way.speed_limit, bend), SLOWEST)


def slowed_before(speed: jax.Array, braking: float = BEND_BRAKING) -> jax.Array:
    """(K,) m/s, from which each later speed can be reached by braking gently.

    v_k = min over j >= k of sqrt(v_j^2 + 2 b (j - k)), 1 m apart.

    Args:
      speed: (K,) m/s.
      braking: m/s^2.
    """
    energy = 2.0 * braking * jnp.arange(SAMPLES, dtype=jnp.float32)
    least = jax.lax.cummin(speed**2 + energy, reverse=True)
    return jnp.sqrt(least - energy)


def at(speed: jax.Array, distance: jax.Array) -> jax.Array:
    """Speeds (K,) along the way, read at distances of any shape, m."""
    along = jnp.clip(distance, 0.0, SAMPLES - 1.0)
    base = jnp.minimum(along.astype(jnp.int32), SAMPLES - 2)
    return speed[base] + (along - base) * (speed[base + 1] - speed[base])
