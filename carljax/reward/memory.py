"""What every reward remembers: progress, standing time, stop lines passed and signs honoured.

The observation shows some of it, so it is kept up whether or not a reward makes use of it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from carljax.reward import blocked, comfort, red_light, stop_line, stop_sign
from carljax.sim.bicycle import VehicleParams
from carljax.sim.types import EgoState, RewardState, SimState, Situation

if TYPE_CHECKING:
    from carljax.reward.config import RewardConfig


def init(ego: EgoState, num_stop_lines: int) -> RewardState:
    """What a reward remembers at the start of a route.

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


def advance(
    before: SimState,
    ego: EgoState,
    situation: Situation,
    vehicle: VehicleParams,
    config: RewardConfig,
    dt: float,
) -> tuple[RewardState, jax.Array, jax.Array]:
    """The memory a step later, and what was run at stop lines.

    Args:
      before: the state before the step.
      ego: the ego after the step.
      situation: the ego's situation after the step.
      vehicle: the ego's box.
      config: numbers and options.
      dt: s.

    Returns:
      The memory with progress, standing time and stop lines of this step; whether a red light was
      run, () bool; whether a stop sign was, () bool.
    """
    old = before.reward_state
    memory, ran_light, ran_sign = _stop_lines(before, ego, situation, vehicle, config)
    memory = memory.replace(
        route_s=jnp.maximum(situation.route_s, old.route_s),
        stopped_s=blocked.standing_time(old.stopped_s, ego.speed, config.blocked_speed, dt),
    )
    return memory, ran_light, ran_sign


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
