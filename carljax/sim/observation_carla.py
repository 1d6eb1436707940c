"""The observation of CaRL in CARLA: ten channels, eight numbers, ten more for the critic.

Source: paper, on the observation and the asymmetric critic; the authors' code for the order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from carljax.sim import bicycle, critic_inputs, rasterizer, route, situation
from carljax.sim.types import EgoState, Observation, SimState

if TYPE_CHECKING:
    from carljax.sim.env import DrivingEnv

NUM_SCALARS = 8
NUM_VALUE_SCALARS = 10

ROUTE_POINTS_SCALE = 100.0  # source: the authors' code, critic inputs
TICKS_SCALE = 500.0  # source: the authors' code, critic inputs


def observe(env: DrivingEnv, sim: SimState) -> Observation:
    """Draws the image and collects the numbers of one state.

    Args:
      env: gives towns, routes and the image's size.
      sim: the state.

    Returns:
      The observation.
    """
    road_map = env.bank.road_map
    stretch, first = route.window(env.bank.routes, sim.episode_idx, sim.route_idx)
    idx = sim.route_idx - first
    memory, config = sim.reward_state, env.reward_config
    raster = rasterizer.render(
        sim.ego,
        sim.agents,
        road_map,
        stretch,
        idx,
        situation.stop_lights(road_map, stretch, sim.lights),
        situation.yellow_left(road_map, stretch, sim.lights),
        critic_inputs.stop_satisfied(memory),
        env.config.raster,
    )
    return Observation(
        raster=raster,
        scalars=scalars(sim.ego, stretch.speed_limit[idx]),
        value_scalars=value_scalars(
            elapsed_s=sim.step_count.astype(jnp.float32) * env.config.dt,
            time_limit_s=config.time_limit_s,
            stopped_s=critic_inputs.stopped_s(memory),
            blocked_s=config.blocked_s,
            route_points_left=stretch.num_points - 1 - idx,
            ttc_ticks=critic_inputs.ttc_ticks(memory),
            comfort_ticks=critic_inputs.comfort_ticks(memory),
        ),
    )


def scalars(ego: EgoState, speed_limit: jax.Array) -> jax.Array:
    """The policy's numbers, raw as in the paper's code.

    Args:
      ego: the ego.
      speed_limit: () m/s in force.

    Returns:
      (8,) last steer, throttle, brake; gear; velocity along and left of the body, m/s; forward
      speed, m/s; speed limit, m/s.
    """
    ahead = ego.speed * jnp.cos(ego.slip)
    left = ego.speed * jnp.sin(ego.slip)
    gear = bicycle.gear(ego.speed).astype(jnp.float32)
    values = [ego.steer, ego.throttle, ego.brake, gear, ahead, left, ahead, speed_limit]
    return jnp.stack(values)


def value_scalars(
    elapsed_s: jax.Array,
    time_limit_s: float,
    stopped_s: jax.Array,
    blocked_s: float,
    route_points_left: jax.Array,
    ttc_ticks: jax.Array,
    comfort_ticks: jax.Array,
) -> jax.Array:
    """The critic's own numbers: how near the episode's ends and penalties are.

    Args:
      elapsed_s: () s of the episode.
      time_limit_s: s.
      stopped_s: () s the ego has stood still; 0 while it moves.
      blocked_s: s of standing that end an episode.
      route_points_left: () int32, points of about 1 m.
      ttc_ticks: () int32, steps for which the TTC penalty still holds.
      comfort_ticks: (6,) int32, likewise for each comfort metric.

    Returns:
      (10,) float32: fractions of time and of patience left, hundreds of metres to go, and the
      penalties' steps left over 500.
    """
    ticks = jnp.concatenate([ttc_ticks[None], comfort_ticks]).astype(jnp.float32)
    ends = jnp.stack(
        [
            (time_limit_s - elapsed_s) / time_limit_s,
            (blocked_s - stopped_s) / blocked_s,
            route_points_left.astype(jnp.float32) / ROUTE_POINTS_SCALE,
        ]
    )
    return jnp.concatenate([ends, ticks / TICKS_SCALE])
