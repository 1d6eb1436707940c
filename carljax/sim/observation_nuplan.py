"""CaRL's observation in nuPlan: nine channels, ten numbers, four more for the critic.

Source: paper, nuPlan input; the authors' nuPlan code for the order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from carljax.reward.comfort import body_acceleration
from carljax.sim import critic_inputs, raster_nuplan, route
from carljax.sim.raster_nuplan import NuplanOptions
from carljax.sim.types import EgoState, Observation, PastMotion, SimState

if TYPE_CHECKING:
    from carljax.sim.env import DrivingEnv

__all__ = ["NUM_SCALARS", "NUM_VALUE_SCALARS", "NuplanOptions", "begin", "observe", "remember"]

NUM_SCALARS = 10
NUM_VALUE_SCALARS = 4


def observe(env: DrivingEnv, sim: SimState) -> Observation:
    """Draws the image and collects the numbers of one state.

    Args:
      env: gives towns, routes and the image's size.
      sim: the state.

    Returns:
      The observation.
    """
    stretch, first = route.window(env.bank.routes, sim.episode_idx, sim.route_idx)
    assert env.nuplan is not None and isinstance(sim.past, PastMotion)
    size = jnp.stack([jnp.float32(env.vehicle.length), jnp.float32(env.vehicle.width)])
    raster = raster_nuplan.render(
        sim.ego,
        size,
        sim.agents,
        env.bank.road_map,
        env.nuplan,
        stretch,
        sim.episode_idx,
        sim.lights,
        env.config.nuplan,
        env.config.raster,
    )
    memory, config = sim.reward_state, env.reward_config
    return Observation(
        raster=raster,
        scalars=scalars(sim.ego, sim.past, env.vehicle.wheel_angle_max, env.config.dt),
        value_scalars=value_scalars(
            elapsed_s=sim.step_count.astype(jnp.float32) * env.config.dt,
            time_limit_s=config.time_limit_s,
            completion=stretch.s[sim.route_idx - first] / stretch.length,
            comfort_score=critic_inputs.comfort_score(memory, config),
            ttc_score=critic_inputs.ttc_score(memory, config),
        ),
    )


def scalars(
    ego: EgoState, past: PastMotion, wheel_angle_max: jax.Array | float, dt: float
) -> jax.Array:
    """The policy's numbers, raw as in the authors' code.

    Throttle and brake are one action, of which one is zero. Wheels follow the steering at once in
    this model, so the wheel's rate is the difference of two actions.

    Args:
      ego: the ego.
      past: its motion one step ago.
      wheel_angle_max: rad, wheel angle at full steering.
      dt: s of a step.

    Returns:
      (10,) last action: longitudinal in [-1, 1], steering in [-1, 1]; velocity along and left of
      the body, m/s; acceleration likewise, m/s^2; wheel angle, rad; its rate, rad/s; yaw rate,
      rad/s; yaw acceleration, rad/s^2.
    """
    accel_lon, accel_lat = body_acceleration(ego)
    return jnp.stack(
        [
            ego.throttle - ego.brake,
            ego.steer,
            ego.speed * jnp.cos(ego.slip),
            ego.speed * jnp.sin(ego.slip),
            accel_lon,
            accel_lat,
            wheel_angle_max * ego.steer,
            wheel_angle_max * (ego.steer - past.steer) / dt,
            ego.yaw_rate,
            (ego.yaw_rate - past.yaw_rate) / dt,
        ]
    )


def value_scalars(
    elapsed_s: jax.Array,
    time_limit_s: jax.Array | float,
    completion: jax.Array,
    comfort_score: jax.Array,
    ttc_score: jax.Array,
) -> jax.Array:
    """The critic's own numbers: all are 1 at the start of an episode.

    Args:
      elapsed_s: () s of the episode.
      time_limit_s: s.
      completion: () in [0, 1], of the route so far.
      comfort_score: () in [0, 1], of the step.
      ttc_score: () in [0, 1], of the step.

    Returns:
      (4,) float32: fractions of time and of route left, and the two scores.
    """
    time_left = 1.0 - elapsed_s / time_limit_s
    return jnp.stack([time_left, 1.0 - completion, comfort_score, ttc_score])


def begin(env: DrivingEnv, sim: SimState) -> PastMotion:
    """The motion before the first state: none."""
    del env, sim
    return PastMotion(steer=jnp.float32(0.0), yaw_rate=jnp.float32(0.0))


def remember(env: DrivingEnv, before: SimState, after: SimState) -> PastMotion:
    """The motion one step before the state after a step."""
    del env, after
    return PastMotion(steer=before.ego.steer, yaw_rate=before.ego.yaw_rate)
