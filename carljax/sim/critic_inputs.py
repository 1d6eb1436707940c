"""What observations read of the reward's memory, and nothing else does: one function each."""

from __future__ import annotations

import jax

from carljax.reward import comfort, ttc
from carljax.reward.config import RewardConfig
from carljax.sim.types import RewardState


def stop_satisfied(memory: RewardState) -> jax.Array:
    """(Q,) bool, the ego has halted at this stop sign."""
    return memory.stop_satisfied


def stopped_s(memory: RewardState) -> jax.Array:
    """() s the ego has stood still."""
    return memory.stopped_s


def ttc_ticks(memory: RewardState) -> jax.Array:
    """() int32, steps for which the TTC penalty still holds."""
    return memory.ttc_ticks


def comfort_ticks(memory: RewardState) -> jax.Array:
    """(6,) int32, likewise for each comfort metric."""
    return memory.comfort_ticks


def ttc_score(memory: RewardState, config: RewardConfig) -> jax.Array:
    """() in [0, 1], the factor by which time to collision scaled this step's reward."""
    return ttc.factor(memory.ttc_ticks, config.ttc_factor)


def comfort_score(memory: RewardState, config: RewardConfig) -> jax.Array:
    """() in [0, 1], the factor by which comfort scaled this step's reward."""
    return comfort.factor(memory.comfort_ticks, config.comfort_weight)
