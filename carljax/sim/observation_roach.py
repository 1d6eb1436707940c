"""Roach's observation: fifteen channels that show a second and a half, six or eight numbers.

Source: Roach (Zhang et al. 2021); CaRL's reproduction of it for the eight numbers and the critic.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Literal

import jax
import jax.numpy as jnp

from carljax.sim import (
    critic_inputs,
    observation_carla,
    raster_roach,
    raster_road,
    route,
    situation,
)
from carljax.sim.raster_users import HEIGHT_REACH
from carljax.sim.types import KIND_NONE, Observation, SimState, Trail

if TYPE_CHECKING:
    from carljax.sim.env import DrivingEnv

# source: CaRL's reproduction: these inputs of the critic are there, but zero. Roach has none; the
# zeros stay, as checkpoints hold no empty arrays.
NUM_VALUE_SCALARS = 3
# Places in CaRL's eight numbers of Roach's six: throttle, steer, brake, gear, v_x, v_y.
_ORIGINAL = (1, 0, 2, 3, 4, 5)


@dataclasses.dataclass(frozen=True)
class RoachOptions:
    """Options of the observation `roach`."""

    scalars: Literal["original", "carl"] = "original"
    """Numbers beside the image: Roach's six, or the eight of CaRL's reproduction."""


def observe(env: DrivingEnv, sim: SimState) -> Observation:
    """Draws the image and collects the numbers of one state.

    Args:
      env: gives towns, routes and the image's size.
      sim: the state.

    Returns:
      The observation.
    """
    stretch, first = route.window(env.bank.routes, sim.episode_idx, sim.route_idx)
    idx = sim.route_idx - first
    trail = sim.past
    assert isinstance(trail, Trail)
    numbers = observation_carla.scalars(sim.ego, stretch.speed_limit[idx])
    if env.config.roach.scalars == "original":
        numbers = jnp.stack([numbers[place] for place in _ORIGINAL])
    return Observation(
        raster=raster_roach.render(
            sim.ego, trail, env.bank.road_map, stretch, idx, env.config.raster
        ),
        scalars=numbers,
        value_scalars=jnp.zeros(NUM_VALUE_SCALARS, jnp.float32),
    )


def begin(env: DrivingEnv, sim: SimState) -> Trail:
    """The trail at the start: all its steps show the first state, as nothing was before.

    Source: Roach, which shows the oldest state it has where it lacks older ones.
    """
    first = _seen(env, sim)
    steps = raster_roach.TRAIL_STEPS
    return jax.tree.map(lambda x: jnp.repeat(x[None], steps, axis=0), first)


def remember(env: DrivingEnv, before: SimState, after: SimState) -> Trail:
    """The trail after a step: the oldest state goes, the newest comes."""
    newest = _seen(env, after)
    return jax.tree.map(lambda old, new: jnp.append(old[1:], new[None], 0), before.past, newest)


def _seen(env: DrivingEnv, sim: SimState) -> Trail:
    """One step's entry."""
    stretch, first = route.window(env.bank.routes, sim.episode_idx, sim.route_idx)
    agents = sim.agents
    is_near = jnp.abs(agents.z - sim.ego.z) < HEIGHT_REACH
    satisfied = critic_inputs.stop_satisfied(sim.reward_state)
    asks, sign = raster_road.asking_stop_sign(stretch, sim.route_idx - first, satisfied)
    return Trail(
        xy=agents.xy,
        yaw=agents.yaw,
        length=agents.length,
        width=agents.width,
        kind=jnp.where(is_near, agents.kind, KIND_NONE).astype(jnp.int8),
        light=situation.stop_lights(env.bank.road_map, stretch, sim.lights).astype(jnp.int8),
        stop=jnp.where(asks[sign], sign, -1),
    )
