"""Running a red light: the rear of the ego crosses the line while its light is red."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.sim.types import LIGHT_RED, LIGHT_YELLOW, STOP_LIGHT


def ran_red_light(
    newly_crossed: jax.Array, stop_kind: jax.Array, stop_light: jax.Array
) -> jax.Array:
    """Whether a line was crossed at red.

    A car that stands on the line when the light turns red runs it as well once it drives on.
    source: the authors' code; the paper says entered the intersection at red.

    Args:
      newly_crossed: (Q,) bool, lines that the rear has crossed in this step.
      stop_kind: (Q,) int32 STOP_*.
      stop_light: (Q,) int32 LIGHT_* now.

    Returns:
      () bool.
    """
    return jnp.any(newly_crossed & (stop_kind == STOP_LIGHT) & (stop_light == LIGHT_RED))


def ran_yellow_or_red_light(
    newly_crossed: jax.Array, stop_kind: jax.Array, stop_light: jax.Array
) -> jax.Array:
    """As `ran_red_light`, with yellow forbidden too.

    Args:
      newly_crossed: (Q,) bool, lines that the rear has crossed in this step.
      stop_kind: (Q,) int32 STOP_*.
      stop_light: (Q,) int32 LIGHT_* now.

    Returns:
      () bool.
    """
    yellow = newly_crossed & (stop_kind == STOP_LIGHT) & (stop_light == LIGHT_YELLOW)
    return jnp.any(yellow) | ran_red_light(newly_crossed, stop_kind, stop_light)
