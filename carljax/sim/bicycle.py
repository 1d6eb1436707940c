"""The ego vehicle: a kinematic bicycle that answers like CARLA's default saloon.

The reference point is the centre of the box. At wheel angle w the car moves along its yaw plus a
slip b = atan(l_r / (l_f + l_r) tan w): x' = v cos(yaw + b), y' = v sin(yaw + b),
yaw' = v / l_r sin b. Source of the equations: Kong et al., Kinematic and dynamic vehicle models for
autonomous driving control design (2015). Source of the lengths and the wheel angle: the fit to
CARLA's Lincoln MKZ in carla_garage (kinematic_bicycle_model.py, MIT), first made for World on
Rails; it is a fit and no geometry, which is why l_f is negative.
"""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from carljax.sim.geometry import wrap_angle
from carljax.sim.types import EgoState

# Speeds at which the next gear comes in, m/s. source: ours. A kinematic model has no gearbox, but
# the policy is told a gear: 0 at rest, then one more for each threshold passed, six at most.
GEAR_SPEEDS = (0.1, 4.0, 8.0, 13.0, 19.0, 26.0)


class VehicleParams(struct.PyTreeNode):
    """A car: its box, its steering and how it gains and loses speed.

    The acceleration law is ours: accel_max * throttle ** throttle_exponent * exp(-speed /
    accel_speed) - brake_max * brake. Its four numbers are the least-squares fit to the
    accelerations that follow from carla_garage's regression of CARLA's vehicle, over the region
    where that regression is physical (throttle 0.5, 0.75 and 1 up to 30 m/s: 0.22 m/s^2 root mean
    square, 0.55 at worst; full brake from 10 m/s up: the mean, 0.7 at worst). Rolling without
    throttle keeps the speed, as the regression does.

    Attributes:
      length: m, of the box. source: Lincoln MKZ in CARLA, half extents 2.446 x 0.918 m
      width: m, of the box.
      rear_length: m, l_r above. source: carla_garage
      front_length: m, l_f above. source: carla_garage
      wheel_angle_max: rad, wheel angle at full steering. source: carla_garage
      accel_max: m/s^2, at full throttle from rest. source: fit, see above
      throttle_exponent: of the throttle. source: fit, see above
      accel_speed: m/s, over which the acceleration falls to 1/e. source: fit, see above
      brake_max: m/s^2, deceleration at full brake. source: fit, see above
    """

    length: float = 4.892
    width: float = 1.836
    rear_length: float = 1.4178275
    front_length: float = -0.090769015
    wheel_angle_max: float = 0.36848336
    accel_max: float = 7.78
    throttle_exponent: float = 2.53
    accel_speed: float = 21.5
    brake_max: float = 7.26


def from_action(action: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Splits a policy's action into controls.

    Args:
      action: (2,) in [-1, 1], cut to it: [steering, longitudinal]. Positive steering turns left, as
        everything here is right-handed; CARLA's positive steering turns right. Positive
        longitudinal is throttle, negative is brake.

    Returns:
      steer () in [-1, 1], throttle () in [0, 1], brake () in [0, 1].
    """
    chex.assert_shape(action, (2,))
    action = jnp.clip(action, -1.0, 1.0)
    return action[0], jnp.maximum(action[1], 0.0), jnp.maximum(-action[1], 0.0)


def longitudinal_accel(
    speed: jax.Array, throttle: jax.Array, brake: jax.Array, params: VehicleParams
) -> jax.Array:
    """Acceleration that pedals command, smooth and monotone in all three; see `VehicleParams`.

    Args:
      speed: m/s, not negative.
      throttle: in [0, 1].
      brake: in [0, 1].
      params: the car.

    Returns:
      m/s^2 along the direction of motion.
    """
    drive = params.accel_max * throttle**params.throttle_exponent
    return drive * jnp.exp(-speed / params.accel_speed) - params.brake_max * brake


def slip_angle(steer: jax.Array, params: VehicleParams) -> jax.Array:
    """Direction of motion minus yaw.

    Args:
      steer: in [-1, 1].
      params: the car.

    Returns:
      rad, positive to the left.
    """
    wheelbase = params.rear_length + params.front_length
    return jnp.arctan(params.rear_length / wheelbase * jnp.tan(params.wheel_angle_max * steer))


def step(
    ego: EgoState,
    steer: jax.Array,
    throttle: jax.Array,
    brake: jax.Array,
    params: VehicleParams,
    dt: float,
) -> EgoState:
    """Drives for one step: exactly, for the steering and the acceleration at its beginning.

    With both constant the path is an arc, so there is no integration error to depend on `dt`. A car
    that brakes to a halt within the step stands where it halted; there is no reverse gear.

    Args:
      ego: state before.
      steer: () in [-1, 1], positive turns left.
      throttle: () in [0, 1].
      brake: () in [0, 1].
      params: the car.
      dt: s.

    Returns:
      State after; z is unchanged, yaw_rate is that of the new speed, accel the mean over the step.
    """
    accel = longitudinal_accel(ego.speed, throttle, brake, params)
    speed = jnp.maximum(ego.speed + accel * dt, 0.0)
    # Halting takes speed / -accel < dt; otherwise the car moves for the whole step.
    halts = ego.speed + accel * dt < 0.0
    moving_time = jnp.where(halts, ego.speed / jnp.where(halts, -accel, 1.0), dt)
    distance = 0.5 * (ego.speed + speed) * moving_time
    slip = slip_angle(steer, params)
    curvature = jnp.sin(slip) / params.rear_length
    half_turn = 0.5 * distance * curvature
    # Chord of an arc: shorter than the arc by sin(h) / h, along the direction half way.
    chord = distance * jnp.sinc(half_turn / np.float32(np.pi))
    direction = ego.yaw + slip + half_turn
    offset = jnp.stack([chord * jnp.cos(direction), chord * jnp.sin(direction)])
    return ego.replace(
        xy=ego.xy + offset,
        yaw=wrap_angle(ego.yaw + 2.0 * half_turn),
        speed=speed,
        slip=slip,
        yaw_rate=speed * curvature,
        accel=(speed - ego.speed) / dt,
        steer=steer,
        throttle=throttle,
        brake=brake,
    )


def gear(speed: jax.Array) -> jax.Array:
    """Gear that an automatic gearbox would be in: `GEAR_SPEEDS` passed.

    Args:
      speed: any shape, m/s.

    Returns:
      Same shape, float32: 0 at rest to 6.
    """
    passed = speed[..., None] >= jnp.asarray(GEAR_SPEEDS, jnp.float32)
    return jnp.sum(passed, axis=-1).astype(jnp.float32)
