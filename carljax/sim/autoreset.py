"""Next-step autoreset: an ended episode shows its final observation, then restarts.

The step after an episode's end ignores its action and returns the first state of a new episode with
reward 0 and done 0. So the value at that state's predecessor in time is V(final observation), and a
truncated episode bootstraps without a second raster or forward pass. Learners give that step weight 0.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.sim.types import State


def step(env, state: State, action: jax.Array, key: jax.Array) -> State:
    """Steps a running episode, restarts an ended one.

    Args:
      env: a `DrivingEnv` or anything with its `reset` and `step`.
      state: unbatched state; `state.done` decides.
      action: (2,) float32 in [-1, 1].
      key: PRNG key of this step, used by a restart only.

    Returns:
      The next state.
    """
    fresh = env.reset(key)
    stepped = env.step(state, action)
    return jax.tree.map(lambda a, b: jnp.where(state.done > 0, a, b), fresh, stepped)
