"""Traffic lights as a function of time.

The controllers of a junction are served in turn: each is green, then yellow, then all wait for a
moment of red before the next one. Times are CARLA's defaults for its traffic lights: green 10 s,
yellow 3 s, red 2 s. source: CARLA documentation, traffic light defaults.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.sim.types import LIGHT_GREEN, LIGHT_RED, LIGHT_YELLOW

GREEN_S = 10.0
YELLOW_S = 3.0
ALL_RED_S = 2.0
SLOT_S = GREEN_S + YELLOW_S + ALL_RED_S


def state(time: jax.Array, start: jax.Array, cycle: jax.Array) -> jax.Array:
    """The colour of a light.

    Args:
      time: s, the town's light clock.
      start: s, when within the cycle the light turns green.
      cycle: s, period of its junction's programme.

    Returns:
      int32 LIGHT_*, of the broadcast shape of the arguments.
    """
    since = jnp.mod(time - start, cycle)
    colour = jnp.where(since < GREEN_S + YELLOW_S, LIGHT_YELLOW, LIGHT_RED)
    return jnp.where(since < GREEN_S, LIGHT_GREEN, colour).astype(jnp.int32)


def yellow_left(time: jax.Array, start: jax.Array, cycle: jax.Array) -> jax.Array:
    """Seconds of yellow that remain, YELLOW_S before it begins, 0 after.

    Args:
      time: as for `state`.
      start: as for `state`.
      cycle: as for `state`.

    Returns:
      float32 in [0, YELLOW_S].
    """
    since = jnp.mod(time - start, cycle)
    return jnp.clip(GREEN_S + YELLOW_S - since, 0.0, YELLOW_S)
