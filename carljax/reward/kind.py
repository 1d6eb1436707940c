"""What a reward is made of: two functions, and the names of what they give."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Literal, Protocol

import jax

from carljax.sim.bicycle import VehicleParams
from carljax.sim.types import Agents, EgoState, RewardState, RewardTerms, SimState, Situation

if TYPE_CHECKING:
    from carljax.reward.config import RewardConfig


class Init(Protocol):
    """Makes what a reward remembers at the start of a route."""

    def __call__(self, ego: EgoState, num_stop_lines: int) -> RewardState:
        """From the ego at the start and the places for the route's stop lines."""


class Compute(Protocol):
    """Makes the reward of one step."""

    def __call__(
        self,
        before: SimState,
        ego: EgoState,
        agents: Agents,
        situation: Situation,
        vehicle: VehicleParams,
        config: RewardConfig,
        dt: float,
    ) -> tuple[jax.Array, jax.Array, RewardState, RewardTerms]:
        """See `reward.compute`."""


@dataclasses.dataclass(frozen=True)
class Reward:
    """One reward: all that `reward` has to know of it.

    Attributes:
      init: makes its memory.
      compute: makes its value.
      added: names of its summands.
      soft: names of its factors in [0, 1].
      causes: names of what ends an episode.
      at_finish: what the end of the route does to the episode: it terminates (nothing is left to
        earn), truncates (the task would go on) or goes on (pay goes on as well).
    """

    init: Init
    compute: Compute
    added: tuple[str, ...]
    soft: tuple[str, ...]
    causes: tuple[str, ...]
    at_finish: Literal["terminates", "truncates", "goes on"]

    @property
    def ends(self) -> tuple[str, ...]:
        """Names of all that an episode may end with."""
        return (*self.causes, "finished", "timeout")

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of all that is logged of a step."""
        return (*self.added, *self.soft, *self.ends, "penalty")
