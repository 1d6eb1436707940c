"""Exploration hints: what an episode's end says about the steps before it.

Who was blocked should have gone on; who left the route should have gone and steered; who collided,
ran a red light or a stop sign should have braked. The 100 steps before such an end carry the hint,
and the loss draws the policy of the hinted actions towards a Beta distribution of that kind.
Source: Roach (Zhang et al. 2021), "exploration loss"; its code for the rules and the numbers.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from carljax.ppo import beta

NUM_STEPS = 100  # before the end that carry its hint. source: Roach's code

# Hints; of several causes at once the later in this order counts. source: Roach's code; the last
# ones of a kind are those of the reward `roach`
NONE, GO, GO_AND_TURN, STOP = range(4)
RULES = (
    ("blocked", GO),
    ("route_deviation", GO_AND_TURN),
    ("lateral_distance", GO_AND_TURN),
    ("red_light", STOP),
    ("stop_sign", STOP),
    ("collision", STOP),
    ("pedestrian_overlap", STOP),
)

# For each hint, of steering and of throttle or brake: whether it says anything, and the target's
# alpha and beta. source: Roach's code, go (2.5, 1), stop (1, 1.5), turn (1, 1)
_IS_HINTED = np.array([[0, 0], [0, 1], [1, 1], [0, 1]], bool)
_ALPHA = np.array([[1, 1], [1, 2.5], [1, 2.5], [1, 1]], np.float32)
_BETA = np.array([[1, 1], [1, 1], [1, 1], [1, 1.5]], np.float32)


def of_end(metrics: dict[str, jax.Array]) -> jax.Array:
    """Reads from a step's metrics what its end suggests.

    Args:
      metrics: `State.metrics` with `reward/CAUSE` () float32, above 0 where the cause ended the
        episode, for those of the causes that the reward knows.

    Returns:
      () int8 hint, `NONE` where nothing of the kind ended.
    """
    known = {cause: metrics[name] for cause, _ in RULES if (name := f"reward/{cause}") in metrics}
    hint = jnp.zeros(next(iter(known.values())).shape, jnp.int8)
    for cause, suggested in RULES:
        if cause in known:
            hint = jnp.where(known[cause] > 0, jnp.int8(suggested), hint)
    return hint


def spread(end_hint: jax.Array, weight: jax.Array) -> jax.Array:
    """Gives the hint of an end to the steps before it, within one rollout.

    The step that ends gets none from its own end. Episodes don't matter, as in Roach's code: the
    100 steps may reach into the episode before. Of several ends that a step is near the last one
    counts. Restart steps are no steps and not counted.

    Args:
      end_hint: (T, B) int8, of `of_end`.
      weight: (T, B) float32, 0 on restart steps.

    Returns:
      (T, B) int8 hints.
    """
    return jax.vmap(_spread_one, in_axes=1, out_axes=1)(end_hint, weight)


def _spread_one(end_hint: jax.Array, weight: jax.Array) -> jax.Array:
    """`spread` for one environment, (T,)."""
    row = jnp.arange(end_hint.shape[0])
    last_end = jax.lax.cummax(jnp.where(end_hint != NONE, row, -1))  # up to each row
    step = jnp.cumsum(weight)  # number of each row's step; a restart row has that of the end
    reach = jnp.searchsorted(step, step + NUM_STEPS, side="right") - 1  # the last row within 100
    end = last_end[reach]
    return jnp.where(end > row, end_hint[end], NONE).astype(jnp.int8)


def divergence(alpha: jax.Array, beta_: jax.Array, hint: jax.Array) -> jax.Array:
    """Returns how far the policy is from what is hinted at.

    Args:
      alpha: (N, 2) float32 of the policy; steering first, then throttle or brake.
      beta_: (N, 2) float32.
      hint: (N,) int8.

    Returns:
      (N,) float32, KL(policy || target) of the hinted actions, 0 for the others, mean over both.
    """
    target_alpha, target_beta = jnp.asarray(_ALPHA)[hint], jnp.asarray(_BETA)[hint]
    kl = beta.kl(alpha, beta_, target_alpha, target_beta)
    return jnp.mean(jnp.where(jnp.asarray(_IS_HINTED)[hint], kl, 0.0), axis=-1)
