"""Generalised advantage estimation over a rollout that restarts in place.

Source: Schulman et al., High-dimensional continuous control using GAE (2016), eq. 16.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp


def gae(
    reward: jax.Array,
    value: jax.Array,
    last_value: jax.Array,
    terminated: jax.Array,
    weight: jax.Array,
    gamma: float,
    gae_lambda: float,
) -> jax.Array:
    """Computes A_t = sum_k (gamma lambda)^k delta_{t+k} within each episode.

    delta_t = r_t + gamma (1 - terminated_t) V_{t+1} - V_t. With next-step autoreset the step after
    an episode's end still shows its final observation, so V_{t+1} is the value to bootstrap from.
    That step has weight 0, its own advantage is 0 and nothing flows past it into the earlier
    episode.

    Args:
      reward: (T, B) float32.
      value: (T, B) float32, V of the observation before each step.
      last_value: (B,) float32, V of the observation after the last step.
      terminated: (T, B) float32, 1 where nothing more is to be earned after the step.
      weight: (T, B) float32, 0 on restart steps.
      gamma: discount.
      gae_lambda: decay.

    Returns:
      (T, B) float32 advantages, 0 on restart steps.
    """
    next_value = jnp.concatenate([value[1:], last_value[None]])
    delta = reward + gamma * (1.0 - terminated) * next_value - value

    def step(later: jax.Array, now: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        delta_t, weight_t = now
        advantage = weight_t * (delta_t + gamma * gae_lambda * later)
        return advantage, advantage

    _, advantage = jax.lax.scan(step, jnp.zeros_like(last_value), (delta, weight), reverse=True)
    return advantage
