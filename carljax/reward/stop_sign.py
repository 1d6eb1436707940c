"""Running a stop sign: crossing its line without having halted in the strip before it."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.sim import geometry
from carljax.sim.bicycle import VehicleParams
from carljax.sim.types import STOP_BOX_LENGTH, STOP_SIGN, EgoState, Situation


def halted(
    ego: EgoState,
    vehicle: VehicleParams,
    situation: Situation,
    halt_speed: jax.Array | float,
) -> jax.Array:
    """Stop signs at which the ego stands now: its box overlaps the strip before the line.

    Args:
      ego: the ego.
      vehicle: its box.
      situation: the stop lines.
      halt_speed: m/s below which it stands.

    Returns:
      (Q,) bool.
    """
    centre = jnp.array([-0.5 * STOP_BOX_LENGTH, 0.0], jnp.float32)
    overlap = geometry.boxes_overlap(
        ego.xy,
        ego.yaw,
        vehicle.length,
        vehicle.width,
        geometry.from_frame(centre, situation.stop_xy, situation.stop_yaw),
        situation.stop_yaw,
        STOP_BOX_LENGTH,
        situation.stop_width,
    )
    return overlap & (situation.stop_kind == STOP_SIGN) & (ego.speed < halt_speed)


def ran_stop_sign(
    newly_crossed: jax.Array, stop_kind: jax.Array, satisfied: jax.Array
) -> jax.Array:
    """Whether a stop sign's line was crossed without a halt.

    Args:
      newly_crossed: (Q,) bool, lines crossed in this step.
      stop_kind: (Q,) int32 STOP_*.
      satisfied: (Q,) bool, the ego has halted there.

    Returns:
      () bool.
    """
    return jnp.any(newly_crossed & (stop_kind == STOP_SIGN) & ~satisfied)
