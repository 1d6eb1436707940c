"""Pedestrian overlap: the ego's box meets a pedestrian's, drawn larger than it is.

Roach tests the masks of its image, where pedestrians are drawn twice as large; boxes say the same
without an image.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.reward.collision import is_near_in_height
from carljax.sim import geometry
from carljax.sim.bicycle import VehicleParams
from carljax.sim.types import KIND_PEDESTRIAN, Agents, EgoState

HALF_EXTENT_MIN = 0.8  # m, of the box as drawn. source: Roach's image


def overlaps(
    ego: EgoState,
    agents: Agents,
    vehicle: VehicleParams,
    scale: jax.Array | float,
    z_gap: jax.Array | float,
) -> jax.Array:
    """Whether the ego meets an enlarged pedestrian.

    Args:
      ego: the ego.
      agents: (N,) the others.
      vehicle: the ego's box.
      scale: how much larger pedestrians are made.
      z_gap: m, height difference that keeps apart.

    Returns:
      () bool.
    """
    meets = geometry.boxes_overlap(
        ego.xy,
        ego.yaw,
        vehicle.length,
        vehicle.width,
        agents.xy,
        agents.yaw,
        jnp.maximum(agents.length * scale, 2.0 * HALF_EXTENT_MIN),
        jnp.maximum(agents.width * scale, 2.0 * HALF_EXTENT_MIN),
    )
    is_pedestrian = agents.kind == KIND_PEDESTRIAN
    return jnp.any(meets & is_pedestrian & is_near_in_height(ego, agents, z_gap))
