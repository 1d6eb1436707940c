"""From a way and an acceleration to an action: pure pursuit, and pedals by the car's own law."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.planners import way as way_module
from carljax.planners.way import Way
from carljax.sim import geometry
from carljax.sim.bicycle import VehicleParams
from carljax.sim.types import EgoState

# Look-ahead of pure pursuit: metres at rest, seconds at speed. source: ours; keeps to 0.2 m at the
# beginning of a bend of 8 m, and a quarter of the comfort limit of the yaw acceleration
LOOK_AHEAD_M, LOOK_AHEAD_S = 1.5, 0.25
NEWTON_STEPS = 3


def steering(ego: EgoState, way: Way, car: VehicleParams) -> jax.Array:
    """Steers onto the arc through a point of the way ahead.

    The centre of the box leaves along yaw + slip on an arc of curvature sin(slip) / l_r, and so
    comes after a length d to the bearing slip + d sin(slip) / (2 l_r). Solved for the slip: on a
    circle that is exact, whatever d.

    Args:
      ego: the ego.
      way: its way.
      car: its car.

    Returns:
      () in [-1, 1].
    """
    reach = LOOK_AHEAD_M + LOOK_AHEAD_S * ego.speed
    target, _ = way_module.pose(way, reach)
    seen = geometry.to_frame(target, ego.xy, ego.yaw)
    bearing = jnp.arctan2(seen[1], seen[0])
    turn_per_sine = jnp.hypot(seen[0], seen[1]) / (2.0 * car.rear_length)
    slip = bearing / (1.0 + turn_per_sine)
    for _ in range(NEWTON_STEPS):
        miss = slip + turn_per_sine * jnp.sin(slip) - bearing
        slip = jnp.clip(slip - miss / (1.0 + turn_per_sine * jnp.cos(slip)), -1.0, 1.0)
    wheelbase = car.rear_length + car.front_length
    wheel = jnp.arctan(jnp.tan(slip) * wheelbase / car.rear_length)
    return jnp.clip(wheel / car.wheel_angle_max, -1.0, 1.0)


def pedal(speed: jax.Array, accel: jax.Array, car: VehicleParams) -> jax.Array:
    """The inverse of the car's acceleration law.

    Args:
      speed: () m/s.
      accel: () m/s^2 wanted.
      car: the car.

    Returns:
      () in [-1, 1], throttle (positive) or brake; its bound where the car can't do what is wanted.
    """
    strongest = car.accel_max * jnp.exp(-speed / car.accel_speed)
    share = jnp.clip(accel / strongest, 0.0, 1.0)
    throttle = share ** (1.0 / car.throttle_exponent)
    return jnp.where(accel > 0.0, throttle, jnp.maximum(accel / car.brake_max, -1.0))


def action(ego: EgoState, way: Way, accel: jax.Array, car: VehicleParams) -> jax.Array:
    """(2,) float32, the environment's action for a way and an acceleration."""
    steer = steering(ego, way, car)
    return jnp.stack([steer, pedal(ego.speed, accel, car)]).astype(jnp.float32)
