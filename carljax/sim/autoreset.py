"""Next-step autoreset: an ended episode shows its final observation, then restarts.

The step after an episode's end ignores its action and returns the first state of a new episode with
reward 0 and done 0. So the value at that state's predecessor in time is V(final observation), and a
truncated episode bootstraps without a second raster or forward pass. Learners give that step weight
0.
"""

from __future__ import annotations

import functools
from typing import Protocol

import jax
import jax.numpy as jnp

from carljax.sim.types import State

AT_ONCE = 4  # episodes begun together on a CPU


class Env(Protocol):
    """What the rollout asks of an environment: everything unbatched.

    `reset(key)` is `observe(start(key))` and `step(state, action)` is `observe(advance(state,
    action))`. They are apart so that an autoreset chooses the state first and draws only one image.
    """

    @property
    def levels(self) -> tuple[tuple[int, ...] | None, ...]:
        """The values other than 0 that each channel of its image takes; None: any."""

    def start(self, key: jax.Array) -> State:
        """Returns the first state of an episode, its `obs` still None."""

    def advance(self, state: State, action: jax.Array) -> State:
        """Returns the next state, its `obs` still None."""

    def observe(self, state: State) -> State:
        """Returns the state with its `obs` filled in."""


def step(env: Env, state: State, action: jax.Array, keys: jax.Array) -> State:
    """Steps running episodes, restarts ended ones.

    Args:
      env: the environment, unbatched.
      state: (B,) states; `state.done` decides.
      action: (B, 2) float32 in [-1, 1].
      keys: (B,) PRNG keys of this step, used by restarts only.

    Returns:
      (B,) next states.
    """
    return jax.vmap(env.observe)(advance(env, state, action, keys))


def advance(env: Env, state: State, action: jax.Array, keys: jax.Array) -> State:
    """Returns what `step` does, without the observations."""
    stepped = jax.vmap(env.advance)(state, action)
    return jax.lax.platform_dependent(
        state.done > 0,
        stepped,
        keys,
        cpu=functools.partial(_restart_few, env),
        default=functools.partial(_restart_masked, env),
    )


def _restart_masked(env: Env, ended: jax.Array, stepped: State, keys: jax.Array) -> State:
    """Begins an episode in every environment and keeps those that are wanted.

    Nothing depends on what has ended, which suits accelerators.
    """
    fresh = jax.vmap(env.start)(keys)

    def choose(new: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.where(ended.reshape((-1,) + (1,) * (new.ndim - 1)), new, old)

    return jax.tree.map(choose, fresh, stepped)


def _restart_few(env: Env, ended: jax.Array, stepped: State, keys: jax.Array) -> State:
    """Begins episodes where they are wanted, some at a time: seldom more than one or two end."""
    num = ended.shape[0]
    at_once = min(AT_ONCE, num)

    def is_left(carry: tuple[jax.Array, State]) -> jax.Array:
        return carry[0].any()

    def restart(carry: tuple[jax.Array, State]) -> tuple[jax.Array, State]:
        ended, state = carry
        rows = jnp.nonzero(ended, size=at_once, fill_value=num)[0]  # num: none, dropped below
        fresh = jax.vmap(env.start)(keys[jnp.minimum(rows, num - 1)])
        state = jax.tree.map(lambda x, new: x.at[rows].set(new, mode="drop"), state, fresh)
        return ended.at[rows].set(False, mode="drop"), state

    return jax.lax.while_loop(is_left, restart, (ended, stepped))[1]
