"""The PPO loss: clipped surrogate, clipped value loss, entropy bonus.

Source: Schulman et al., Proximal policy optimization algorithms (2017), eq. 7 and 9; the value
clip and the half before the squared error as in the CaRL paper's trainer. Where Roach's trainer
differs, an option of `PPOConfig` says so.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from carljax.ppo import beta, hints
from carljax.ppo.config import PPOConfig
from carljax.ppo.networks import ActorCritic, forward
from carljax.ppo.types import Minibatch


def loss(
    params: Any, network: ActorCritic, minibatch: Minibatch, config: PPOConfig
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Computes policy_loss - ent_coef * entropy bonus + vf_coef * value_loss, and hints' part.

    All means are sums weighted by `minibatch.weight`, which sums to 1 over the whole minibatch: the
    losses of its pieces, and their gradients, add up.

    Args:
      params: variables of the network.
      network: actor and critic.
      minibatch: (N,) samples or a piece of them.
      config: clip ranges and coefficients.

    Returns:
      () loss and {name: ()} its parts (of the entropy always the sum over the action's dimensions),
      approx_kl (Schulman's estimator (r - 1) - log r) and clip_frac, the share of samples whose
      ratio left the clip range. With `minibatch.policy` also kl, KL(old || new) itself, mean over
      the action's dimensions; with `minibatch.hint` hint_loss.
    """
    alpha, beta_, value = forward(network, params, minibatch.obs)
    log_prob = beta.log_prob(minibatch.action, alpha, beta_)
    log_ratio = log_prob - minibatch.log_prob
    ratio = jnp.exp(log_ratio)
    weight = minibatch.weight
    policy_loss = jnp.sum(weight * surrogate(ratio, minibatch.advantage, config.clip_coef))
    error = value_error if config.vloss_half else squared_error
    value_loss = jnp.sum(
        weight * error(value, minibatch.value, minibatch.target, config.clip_vloss)
    )
    entropy = jnp.sum(weight * beta.entropy(alpha, beta_))
    bonus = entropy if config.entropy_reduction == "sum" else entropy / alpha.shape[-1]
    total = policy_loss - config.ent_coef * bonus + config.vf_coef * value_loss
    outside = jnp.abs(ratio - 1.0) > config.clip_coef
    parts = {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "entropy": entropy,
        "approx_kl": jnp.sum(weight * (ratio - 1.0 - log_ratio)),
        "clip_frac": jnp.sum(weight * outside),
    }
    if minibatch.hint is not None:
        parts["hint_loss"] = jnp.sum(weight * hints.divergence(alpha, beta_, minibatch.hint))
        total += config.hint_coef * parts["hint_loss"]
    if minibatch.policy is not None:
        kl = jnp.mean(beta.kl(*minibatch.policy, alpha, beta_), axis=-1)
        parts["kl"] = jnp.sum(weight * kl)
    return total, jax.lax.stop_gradient(parts)


def surrogate(ratio: jax.Array, advantage: jax.Array, clip_coef: float) -> jax.Array:
    """Returns max(-A r, -A clip(r, 1 - c, 1 + c)) elementwise."""
    clipped = jnp.clip(ratio, 1.0 - clip_coef, 1.0 + clip_coef)
    return jnp.maximum(-advantage * ratio, -advantage * clipped)


def value_error(
    value: jax.Array, old_value: jax.Array, target: jax.Array, clip: float | None
) -> jax.Array:
    """Returns half of `squared_error`."""
    return 0.5 * squared_error(value, old_value, target, clip)


def squared_error(
    value: jax.Array, old_value: jax.Array, target: jax.Array, clip: float | None
) -> jax.Array:
    """Returns the squared error, the larger of that of the value and of the clipped value.

    Args:
      value: (N,) the critic's estimate now.
      old_value: (N,) its estimate at collection.
      target: (N,) return.
      clip: range around `old_value`; None for the plain error.

    Returns:
      (N,) float32.
    """
    error = jnp.square(value - target)
    if clip is not None:
        clipped = old_value + jnp.clip(value - old_value, -clip, clip)
        error = jnp.maximum(error, jnp.square(clipped - target))
    return error
