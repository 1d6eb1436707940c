"""Collecting experience: `scan` over time, `vmap` over environments."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from carljax.ppo import beta, hints
from carljax.ppo.networks import ActorCritic, forward
from carljax.ppo.obs_storage import STORE, ObsStorage
from carljax.ppo.types import Transition
from carljax.sim import autoreset
from carljax.sim.autoreset import Env
from carljax.sim.types import State

EPISODE_PREFIX = "episode/"


def rollout(
    env: Env,
    network: ActorCritic,
    params: Any,
    env_state: State,
    keys: jax.Array,
    num_steps: int,
    keeps_policy: bool = False,
    keeps_hints: bool = False,
    storage: ObsStorage = STORE,
) -> tuple[State, Transition, jax.Array, dict[str, jax.Array]]:
    """Drives all environments for a number of steps.

    Args:
      env: unbatched environment.
      network: actor and critic.
      params: its variables.
      env_state: (B,) states.
      keys: (B,) PRNG keys, one per environment: what an environment does depends on its own key
        only, not on the device or the batch that it is in.
      num_steps: T.
      keeps_policy: fill in `Transition.policy`.
      keeps_hints: fill in `Transition.hint`.
      storage: how `Transition.obs` is kept.

    Returns:
      (B,) states after the last step; (T, B) transitions; (B,) value of the last states; {name: ()}
      sums of the environments' metrics (see `mean_metrics`).
    """

    def step(env_state: State, t: jax.Array) -> tuple[State, tuple[Transition, dict]]:
        keys_t = jax.vmap(lambda key: jax.random.split(jax.random.fold_in(key, t)))(keys)
        alpha, beta_, value = forward(network, params, env_state.obs)
        action = jax.vmap(beta.sample)(keys_t[:, 0], alpha, beta_)
        command = beta.to_command(action)
        next_state = autoreset.step(env, env_state, command, keys_t[:, 1])
        transition = Transition(
            obs=jax.vmap(storage.keep, in_axes=(None, 0))(env, env_state),
            action=action,
            log_prob=beta.log_prob(action, alpha, beta_),
            value=value,
            reward=next_state.reward,
            done=next_state.done,
            truncation=next_state.info["truncation"],
            weight=1.0 - env_state.done,
            policy=(alpha, beta_) if keeps_policy else None,
            hint=hints.of_end(next_state.metrics) if keeps_hints else None,
        )
        return next_state, (transition, _metric_sums(next_state, transition.weight))

    env_state, (batch, sums) = jax.lax.scan(step, env_state, jnp.arange(num_steps))
    _, _, last_value = forward(network, params, env_state.obs)
    return env_state, batch, last_value, jax.tree.map(lambda x: jnp.sum(x, axis=0), sums)


def _metric_sums(state: State, weight: jax.Array) -> dict[str, jax.Array]:
    """Sums metrics over environments: `episode/` where an episode ended, others where it ran."""
    sums = {}
    for name, metric in state.metrics.items():
        mask = state.done if name.startswith(EPISODE_PREFIX) else weight
        sums[name] = jnp.sum(jnp.where(mask > 0, metric, jnp.float32(0.0)))
    return sums


def mean_metrics(
    sums: dict[str, jax.Array], num_steps: jax.Array, num_episodes: jax.Array
) -> dict[str, jax.Array]:
    """Turns sums over a rollout into means.

    Args:
      sums: of `rollout`, added up over devices.
      num_steps: () float32, steps that were not restarts.
      num_episodes: () float32, episodes that ended.

    Returns:
      {name: ()} means per step, or for names with `episode/` per ended episode (0 if none ended),
      and their number as `episode/num`.
    """
    means = {}
    for name, total in sums.items():
        count = num_episodes if name.startswith(EPISODE_PREFIX) else num_steps
        means[name] = total / jnp.maximum(count, 1.0)
    return {**means, EPISODE_PREFIX + "num": num_episodes}
