"""One PPO update: epochs x minibatches as two scans, inside `shard_map` over the axis "data".

Each device shuffles its own share of the batch; statistics, gradients and metrics are those of the
minibatch of all devices together. Gradients are those of a device's own samples, added up once per
minibatch by an explicit `psum` outside of what is differentiated. That needs `shard_map` without
`check_vma` (see `trainer.make_train_step`): with it, gradients of replicated parameters come out
summed already, once per micro-batch, and the `psum` would count them again.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax

from carljax.ppo import hints, kl_patience, pieces
from carljax.ppo.config import PPOConfig
from carljax.ppo.loss import loss
from carljax.ppo.networks import ActorCritic
from carljax.ppo.types import Minibatch, Transition
from carljax.sim.types import Observation

AXIS = "data"

Recall = Callable[[Any], Observation]  # from what is kept of (M,) observations to these


def as_kept(obs: Observation) -> Observation:
    """Returns observations that are kept as they are."""
    return obs


def make_optimizer(config: PPOConfig) -> optax.GradientTransformation:
    """Builds gradient clipping and Adam; the learning rate is applied by `update`."""
    clip = optax.clip_by_global_norm(config.max_grad_norm)
    return optax.chain(clip, optax.scale_by_adam(eps=config.adam_eps))


def learning_rate(update: jax.Array, config: PPOConfig) -> jax.Array:
    """Returns () lr (1 - u / N) for update u, or lr; see `PPOConfig.lr_schedule`."""
    rate = jnp.float32(config.learning_rate)
    if not config.anneal_lr:
        return rate
    if config.lr_schedule == "late":
        update = update - 1
    return rate * jnp.maximum(1.0 - update.astype(jnp.float32) / config.num_updates, 0.0)


def flatten(batch: Transition, advantage: jax.Array) -> Minibatch:
    """Joins time and environments to one axis of samples; the weights stay 0 or 1.

    Before that, while time is an axis, hints are spread over the steps that they are for.
    """
    samples = Minibatch(
        obs=batch.obs,
        action=batch.action,
        log_prob=batch.log_prob,
        value=batch.value,
        advantage=advantage,
        target=advantage + batch.value,
        weight=batch.weight,
        policy=batch.policy,
        hint=None if batch.hint is None else hints.spread(batch.hint, batch.weight),
    )
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), samples)


def update(
    params: Any,
    opt_state: Any,
    samples: Minibatch,
    key: jax.Array,
    rate: jax.Array,
    network: ActorCritic,
    config: PPOConfig,
    recall: Recall = as_kept,
) -> tuple[Any, Any, dict[str, jax.Array]]:
    """Runs all epochs on one batch.

    Args:
      params: variables of the network, the same on every device.
      opt_state: likewise.
      samples: (N,) this device's samples, from `flatten`.
      key: PRNG key of this device's shuffles.
      rate: () learning rate.
      network: actor and critic.
      config: see `PPOConfig`.
      recall: makes observations of what the samples keep of them, see `obs_storage`.

    Returns:
      Parameters, optimiser state and {name: ()} means over all gradient steps of the loss's metrics
      and of grad_norm (before clipping); with KL patience see `kl_patience.run_epochs`.
    """
    optimizer = make_optimizer(config)
    num_samples = samples.weight.shape[0]
    later = later_advantage(samples, config)

    def gradient_step(
        samples: Minibatch, carry: tuple, rows: jax.Array
    ) -> tuple[tuple, dict[str, jax.Array]]:
        params, opt_state = carry
        grads, metrics = minibatch_gradient(params, samples, rows, network, config, recall)
        squares = [jnp.sum(jnp.square(grad)) for grad in jax.tree.leaves(grads)]
        metrics["grad_norm"] = jnp.sqrt(sum(squares))
        direction, opt_state = optimizer.update(grads, opt_state)
        params = jax.tree.map(lambda p, d: p - rate * d, params, direction)
        return (params, opt_state), metrics

    def epoch(
        carry: tuple, number_and_key: tuple[jax.Array, jax.Array]
    ) -> tuple[tuple, dict[str, jax.Array]]:
        number, key = number_and_key
        seen = samples.replace(advantage=jnp.where(number == 0, samples.advantage, later))
        rows = jax.random.permutation(key, num_samples).reshape(config.num_minibatches, -1)
        return jax.lax.scan(functools.partial(gradient_step, seen), carry, rows)

    epochs = (
        jnp.arange(config.update_epochs),
        jax.random.split(key, config.update_epochs),
    )
    learner = (params, opt_state)
    if config.kl_patience is not None:
        learner, metrics = kl_patience.run_epochs(epoch, learner, epochs, config.target_kl)
        return *learner, metrics
    learner, metrics = jax.lax.scan(epoch, learner, epochs)
    return *learner, jax.tree.map(jnp.mean, metrics)


def later_advantage(samples: Minibatch, config: PPOConfig) -> jax.Array:
    """Returns (N,) the advantages of all epochs but the first; see `PPOConfig.norm_adv_scope`."""
    if config.norm_adv and config.norm_adv_scope == "late":
        return normalise(samples.advantage, samples.weight)
    return samples.advantage


def minibatch_gradient(
    params: Any,
    samples: Minibatch,
    rows: jax.Array,
    network: ActorCritic,
    config: PPOConfig,
    recall: Recall = as_kept,
) -> tuple[Any, dict[str, jax.Array]]:
    """Computes the gradient of the loss over one minibatch of all devices.

    Args:
      params: variables of the network.
      samples: (N,) this device's samples.
      rows: (M,) int32, those of them that are in the minibatch.
      network: actor and critic.
      config: see `PPOConfig`.
      recall: see `update`.

    Returns:
      Gradient and {name: ()} metrics, the same on every device.
    """
    weight = samples.weight[rows]
    advantage = samples.advantage[rows]
    if config.norm_adv and config.norm_adv_scope != "late":
        over = sum_over_devices if config.norm_adv_scope == "all" else no_sum
        advantage = normalise(advantage, weight, over)
    weight = weight / jnp.maximum(jax.lax.psum(jnp.sum(weight), AXIS), 1.0)

    def piece(rows: jax.Array, weight: jax.Array, advantage: jax.Array) -> tuple[Any, dict]:
        # Rows of the large images are gathered here, a cache-sized piece at a time.
        minibatch = jax.tree.map(lambda x: x[rows], samples)
        minibatch = minibatch.replace(obs=recall(minibatch.obs), weight=weight, advantage=advantage)
        return jax.grad(loss, has_aux=True)(params, network, minibatch, config)

    if config.micro_batch_size is None:
        total = piece(rows, weight, advantage)
    else:
        total = pieces.sum_over(piece, config.micro_batch_size, rows, weight, advantage)
    return jax.lax.psum(total, AXIS)


def sum_over_devices(x: jax.Array) -> jax.Array:
    """Adds up a device's number with those of the others."""
    return jax.lax.psum(x, AXIS)


def no_sum(x: jax.Array) -> jax.Array:
    """Leaves a device's number as it is."""
    return x


def normalise(
    advantage: jax.Array,
    weight: jax.Array,
    total: Callable[[jax.Array], jax.Array] = sum_over_devices,
) -> jax.Array:
    """Shifts and scales advantages to mean 0 and (Bessel-corrected) deviation 1.

    Args:
      advantage: (M,) float32.
      weight: (M,) float32, 0 for samples that don't count.
      total: `sum_over_devices`, or `no_sum` for the statistics of each device's own samples.

    Returns:
      (M,) float32.
    """
    count = total(jnp.sum(weight))
    mean = total(jnp.sum(weight * advantage)) / jnp.maximum(count, 1.0)
    squares = total(jnp.sum(weight * jnp.square(advantage - mean)))
    deviation = jnp.sqrt(squares / jnp.maximum(count - 1.0, 1.0))
    return (advantage - mean) / (deviation + 1e-8)  # source: CaRL's trainer


def explained_variance(samples: Minibatch) -> jax.Array:
    """Returns () 1 - Var(target - value) / Var(target) over all devices; 0 for constant targets."""
    weight = samples.weight / jnp.maximum(jax.lax.psum(jnp.sum(samples.weight), AXIS), 1.0)

    def variance(x: jax.Array) -> jax.Array:
        mean = jax.lax.psum(jnp.sum(weight * x), AXIS)
        return jax.lax.psum(jnp.sum(weight * jnp.square(x - mean)), AXIS)

    total = variance(samples.target)
    explained = 1.0 - variance(samples.target - samples.value) / jnp.maximum(total, 1e-12)
    return jnp.where(total > 1e-12, explained, jnp.float32(0.0))
