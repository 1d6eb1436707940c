"""The CaRL reward tuned to nuPlan's score: its four weighted metrics, added instead of multiplied.

F * off_route * lane * (5 progress + 5 [ttc ok] / N + 4 speed / N + 2 [comfort ok] / N) / 16, and
nothing on the step that ends the episode. Terms and ends are those of `carl_nuplan`. Source: paper,
appendix nuPlan (the ratio 5:5:4:2); the authors' code (the formula). The paper recommends it for
nuPlan's score alone: who stands still earns three of the four.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from carljax.reward import carl_nuplan, survival
from carljax.reward import memory as remembered
from carljax.reward.kind import Reward
from carljax.sim.bicycle import VehicleParams
from carljax.sim.types import Agents, EgoState, RewardState, RewardTerms, SimState, Situation

if TYPE_CHECKING:
    from carljax.reward.config import RewardConfig

# source: nuPlan's closed-loop score
PROGRESS_WEIGHT, TTC_WEIGHT, SPEED_WEIGHT, COMFORT_WEIGHT = 5.0, 5.0, 4.0, 2.0
WEIGHTS = PROGRESS_WEIGHT + TTC_WEIGHT + SPEED_WEIGHT + COMFORT_WEIGHT
TOTAL = 100.0  # percentage points of a perfect episode. source: the authors' code, F


def compute(
    before: SimState,
    ego: EgoState,
    agents: Agents,
    situation: Situation,
    vehicle: VehicleParams,
    config: RewardConfig,
    dt: float,
) -> tuple[jax.Array, jax.Array, RewardState, RewardTerms]:
    """The tuned reward of one step; see `reward.compute`.

    Time to collision and comfort are logged as 1 or 0: kept so far or not.
    """
    memory, terminated, terms = carl_nuplan.judge(
        before, ego, agents, situation, vehicle, config, dt
    )
    kept = {
        "ttc": (memory.ttc_ticks == 0).astype(jnp.float32),
        "comfort": jnp.all(memory.comfort_ticks == 0).astype(jnp.float32),
    }
    soft = {**terms.soft, **kept}
    manners = (
        TTC_WEIGHT * soft["ttc"]
        + SPEED_WEIGHT * soft["speed_limit"]
        + COMFORT_WEIGHT * soft["comfort"]
    )
    steps = survival.num_steps(config.time_limit_s, dt)
    per_step = survival.bonus(manners, steps, ~(terminated | terms.timeout), TOTAL)
    gained = (PROGRESS_WEIGHT * terms.added["progress"] + per_step) / WEIGHTS
    paid = soft["outside_lanes"] * soft["lane"] * gained - terms.penalty
    return paid, terminated, memory, terms.replace(soft=soft)


REWARD = Reward(
    init=remembered.init,
    compute=compute,
    added=("progress",),
    soft=carl_nuplan.SOFT_FACTORS,
    causes=carl_nuplan.CAUSES,
    at_finish="goes on",
)
