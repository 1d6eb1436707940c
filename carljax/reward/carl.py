"""The CaRL reward: progress * product of soft factors - terminal penalty.

Composition only; each term is a file of its name. Source: paper, section Optimizing a Single Reward
and appendix Reward.
"""

from __future__ import annotations

import functools
import operator
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from carljax.reward import (
    blocked,
    collision,
    comfort,
    lane,
    off_road,
    outside_lanes,
    route_completion,
    route_deviation,
    speed_limit,
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
CAUSES = ("collision", "off_road", "red_light", "stop_sign", "route_deviation", "blocked")


def compute(
    before: SimState,
    ego: EgoState,
    agents: Agents,
    situation: Situation,
    vehicle: VehicleParams,
    config: RewardConfig,
    dt: float,
) -> tuple[jax.Array, jax.Array, RewardState, RewardTerms]:
    """The reward of one step; see `reward.compute`.

    The increment of route completion is paid on the step that ends the episode too; the terminal
    penalty is not scaled by the soft factors.
    """
    memory, terminated = _causes(before, ego, agents, situation, vehicle, config, dt)
    memory, soft = _soft_factors(memory, ego, agents, situation, vehicle, config, dt)
    increment = (
        route_completion.rounded_increment if config.round_progress else route_completion.increment
    )
    progress = increment(before.reward_state.route_s, memory.route_s, situation.route_length)
    penalised = terminated["collision"] | terminated["red_light"]
    terms = RewardTerms(
        added={"progress": progress},
        soft=soft,
        terminated=terminated,
        finished=route_completion.is_finished(situation.route_idx, situation.route_num_points),
        timeout=timeout.is_timeout(before.step_count + 1, config.time_limit_s, dt),
        penalty=penalised * jnp.asarray(config.terminal_penalty, jnp.float32),
    )
    reward = progress * functools.reduce(operator.mul, soft.values()) - terms.penalty
    ends = functools.reduce(operator.or_, terminated.values())
    return reward, ends, memory, terms


def _causes(
    before: SimState,
    ego: EgoState,
    agents: Agents,
    situation: Situation,
    vehicle: VehicleParams,
    config: RewardConfig,
    dt: float,
) -> tuple[RewardState, dict[str, jax.Array]]:
    """What ends the episode, by the names of `CAUSES`, and the memory with what that needs."""
    old = before.reward_state
    memory, ran_light, ran_sign = remembered.advance(before, ego, situation, vehicle, config, dt)
    far = route_deviation.far_advance(
        old.far_from_route_m,
        memory.route_s - old.route_s,
        situation.route_distance,
        config.deviation_far,
    )
    causes = {
        "collision": collision.collided(ego, agents, vehicle, config.z_gap),
        "off_road": off_road.is_off_road(situation.off_road_frac, config.off_road_frac),
        "red_light": ran_light,
        "stop_sign": ran_sign,
        "route_deviation": route_deviation.has_deviated(
            situation.route_distance,
            config.deviation_distance,
            far,
            config.deviation_far_frac * situation.route_length,
        ),
        "blocked": blocked.is_blocked(memory.stopped_s, config.blocked_s, dt),
    }
    return memory.replace(far_from_route_m=far), causes


def _soft_factors(
    memory: RewardState,
    ego: EgoState,
    agents: Agents,
    situation: Situation,
    vehicle: VehicleParams,
    config: RewardConfig,
    dt: float,
) -> tuple[RewardState, dict[str, jax.Array]]:
    """The factors by the names of `SOFT_FACTORS`, and the memory with their timers."""
    forecast = ttc.forecast_arc if config.ttc_forecast == "arc" else ttc.forecast_straight
    ttc_violated = ttc.violated(ego, agents, vehicle, forecast, config.ttc_min_speed, config.z_gap)
    ttc_ticks = timer.tick(memory.ttc_ticks, ttc_violated, config.ttc_ticks)
    history = comfort.push(memory.history, ego)
    uncomfortable = comfort.violated(history, comfort.LIMITS[config.comfort_limits], dt)
    comfort_ticks = timer.tick(memory.comfort_ticks, uncomfortable, config.comfort_ticks)
    is_outside = outside_lanes.is_off_lanes(
        situation.lane_lateral,
        situation.lane_width,
        situation.on_parking,
        config.outside_lanes_margin,
    ) | outside_lanes.is_wrong_way(
        ego.yaw, situation.lane_yaw, situation.lane_in_junction, config.wrong_way_angle
    )
    soft = {
        "outside_lanes": outside_lanes.factor(is_outside),
        "lane": lane.factor(
            situation.lane_lateral, situation.lane_width, situation.lane_in_junction
        ),
        "speed_limit": speed_limit.factor(ego.speed, situation.speed_limit, config.speeding_range),
        "ttc": ttc.factor(ttc_ticks, config.ttc_factor),
        "comfort": comfort.factor(comfort_ticks, config.comfort_weight),
    }
    memory = memory.replace(history=history, ttc_ticks=ttc_ticks, comfort_ticks=comfort_ticks)
    return memory, soft


REWARD = Reward(
    init=remembered.init,
    compute=compute,
    added=("progress",),
    soft=SOFT_FACTORS,
    causes=CAUSES,
    at_finish="terminates",
)
