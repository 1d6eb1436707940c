"""The rewards by name, and what the environment asks of whichever is chosen.

A reward is a file with a `kind.Reward` in it, a line in `REWARDS` and a name in `config`.
"""

from __future__ import annotations

import functools
import operator

import jax
import jax.numpy as jnp

from carljax.reward import carl, carl_nuplan, carl_nuplan_tuned, roach, think2drive
from carljax.reward.config import RewardConfig
from carljax.reward.kind import Reward
from carljax.sim.bicycle import VehicleParams
from carljax.sim.types import Agents, EgoState, RewardState, RewardTerms, SimState, Situation

REWARDS = {
    "carl": carl.REWARD,
    "carl-nuplan": carl_nuplan.REGULAR,
    "carl-nuplan-survival": carl_nuplan.SURVIVAL,
    "carl-nuplan-tuned": carl_nuplan_tuned.REWARD,
    "roach": roach.REWARD,
    "think2drive": think2drive.REWARD,
}


def chosen(config: RewardConfig) -> Reward:
    """The reward that a configuration names."""
    return REWARDS[config.name]


def init(ego: EgoState, num_stop_lines: int, config: RewardConfig) -> RewardState:
    """What the reward remembers at the start of a route.

    Args:
      ego: the ego at the start.
      num_stop_lines: Q, places for the route's stop lines.
      config: names the reward.

    Returns:
      Memory with nothing in it.
    """
    return chosen(config).init(ego, num_stop_lines)


def compute(
    before: SimState,
    ego: EgoState,
    agents: Agents,
    situation: Situation,
    vehicle: VehicleParams,
    config: RewardConfig,
    dt: float,
) -> tuple[jax.Array, jax.Array, RewardState, RewardTerms]:
    """The reward of one step.

    Args:
      before: the state before the step: its ego, its step count and the reward's memory are read.
      ego: the ego after the step.
      agents: the others after the step.
      situation: the ego's situation after the step.
      vehicle: the ego's box.
      config: the reward's name, numbers and options.
      dt: s.

    Returns:
      reward () float32; terminated () bool, by any cause that is a failure; the memory after the
      step; the terms.
    """
    paid, terminated, memory, terms = chosen(config).compute(
        before, ego, agents, situation, vehicle, config, dt
    )
    if config.timeout_terminates:
        terminated = terminated | terms.timeout
    return paid, terminated, memory, terms


def ending(
    terminated: jax.Array, terms: RewardTerms, config: RewardConfig
) -> tuple[jax.Array, jax.Array]:
    """How a step ends the episode.

    Args:
      terminated: of `compute`.
      terms: of `compute`.
      config: names the reward.

    Returns:
      Whether it ends for good, () bool, so that no value is bootstrapped; whether it is only cut
      off, () bool.
    """
    at_finish = chosen(config).at_finish
    stops = functools.reduce(operator.or_, terms.terminated.values()) | terms.timeout
    if at_finish != "goes on":
        stops = stops | terms.finished
    if at_finish == "terminates":
        terminated = terminated | terms.finished
    return terminated, stops & ~terminated


def metrics(terms: RewardTerms) -> dict[str, jax.Array]:
    """The terms as numbers to log.

    Args:
      terms: of `compute`.

    Returns:
      {"reward/<name>": () float32} for each name of `Reward.terms`: summands, soft factors, causes
      (0 or 1), the finish, the timeout and the penalty.
    """
    parts = {
        **terms.added,
        **terms.soft,
        **terms.terminated,
        "finished": terms.finished,
        "timeout": terms.timeout,
        "penalty": terms.penalty,
    }
    return {f"reward/{name}": value.astype(jnp.float32) for name, value in parts.items()}
