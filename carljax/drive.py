"""Driving to be scored, by a network or a rule-based planner, until each route ends."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Protocol, Self

import jax
import jax.numpy as jnp
from flax import struct

from carljax import leaderboard
from carljax.config import Action
from carljax.leaderboard import Drive
from carljax.planners import Planner
from carljax.ppo import beta, trainer
from carljax.ppo.networks import ActorCritic, forward
from carljax.sim.env import DrivingEnv
from carljax.sim.types import Observation, State

# source: CaRL evaluates with the mean of the Beta policy, Roach with its mode
STATISTICS = {"mean": beta.mean, "mode": beta.mode}
# Folded into an episode's key for the policy's own draws: far from the few numbers by which the
# environment splits that key.
_POLICY_STREAM = 0x706F6C


class Policy(Protocol):
    """Who drives: a pytree, so that compiled functions take it as an argument.

    Attributes:
      needs_image: it looks at `State.obs`, which is drawn for it alone.
    """

    needs_image: bool

    def init(self, env: DrivingEnv, key: jax.Array) -> Any:
        """Its memory at the start of one route; the key is for what it leaves to chance."""

    def act(self, env: DrivingEnv, states: State, memory: Any) -> tuple[jax.Array, Any]:
        """Chooses for (B,) states and memories: (B, 2) float32 in [-1, 1], the next memories."""

    def replace(self, **changes: Any) -> Self:
        """A copy with other values."""


class NetworkPolicy(struct.PyTreeNode):
    """The actions of a network.

    Attributes:
      params: its variables.
      network: actor and critic.
      action: the mean or the mode of its Beta policy, or a sample.
      needs_image: always.
    """

    params: Any
    network: ActorCritic = struct.field(pytree_node=False)
    action: Action = struct.field(pytree_node=False, default="mean")
    needs_image: bool = struct.field(pytree_node=False, default=True)

    def init(self, env: DrivingEnv, key: jax.Array) -> Any:
        """Remembers the key of its samples, else nothing."""
        return key if self.action == "sample" else ()

    def act(self, env: DrivingEnv, states: State, memory: Any) -> tuple[jax.Array, Any]:
        """See `Policy`."""
        if self.action == "sample":
            return act_by_chance(self.network, self.params, states.obs, memory)
        statistic = STATISTICS[self.action]
        return act(self.network, self.params, states.obs, statistic), memory


class PlannerPolicy(struct.PyTreeNode):
    """A rule-based driver, which sees the state itself.

    Attributes:
      planner: one of `planners.PLANNERS`.
      needs_image: only to be drawn.
    """

    planner: Planner = struct.field(pytree_node=False)
    needs_image: bool = struct.field(pytree_node=False, default=False)

    def init(self, env: DrivingEnv, key: jax.Array) -> Any:
        """See `Policy`; leaves nothing to chance."""
        return self.planner.init(env)

    def act(self, env: DrivingEnv, states: State, memory: Any) -> tuple[jax.Array, Any]:
        """See `Policy`."""
        one = functools.partial(self.planner.act, env)
        return jax.vmap(one)(states.pipeline_state, memory)


class Run(struct.PyTreeNode):
    """Drives under way and what the policy remembers of them, both (B,)."""

    drive: Drive
    memory: Any


def act(
    network: ActorCritic,
    params: Any,
    obs: Observation,
    statistic: Callable[[jax.Array, jax.Array], jax.Array] = beta.mean,
) -> jax.Array:
    """Chooses a network's actions without chance.

    Args:
      network: actor and critic.
      params: its variables.
      obs: (B,) observations.
      statistic: of the Beta policy, one of `STATISTICS`.

    Returns:
      (B, 2) float32 in [-1, 1].
    """
    alpha, beta_, _ = forward(network, params, obs)
    return beta.to_command(statistic(alpha, beta_))


def act_by_chance(
    network: ActorCritic, params: Any, obs: Observation, keys: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Draws a network's actions, each from a key of its own.

    Args:
      network: actor and critic.
      params: its variables.
      obs: (B,) observations.
      keys: (B,) PRNG keys.

    Returns:
      (B, 2) float32 in [-1, 1], and the (B,) keys of the next draws.
    """
    alpha, beta_, _ = forward(network, params, obs)
    keys, keys_now = jnp.moveaxis(jax.vmap(jax.random.split)(keys), 1, 0)
    return beta.to_command(jax.vmap(beta.sample)(keys_now, alpha, beta_)), keys


def start(policy: Policy, env: DrivingEnv, episodes: jax.Array, key: jax.Array) -> Run:
    """Puts the ego at the start of given episodes.

    Args:
      policy: who will drive.
      env: the environment.
      episodes: (B,) int32, rows of its bank.
      key: PRNG key of what the episodes leave open; the same key and row give the same start, and
        to a policy that samples the same draws.

    Returns:
      (B,) drives with memories.
    """

    def one(episode: jax.Array) -> Run:
        key_episode = jax.random.fold_in(key, episode)
        state = leaderboard.start(env, episode, key_episode)
        memory = policy.init(env, jax.random.fold_in(key_episode, _POLICY_STREAM))
        return Run(leaderboard.begin(_seen(policy, env, state)), memory)

    return jax.vmap(one)(episodes)


def step(policy: Policy, env: DrivingEnv, run: Run) -> tuple[Run, jax.Array]:
    """Makes one step by the rules of `leaderboard`; routes that have ended stay as they ended.

    Args:
      policy: who drives.
      env: the environment.
      run: (B,) drives with memories.

    Returns:
      The same a step later, and the (B, 2) actions chosen.
    """
    command, memory = policy.act(env, run.drive.state, run.memory)

    def one(drive: Drive, action: jax.Array) -> Drive:
        moved = leaderboard.advance(env, drive, action)
        return moved.replace(state=_seen(policy, env, moved.state))

    blind = run.drive.replace(state=run.drive.state.replace(obs=None))
    return Run(jax.vmap(one)(blind, command), memory), command


def _seen(policy: Policy, env: DrivingEnv, state: State) -> State:
    return env.observe(state) if policy.needs_image else state


@functools.cache
def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Jits a function once per process, with the options of the train step."""
    return jax.jit(function, compiler_options=trainer.compiler_options(jax.default_backend()))
