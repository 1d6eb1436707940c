"""Next-step autoreset: an ended episode shows its final observation, then restarts.

The step after an episode's end ignores its action and returns the first state of a new episode with
reward 0 and done 0. So the value at that state's predecessor in time is V(final observation), and a
truncated episode bootstraps without a second raster or forward pass. Learners give that step weight
0.
"""

from __future__ import annotations

from typing import Protocol

import jax
import jax.numpy as jnp

from carljax.sim.types import State


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


def step(env: Env, state: State, action: jax.Array, key: jax.Array) -> State:
    """Steps a running episode, restarts an ended one.

    Args:
      env: the environment.
      state: unbatched state; `state.done` decides.
      action: (2,) float32 in [-1, 1].
      key: PRNG key of this step, used by a restart only.

    Returns:
      The next state.
    """
    fresh = env.start(key)
    stepped = env.advance(state, action)
    chosen = jax.tree.map(lambda a, b: jnp.where(state.done > 0, a, b), fresh, stepped)
    return env.observe(chosen)
