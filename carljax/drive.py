"""Driving without exploration: the policy's mean action, until each route ends."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax

from carljax import leaderboard
from carljax.leaderboard import Drive
from carljax.ppo import beta, trainer
from carljax.ppo.networks import ActorCritic, forward
from carljax.sim.env import DrivingEnv
from carljax.sim.types import Observation


def act(network: ActorCritic, params: Any, obs: Observation) -> jax.Array:
    """Chooses actions. source: CaRL evaluates with the mean of the Beta policy.

    Args:
      network: actor and critic.
      params: its variables.
      obs: (B,) observations.

    Returns:
      (B, 2) float32 in [-1, 1].
    """
    alpha, beta_, _ = forward(network, params, obs)
    return beta.to_command(beta.mean(alpha, beta_))


def start(env: DrivingEnv, episodes: jax.Array, key: jax.Array) -> Drive:
    """Puts the ego at the start of given episodes.

    Args:
      env: the environment.
      episodes: (B,) int32, rows of its bank.
      key: PRNG key of what the episodes leave open; the same key and row give the same start.

    Returns:
      (B,) drives.
    """

    def one(episode: jax.Array) -> Drive:
        state = env.start_episode(episode, jax.random.fold_in(key, episode))
        return leaderboard.begin(env.observe(state))

    return jax.vmap(one)(episodes)


def step(
    network: ActorCritic, env: DrivingEnv, params: Any, drive: Drive
) -> tuple[Drive, jax.Array]:
    """Makes one step by the rules of `leaderboard`; routes that have ended stay as they ended.

    Args:
      network: actor and critic.
      env: the environment.
      params: its variables.
      drive: (B,) drives.

    Returns:
      (B,) drives and the (B, 2) actions taken.
    """
    command = act(network, params, drive.state.obs)

    def one(drive: Drive, action: jax.Array) -> Drive:
        moved = leaderboard.advance(env, drive, action)
        return moved.replace(state=env.observe(moved.state))

    blind = drive.replace(state=drive.state.replace(obs=None))
    return jax.vmap(one)(blind, command), command


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
