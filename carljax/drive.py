"""Driving without exploration, by a network or a rule-based planner, until each route ends."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Protocol, Self

import jax
from flax import struct

from carljax import leaderboard
from carljax.leaderboard import Drive
from carljax.planners import Planner
from carljax.ppo import beta, trainer
from carljax.ppo.networks import ActorCritic, forward
from carljax.sim.env import DrivingEnv
from carljax.sim.types import Observation, State


class Policy(Protocol):
    """Who drives: a pytree, so that compiled functions take it as an argument.

    Attributes:
      needs_image: it looks at `State.obs`, which is drawn for it alone.
    """

    needs_image: bool

    def init(self, env: DrivingEnv) -> Any:
        """Its memory at the start of one route."""

    def act(self, env: DrivingEnv, states: State, memory: Any) -> tuple[jax.Array, Any]:
        """Chooses for (B,) states and memories: (B, 2) float32 in [-1, 1], the next memories."""

    def replace(self, **changes: Any) -> Self:
        """A copy with other values."""


class NetworkPolicy(struct.PyTreeNode):
    """The mean action of a network. source: CaRL evaluates with the mean of the Beta policy.

    Attributes:
      params: its variables.
      network: actor and critic.
      needs_image: always.
    """

    params: Any
    network: ActorCritic = struct.field(pytree_node=False)
    needs_image: bool = struct.field(pytree_node=False, default=True)

    def init(self, env: DrivingEnv) -> Any:
        """Remembers nothing."""
        return ()

    def act(self, env: DrivingEnv, states: State, memory: Any) -> tuple[jax.Array, Any]:
        """See `Policy`."""
        return act(self.network, self.params, states.obs), memory


class PlannerPolicy(struct.PyTreeNode):
    """A rule-based driver, which sees the state itself.

    Attributes:
      planner: one of `planners.PLANNERS`.
      needs_image: only to be drawn.
    """

    planner: Planner = struct.field(pytree_node=False)
    needs_image: bool = struct.field(pytree_node=False, default=False)

    def init(self, env: DrivingEnv) -> Any:
        """See `Policy`."""
        return self.planner.init(env)

    def act(self, env: DrivingEnv, states: State, memory: Any) -> tuple[jax.Array, Any]:
        """See `Policy`."""
        one = functools.partial(self.planner.act, env)
        return jax.vmap(one)(states.pipeline_state, memory)


class Run(struct.PyTreeNode):
    """Drives under way and what the policy remembers of them, both (B,)."""

    drive: Drive
    memory: Any


def act(network: ActorCritic, params: Any, obs: Observation) -> jax.Array:
    """Chooses a network's mean actions.

    Args:
      network: actor and critic.
      params: its variables.
      obs: (B,) observations.

    Returns:
      (B, 2) float32 in [-1, 1].
    """
    alpha, beta_, _ = forward(network, params, obs)
    return beta.to_command(beta.mean(alpha, beta_))


def start(policy: Policy, env: DrivingEnv, episodes: jax.Array, key: jax.Array) -> Run:
    """Puts the ego at the start of given episodes.

    Args:
      policy: who will drive.
      env: the environment.
      episodes: (B,) int32, rows of its bank.
      key: PRNG key of what the episodes leave open; the same key and row give the same start.

    Returns:
      (B,) drives with memories.
    """

    def one(episode: jax.Array) -> Run:
        state = leaderboard.start(env, episode, jax.random.fold_in(key, episode))
        return Run(leaderboard.begin(_seen(policy, env, state)), policy.init(env))

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
