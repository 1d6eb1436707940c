"""The CaRL reward: progress * product of soft factors - terminal penalty.

Composition only; each term is a file of its name. Source: paper, section Optimizing a Single Reward
and appendix Reward.
"""

from __future__ import annotations

import functools
import operator

import jax
import jax.numpy as jnp

from carljax.reward import (
    blocked,
    collision,
    comfort,
    lane,
    off_road,
    outside_lanes,
    red_light,
    route_completion,
    route_deviation,
    speed_limit,
    stop_line,
    stop_sign,
    timeout,
    timer,
    ttc,
)
from carljax.reward.config import RewardConfig
from carljax.sim.bicycle import VehicleParams
from carljax.sim.types import Agents, EgoState, RewardState, RewardTerms, SimState, Situation

SOFT_FACTORS = ("outside_lanes", "lane", "speed_limit", "ttc", "comfort")
CAUSES = ("collision", "off_road", "red_light", "stop_sign", "route_deviation", "blocked")


def init(ego: EgoState, num_stop_lines: int) -> RewardState:
    """What the reward remembers at the start of a route.

    Args:
      ego: the ego at the start.
      num_stop_lines: Q, places for the route's stop lines.

    Returns:
      Memory with nothing in it.
    """
    unset = jnp.zeros(num_stop_lines, bool)
    return RewardState(
        history=comfort.empty_history(ego),
        route_s=jnp.float32(0.0),
        ttc_ticks=jnp.int32(0),
        comfort_ticks=jnp.zeros(len(comfort.METRICS), jnp.int32),
        stopped_s=jnp.float32(0.0),
        far_from_route_m=jnp.float32(0.0),
        stop_satisfied=unset,
        line_crossed=unset,
    )


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

    The increment of route completion is paid on the step that ends the episode too; the terminal
    penalty is not scaled by the soft factors.

    Args:
      before: the state before the step: its ego, its step count and the reward's memory are read.
      ego: the ego after the step.
      agents: the others after the step.
      situation: the ego's situation after the step.
      vehicle: the ego's box.
      config: numbers and options.
      dt: s.

    Returns:
      reward () float32; terminated () bool, any cause; the memory after the step; the terms.
    """
    memory, terminated = _causes(before, ego, agents, situation, vehicle, config, dt)
    memory, soft = _soft_factors(memory, ego, agents, situation, vehicle, config, dt)
    increment = (
        route_completion.rounded_increment if config.round_progress else route_completion.increment
    )
    progress = increment(before.reward_state.route_s, memory.route_s, situation.route_length)
    penalised = terminated["collision"] | terminated["red_light"]
    terms = RewardTerms(
        progress=progress,
        soft=soft,
        terminated=terminated,
        finished=route_completion.is_finished(situation.route_idx, situation.route_num_points),
        timeout=timeout.is_timeout(before.step_count + 1, config.time_limit_s, dt),
        penalty=penalised * jnp.asarray(config.terminal_penalty, jnp.float32),
    )
    reward = progress * functools.reduce(operator.mul, soft.values()) - terms.penalty
    ends = functools.reduce(operator.or_, terminated.values())
    if config.timeout_terminates:
        ends = ends | terms.timeout
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
    route_s = jnp.maximum(situation.route_s, old.route_s)
    stopped_s = blocked.standing_time(old.stopped_s, ego.speed, config.blocked_speed, dt)
    far = route_deviation.far_advance(
        old.far_from_route_m, route_s - old.route_s, situation.route_distance, config.deviation_far
    )
    memory, ran_light, ran_sign = _stop_lines(before, ego, situation, vehicle, config)
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
        "blocked": blocked.is_blocked(stopped_s, config.blocked_s, dt),
    }
    memory = memory.replace(route_s=route_s, stopped_s=stopped_s, far_from_route_m=far)
    return memory, causes


def _stop_lines(
    before: SimState,
    ego: EgoState,
    situation: Situation,
    vehicle: VehicleParams,
    config: RewardConfig,
) -> tuple[RewardState, jax.Array, jax.Array]:
    """The memory with the stop lines of this step; whether a red light, a stop sign was run."""
    old = before.reward_state
    reach = stop_line.in_reach(situation, config.line_range)
    halted = stop_sign.halted(ego, vehicle, situation, config.halt_speed)
    satisfied = old.stop_satisfied | (reach & halted)

    def crossed(tail_frac: jax.Array | float) -> jax.Array:
        distance = tail_frac * 0.5 * vehicle.length
        over = stop_line.crossed(before.ego, ego, distance, situation, config.line_lane_widths)
        return over & reach

    at_light = crossed(config.red_light_tail_frac) & ~old.line_crossed
    at_sign = crossed(config.stop_sign_tail_frac)
    forbidden = (
        red_light.ran_yellow_or_red_light if config.yellow_is_red else red_light.ran_red_light
    )
    ran_light = forbidden(at_light, situation.stop_kind, situation.stop_light)
    ran_sign = stop_sign.ran_stop_sign(at_sign, situation.stop_kind, satisfied)
    memory = old.replace(stop_satisfied=satisfied, line_crossed=old.line_crossed | at_light)
    return memory, ran_light, ran_sign


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


def metrics(terms: RewardTerms) -> dict[str, jax.Array]:
    """The terms as numbers to log.

    Args:
      terms: of `compute`.

    Returns:
      {"reward/<name>": () float32} for the progress, the soft factors, the causes (0 or 1), the
      finish, the timeout and the penalty.
    """
    parts = {
        "progress": terms.progress,
        **terms.soft,
        **terms.terminated,
        "finished": terms.finished,
        "timeout": terms.timeout,
        "penalty": terms.penalty,
    }
    return {f"reward/{name}": value.astype(jnp.float32) for name, value in parts.items()}
