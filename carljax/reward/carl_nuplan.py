"""The CaRL reward for nuPlan: regular, and mixed with pay for survival.

As `carl`, with other ends (collision in motion and off road alone), nothing gained on the step that
ends the episode, room about the lane's centre, stricter comfort, and penalties that hold until the
episode's end. Percent are the unit, so F = 100 of the authors' code is in the progress. Source:
paper, nuPlan Specific Adaptations.

Ours: an episode has the steps of its time limit (`RewardConfig.time_limit_s`, 15 s in nuPlan). The
code filters the whole episode anew at each step, which can take a violation of comfort back; here
what the newest sample shows is kept for good, as the paper says. Route polygons are lanes in the
route's direction not far from it. nuPlan's clip goes on after the route's end, and so does an
episode that pays for survival.
"""

from __future__ import annotations

import functools
import operator
from typing import TYPE_CHECKING, Literal

import jax
import jax.numpy as jnp
from flax import struct

from carljax.reward import (
    checks,
    collision,
    comfort,
    lane,
    off_road,
    outside_lanes,
    route_completion,
    speed_limit,
    survival,
    timeout,
    timer,
    ttc,
)
from carljax.reward import memory as remembered
from carljax.reward.kind import Reward
from carljax.sim.bicycle import VehicleParams
from carljax.sim.types import Agents, EgoState, RewardState, RewardTerms, SimState, Situation

if TYPE_CHECKING:
    from carljax.reward.config import RewardConfig

SOFT_FACTORS = ("outside_lanes", "lane", "speed_limit", "ttc", "comfort")
CAUSES = ("collision", "off_road")
FORECASTS = {"arc": ttc.forecast_arc, "straight": ttc.forecast_straight_second}


class CarlNuplanConfig(struct.PyTreeNode):
    """What the nuPlan rewards have of their own."""

    ttc_forecast: Literal["arc", "straight"] = struct.field(pytree_node=False, default="arc")
    """Forecast for time to collision up to 1.0 s: arcs of a kinematic bicycle, or the code's
    straight lines."""
    # source: paper, Soft Penalties (arc); the authors' code (straight)
    comfort_limits: Literal["carla", "nuplan"] = struct.field(pytree_node=False, default="nuplan")
    """Which column of the paper's table of comfort thresholds."""
    survival_ratio: float = 0.6
    """Share of the reward that is paid for survival, 0 to 1."""
    # source: paper, Survival Bonus; a file of the code has 0.2
    terminal_penalty: float = 1.0
    """Paid on a collision, in percent of a route."""
    # source: paper, Terminal Penalties; the authors' code has 0
    lane_room: float = 0.5
    """Distance from the lane's centre that costs nothing, m."""
    # source: paper, nuPlan Specific Adaptations
    lane_weight: float = 1.0
    """What is lost on the lane marking, 0 to 1."""
    # source: paper, nuPlan Specific Adaptations; 0.5 gives the code's floor of 0.5
    comfort_weight: float = 0.5
    """What is lost when all six comfort metrics are violated, 0 to 1."""
    # source: paper, Soft Penalties; 1 gives the code's factor passed / 6
    ttc_min_speed: float = 0.005
    """Ego speed below which there is no time to collision, m/s."""
    # source: the authors' code
    collision_min_speed: float = 0.05
    """Ego speed below which a collision is not its own, m/s."""
    # source: paper, nuPlan Specific Adaptations
    route_reach: float = 5.25
    """Distance from the route beyond which the ego is outside its lanes, m."""
    # source: ours; the route's lane and the one beside it, of 3.5 m each

    def __post_init__(self) -> None:
        """Refuses negative numbers and shares above 1."""
        checks.refuse_negative(self, "reward.carl_nuplan")
        shares = ("survival_ratio", "lane_weight", "comfort_weight")
        checks.refuse_above_one(self, "reward.carl_nuplan", *shares)


def compute(
    before: SimState,
    ego: EgoState,
    agents: Agents,
    situation: Situation,
    vehicle: VehicleParams,
    config: RewardConfig,
    dt: float,
) -> tuple[jax.Array, jax.Array, RewardState, RewardTerms]:
    """The regular reward of one step; see `reward.compute`."""
    memory, terminated, terms = judge(before, ego, agents, situation, vehicle, config, dt)
    return _regular(terms), terminated, memory, terms


def compute_with_survival(
    before: SimState,
    ego: EgoState,
    agents: Agents,
    situation: Situation,
    vehicle: VehicleParams,
    config: RewardConfig,
    dt: float,
) -> tuple[jax.Array, jax.Array, RewardState, RewardTerms]:
    """The reward of one step with its share for survival; see `reward.compute`.

    (1 - s) * regular + s * 100 / N. Neither the step that fails nor the one past the time limit is
    survived, so the bonus of a whole episode adds up to 100 s.
    """
    memory, terminated, terms = judge(before, ego, agents, situation, vehicle, config, dt)
    ratio = config.carl_nuplan.survival_ratio
    steps = survival.num_steps(config.time_limit_s, dt)
    bonus = survival.bonus(ratio, steps, ~(terminated | terms.timeout))
    terms = terms.replace(added={**terms.added, "survival": bonus})
    return (1.0 - ratio) * _regular(terms) + bonus, terminated, memory, terms


def _regular(terms: RewardTerms) -> jax.Array:
    soft = functools.reduce(operator.mul, terms.soft.values())
    return terms.added["progress"] * soft - terms.penalty


def judge(
    before: SimState,
    ego: EgoState,
    agents: Agents,
    situation: Situation,
    vehicle: VehicleParams,
    config: RewardConfig,
    dt: float,
) -> tuple[RewardState, jax.Array, RewardTerms]:
    """What the nuPlan rewards have in common: progress, factors and ends.

    Args:
      before: the state before the step.
      ego: the ego after the step.
      agents: the others after the step.
      situation: the ego's situation after the step.
      vehicle: the ego's box.
      config: numbers and options.
      dt: s.

    Returns:
      The memory after the step; terminated () bool; the terms.
    """
    numbers = config.carl_nuplan
    memory, _, _ = remembered.advance(before, ego, situation, vehicle, config, dt)
    causes = {
        "collision": collision.collided_in_motion(
            ego, agents, vehicle, config.z_gap, numbers.collision_min_speed
        ),
        "off_road": off_road.has_corner_off(situation.corner_off_road),
    }
    terminated = functools.reduce(operator.or_, causes.values())
    progress = route_completion.increment(
        before.reward_state.route_s, memory.route_s, situation.route_length
    )
    finished = route_completion.is_finished(situation.route_idx, situation.route_num_points)
    memory = _latch(memory, ego, agents, vehicle, config, dt)
    terms = RewardTerms(
        added={"progress": progress * ~terminated},
        soft=_soft_factors(memory, ego, situation, finished, config),
        terminated=causes,
        finished=finished,
        timeout=timeout.is_timeout(before.step_count + 1, config.time_limit_s, dt),
        penalty=causes["collision"] * jnp.asarray(numbers.terminal_penalty, jnp.float32),
    )
    return memory, terminated, terms


def _latch(
    memory: RewardState,
    ego: EgoState,
    agents: Agents,
    vehicle: VehicleParams,
    config: RewardConfig,
    dt: float,
) -> RewardState:
    """The memory with the penalties that hold until the episode's end."""
    numbers = config.carl_nuplan
    ttc_violated = ttc.violated(
        ego, agents, vehicle, FORECASTS[numbers.ttc_forecast], numbers.ttc_min_speed, config.z_gap
    )
    history = comfort.push(memory.history, ego)
    uncomfortable = comfort.violated(history, comfort.LIMITS[numbers.comfort_limits], dt)
    return memory.replace(
        history=history,
        ttc_ticks=timer.latch(memory.ttc_ticks, ttc_violated),
        comfort_ticks=timer.latch(memory.comfort_ticks, uncomfortable),
    )


def _soft_factors(
    memory: RewardState,
    ego: EgoState,
    situation: Situation,
    finished: jax.Array,
    config: RewardConfig,
) -> dict[str, jax.Array]:
    """The factors by the names of `SOFT_FACTORS`."""
    numbers = config.carl_nuplan
    nowhere_to_park = jnp.zeros((), bool)  # a car park is no part of the route
    is_outside = outside_lanes.is_off_lanes(
        situation.lane_lateral, situation.lane_width, nowhere_to_park, 0.0
    )
    is_outside |= outside_lanes.is_wrong_way(
        ego.yaw, situation.lane_yaw, situation.lane_in_junction, config.wrong_way_angle
    )
    is_outside |= (jnp.abs(situation.route_lateral) > numbers.route_reach) & ~finished
    return {
        "outside_lanes": outside_lanes.factor(is_outside),
        "lane": lane.factor_with_room(
            situation.lane_lateral,
            situation.lane_width,
            situation.lane_in_junction,
            numbers.lane_room,
            numbers.lane_weight,
        ),
        "speed_limit": speed_limit.factor(ego.speed, situation.speed_limit, config.speeding_range),
        "ttc": ttc.factor(memory.ttc_ticks, config.ttc_factor),
        "comfort": comfort.factor(memory.comfort_ticks, numbers.comfort_weight),
    }


REGULAR = Reward(
    init=remembered.init,
    compute=compute,
    added=("progress",),
    soft=SOFT_FACTORS,
    causes=CAUSES,
    at_finish="terminates",
)
SURVIVAL = Reward(
    init=remembered.init,
    compute=compute_with_survival,
    added=("progress", "survival"),
    soft=SOFT_FACTORS,
    causes=CAUSES,
    at_finish="goes on",
)
