"""The Intelligent Driver Model: acceleration from gap and closing speed.

Source: Treiber, Hennecke, Helbing, Congested traffic states in empirical observations and
microscopic simulations (2000), eqs. 3 and 4.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

GAP_FLOOR = 0.1  # m; nearer than this a driver brakes as hard as it can anyway
SPEED_FLOOR = 0.1  # m/s; keeps speed / desired_speed finite


class IDMParams(struct.PyTreeNode):
    """A driver.

    Source of the values: Treiber and Kesting, Traffic Flow Dynamics (2013), table 11.2.

    Attributes:
      min_gap: m, bumper to bumper at rest.
      headway: s, time gap kept at speed.
      accel_max: m/s^2.
      comfort_brake: m/s^2, deceleration a driver aims at.
      brake_max: m/s^2, hardest braking; the bare model has no bound. source: dry road, about 0.8 g
      exponent: of the free-road term; static.
    """

    min_gap: float = 2.0
    headway: float = 1.0
    accel_max: float = 1.0
    comfort_brake: float = 1.5
    brake_max: float = 8.0
    exponent: int = struct.field(pytree_node=False, default=4)


def desired_gap(speed: jax.Array, leader_speed: jax.Array, params: IDMParams) -> jax.Array:
    """Gap a driver wants: s0 + max(0, v T + v (v - v_l) / (2 sqrt(a b))).

    Args:
      speed: m/s.
      leader_speed: m/s, along the follower's direction.
      params: the driver.

    Returns:
      m.
    """
    braking = speed * (speed - leader_speed)
    braking = braking / (2.0 * jnp.sqrt(params.accel_max * params.comfort_brake))
    return params.min_gap + jnp.maximum(speed * params.headway + braking, 0.0)


def acceleration(
    speed: jax.Array,
    gap: jax.Array,
    leader_speed: jax.Array,
    desired_speed: jax.Array,
    params: IDMParams,
) -> jax.Array:
    """IDM acceleration a (1 - (v / v0)^exponent - (s* / s)^2), not below -brake_max; elementwise.

    Finite for any gap and any speed: a gap of zero or less (overlap) brakes as hard as allowed.

    Args:
      speed: m/s, not negative.
      gap: m to the leader's rear bumper; infinity where there is none.
      leader_speed: m/s; any finite value where there is no leader.
      desired_speed: m/s on a free road.
      params: the driver.

    Returns:
      m/s^2 in [-brake_max, accel_max].
    """
    free = (speed / jnp.maximum(desired_speed, SPEED_FLOOR)) ** params.exponent
    interaction = desired_gap(speed, leader_speed, params) / jnp.maximum(gap, GAP_FLOOR)
    accel = params.accel_max * (1.0 - free - jnp.square(interaction))
    return jnp.maximum(accel, -params.brake_max)


def equilibrium_gap(speed: jax.Array, desired_speed: jax.Array, params: IDMParams) -> jax.Array:
    """Gap at which a driver follows at constant speed: (s0 + v T) / sqrt(1 - (v / v0)^exponent).

    Args:
      speed: m/s, of follower and leader.
      desired_speed: m/s.
      params: the driver.

    Returns:
      m; infinity at or above the desired speed.
    """
    free = (speed / jnp.maximum(desired_speed, SPEED_FLOOR)) ** params.exponent
    slack = jnp.sqrt(jnp.maximum(1.0 - free, 0.0))
    return (params.min_gap + speed * params.headway) / slack
