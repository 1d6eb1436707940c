"""Driving without exploration: the policy's mean action, until each episode ends."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from carljax.ppo import beta, trainer
from carljax.ppo.networks import ActorCritic
from carljax.sim.env import DrivingEnv
from carljax.sim.types import Observation, State


def act(network: ActorCritic, params: Any, obs: Observation) -> jax.Array:
    """Chooses actions. source: CaRL evaluates with the mean of the Beta policy.

    Args:
      network: actor and critic.
      params: its variables.
      obs: (B,) observations.

    Returns:
      (B, 2) float32 in [-1, 1].
    """
    alpha, beta_, _ = network.apply(params, obs)
    return beta.to_command(beta.mean(alpha, beta_))


def start(env: DrivingEnv, scenarios: jax.Array, key: jax.Array) -> State:
    """Puts the ego at the start of given scenarios.

    Args:
      env: the environment.
      scenarios: (B,) int32, rows of its bank.
      key: PRNG key of what the scenarios leave open; the same key and row give the same start.

    Returns:
      (B,) states.
    """

    def one(scenario: jax.Array) -> State:
        return env.observe(env.start_scenario(scenario, jax.random.fold_in(key, scenario)))

    return jax.vmap(one)(scenarios)


def step(
    network: ActorCritic, env: DrivingEnv, params: Any, state: State
) -> tuple[State, jax.Array]:
    """Makes one step; ended episodes stay as they ended.

    Args:
      network: actor and critic.
      env: the environment.
      params: its variables.
      state: (B,) states.

    Returns:
      (B,) states and the (B, 2) actions taken.
    """
    command = act(network, params, state.obs)

    def one(state: State, action: jax.Array) -> State:
        moved = env.advance(state, action)
        kept = jax.tree.map(lambda a, b: jnp.where(state.done > 0, a, b), state, moved)
        return env.observe(kept)

    return jax.vmap(one)(state.replace(obs=None), command), command


@functools.cache
def compiled(function: Callable[..., Any], network: ActorCritic) -> Callable[..., Any]:
    """Jits a function of a network once per process, with the options of the train step.

    Args:
      function: takes the network first, then arrays.
      network: actor and critic.

    Returns:
      The jitted function of the arrays.
    """
    options = trainer.compiler_options(jax.default_backend())
    return jax.jit(functools.partial(function, network), compiler_options=options)
