"""Time to collision: would the ego's box meet another within a second if all went on as now?

The ego is tested against the N others only, at five moments.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from carljax.reward.collision import is_near_in_height
from carljax.sim import geometry
from carljax.sim.bicycle import VehicleParams
from carljax.sim.types import KIND_PEDESTRIAN, KIND_VEHICLE, Agents, EgoState

ARC_TIMES = np.array([0.2, 0.4, 0.6, 0.8, 1.0], np.float32)  # s. source: paper, Soft Penalties
STRAIGHT_TIMES = np.array([0.1, 0.3, 0.5, 0.7, 0.9], np.float32)  # s. source: the authors' code

Forecast = Callable[
    [jax.Array, jax.Array, jax.Array, jax.Array, jax.Array], tuple[jax.Array, jax.Array]
]


def forecast_arc(
    xy: jax.Array, yaw: jax.Array, slip: jax.Array, speed: jax.Array, yaw_rate: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Poses on the arcs of kinematic bicycles that keep speed and steering.

    Args:
      xy: (..., 2) m.
      yaw: (...) rad.
      slip: (...) rad, direction of motion minus yaw.
      speed: (...) m/s.
      yaw_rate: (...) rad/s.

    Returns:
      xy (5, ..., 2) m and yaw (5, ...) rad at `ARC_TIMES`.
    """
    times = ARC_TIMES.reshape((-1,) + (1,) * yaw.ndim)
    half_turn = 0.5 * yaw_rate * times
    # Chord of an arc: shorter than the arc by sin(h) / h, along the direction half way.
    chord = speed * times * jnp.sinc(half_turn / np.float32(np.pi))
    direction = yaw + slip + half_turn
    # Not one offset (..., 2) of both: whatever is stacked a CPU computes number by number.
    x, y = xy[..., 0] + chord * jnp.cos(direction), xy[..., 1] + chord * jnp.sin(direction)
    return jnp.stack([x, y], axis=-1), yaw + 2.0 * half_turn


def forecast_straight(
    xy: jax.Array, yaw: jax.Array, slip: jax.Array, speed: jax.Array, yaw_rate: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Poses straight ahead along the heading at constant speed.

    Args:
      xy: (..., 2) m.
      yaw: (...) rad.
      slip: (...) rad; the heading is taken for the direction of motion, so not used.
      speed: (...) m/s.
      yaw_rate: (...) rad/s; not used.

    Returns:
      xy (5, ..., 2) m and yaw (5, ...) rad at `STRAIGHT_TIMES`.
    """
    del slip, yaw_rate
    return _straight(STRAIGHT_TIMES, xy, yaw, speed)


def forecast_straight_second(
    xy: jax.Array, yaw: jax.Array, slip: jax.Array, speed: jax.Array, yaw_rate: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """As `forecast_straight`, at `ARC_TIMES`. source: the authors' code for nuPlan."""
    del slip, yaw_rate
    return _straight(ARC_TIMES, xy, yaw, speed)


def _straight(
    moments: np.ndarray, xy: jax.Array, yaw: jax.Array, speed: jax.Array
) -> tuple[jax.Array, jax.Array]:
    times = moments.reshape((-1,) + (1,) * yaw.ndim)
    heading = jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=-1)
    travel = (speed * times)[..., None]
    return xy + travel * heading, jnp.broadcast_to(yaw, times.shape[:1] + yaw.shape)


def violated(
    ego: EgoState,
    agents: Agents,
    vehicle: VehicleParams,
    forecast: Forecast,
    min_speed: jax.Array | float,
    z_gap: jax.Array | float,
) -> jax.Array:
    """Whether the ego's box meets another in the forecast.

    Being rear-ended and static things count; but nothing does while the ego stands or while there
    is neither vehicle nor pedestrian. source: the authors' code.

    Args:
      ego: the ego.
      agents: the others.
      vehicle: the ego's box.
      forecast: `forecast_arc` or `forecast_straight`.
      min_speed: m/s, ego speed below which there is no violation.
      z_gap: m, height difference that keeps boxes apart.

    Returns:
      () bool.
    """
    ego_xy, ego_yaw = forecast(ego.xy, ego.yaw, ego.slip, ego.speed, ego.yaw_rate)
    xy, yaw = forecast(
        agents.xy, agents.yaw, jnp.zeros_like(agents.yaw), agents.speed, agents.yaw_rate
    )
    overlap = geometry.boxes_overlap(
        ego_xy[:, None],
        ego_yaw[:, None],
        vehicle.length,
        vehicle.width,
        xy,
        yaw,
        agents.length,
        agents.width,
    )
    meets = jnp.any(overlap & is_near_in_height(ego, agents, z_gap))
    is_mover = (agents.kind == KIND_VEHICLE) | (agents.kind == KIND_PEDESTRIAN)
    return meets & jnp.any(is_mover) & (ego.speed >= min_speed)


def factor(ticks_left: jax.Array, active_factor: jax.Array | float) -> jax.Array:
    """Soft factor: `active_factor` while the penalty holds, else 1.

    Args:
      ticks_left: () int32, from `timer.tick`.
      active_factor: in [0, 1].

    Returns:
      () in [0, 1].
    """
    return 1.0 - (ticks_left > 0) * (1.0 - jnp.asarray(active_factor, jnp.float32))
