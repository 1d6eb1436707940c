"""Collision: the ego's box shares area with another box at its height."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.sim import geometry
from carljax.sim.bicycle import VehicleParams
from carljax.sim.types import Agents, EgoState


def is_near_in_height(ego: EgoState, agents: Agents, z_gap: jax.Array | float) -> jax.Array:
    """(N,) bool, agents in use on the ego's level, not on an overpass.

    Args:
      ego: the ego.
      agents: the others.
      z_gap: m.

    Returns:
      (N,) bool.
    """
    return agents.valid & (jnp.abs(agents.z - ego.z) < z_gap)


def touched(
    ego: EgoState, agents: Agents, vehicle: VehicleParams, z_gap: jax.Array | float
) -> jax.Array:
    """Whom the ego touches.

    Args:
      ego: the ego.
      agents: the others, of any kind.
      vehicle: the ego's box.
      z_gap: m, height difference that keeps boxes apart.

    Returns:
      (N,) bool.
    """
    overlap = geometry.boxes_overlap(
        ego.xy,
        ego.yaw,
        vehicle.length,
        vehicle.width,
        agents.xy,
        agents.yaw,
        agents.length,
        agents.width,
    )
    return overlap & is_near_in_height(ego, agents, z_gap)


def collided(
    ego: EgoState, agents: Agents, vehicle: VehicleParams, z_gap: jax.Array | float
) -> jax.Array:
    """Whether the ego touches anybody or anything.

    Args:
      ego: the ego.
      agents: the others, of any kind.
      vehicle: the ego's box.
      z_gap: m, height difference that keeps boxes apart.

    Returns:
      () bool.
    """
    return jnp.any(touched(ego, agents, vehicle, z_gap))


def collided_in_motion(
    ego: EgoState,
    agents: Agents,
    vehicle: VehicleParams,
    z_gap: jax.Array | float,
    min_speed: jax.Array | float,
) -> jax.Array:
    """As `collided`, but nobody is to blame who stands. source: paper, nuPlan Specific Adaptations.

    Args:
      ego: the ego.
      agents: the others, of any kind.
      vehicle: the ego's box.
      z_gap: m, height difference that keeps boxes apart.
      min_speed: m/s below which the ego stands.

    Returns:
      () bool.
    """
    return collided(ego, agents, vehicle, z_gap) & (ego.speed >= min_speed)
