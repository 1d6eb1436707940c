"""KL patience: how far the policy moves decides when an update ends and the learning rate falls.

After each epoch the mean KL(old policy || new policy) of its minibatches is looked at. Above a
target the update ends there, and that counts; at a number of such updates the learning rate is
halved and the count begins again. It never rises. Source: Roach (Zhang et al. 2021), its trainer.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

KL = "kl"  # the metric that decides

Epoch = Callable[[Any, Any], tuple[Any, dict[str, jax.Array]]]


class KLPatience(struct.PyTreeNode):
    """What is remembered from update to update.

    Attributes:
      rate_scale: () float32, the learning rate's factor so far.
      num_stops: () int32, updates that ended above the target since it was last halved.
    """

    rate_scale: jax.Array
    num_stops: jax.Array


def start() -> KLPatience:
    """Returns full rate and no stops."""
    return KLPatience(jnp.ones((), jnp.float32), jnp.zeros((), jnp.int32))


def advance(memory: KLPatience, exceeded: jax.Array, patience: int) -> KLPatience:
    """Counts an update, and halves the learning rate if it was one too many.

    Args:
      memory: before the update.
      exceeded: () bool, its last epoch was above the target.
      patience: stops at which the rate is halved.

    Returns:
      The memory for the next update.
    """
    num_stops = memory.num_stops + exceeded.astype(jnp.int32)
    is_over = num_stops >= patience
    return KLPatience(
        rate_scale=jnp.where(is_over, 0.5 * memory.rate_scale, memory.rate_scale),
        num_stops=jnp.where(is_over, 0, num_stops),
    )


def run_epochs(
    epoch: Epoch, learner: Any, epochs: Any, target_kl: float
) -> tuple[Any, dict[str, jax.Array]]:
    """Runs epochs until one is above the target; that one is made to its end.

    Args:
      epoch: epoch(learner, x) -> (learner, {name: (steps,)}), `KL` among the names.
      learner: parameters and optimiser state.
      epochs: a pytree with an axis (E,) in front, E epochs at most: x of each of them.
      target_kl: the target.

    Returns:
      The learner, and {name: ()} means over all gradient steps made; `KL` is the mean over the last
      epoch, and "epochs" their number.
    """
    most = jax.tree.leaves(epochs)[0].shape[0]

    def pick(number: int | jax.Array) -> Any:
        return jax.tree.map(lambda x: x[number], epochs)

    def goes_on(carry: tuple) -> jax.Array:
        number, _, _, kl = carry
        return (number < most) & ~(kl > target_kl)

    def another(carry: tuple) -> tuple:
        number, learner, sums, _ = carry
        learner, metrics = epoch(learner, pick(number))
        means = jax.tree.map(jnp.mean, metrics)
        return number + 1, learner, jax.tree.map(jnp.add, sums, means), means[KL]

    names = jax.eval_shape(epoch, learner, pick(0))[1]
    sums = {name: jnp.zeros((), jnp.float32) for name in names}
    first = (jnp.zeros((), jnp.int32), learner, sums, jnp.full((), -jnp.inf, jnp.float32))
    number, learner, sums, kl = jax.lax.while_loop(goes_on, another, first)
    count = number.astype(jnp.float32)
    return learner, {name: x / count for name, x in sums.items()} | {KL: kl, "epochs": count}
