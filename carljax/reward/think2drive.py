"""Think2Drive's reward as the CaRL paper reproduces it.

r = r_speed + r_travel + 2 p_deviation + 0.5 c_steer; on the step of a terminal reward that alone is
paid. Source: paper, Baselines. The paper does not say what c_steer is: ours is Roach's price of
moving the steering wheel, the one term of that purpose that has a source; `steer_weight` 0 leaves
it out. Actions are ours, continuous, where Think2Drive chooses among 30.
"""

from __future__ import annotations

import functools
import operator
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from flax import struct

from carljax.reward import (
    action,
    blocked,
    checks,
    collision,
    desired_speed,
    hazards,
    position,
    route_completion,
    terminal,
    timeout,
)
from carljax.reward import memory as remembered
from carljax.reward.kind import Reward
from carljax.sim.bicycle import VehicleParams
from carljax.sim.types import (
    LIGHT_RED,
    STOP_LIGHT,
    Agents,
    EgoState,
    RewardState,
    RewardTerms,
    SimState,
    Situation,
)

if TYPE_CHECKING:
    from carljax.reward.config import RewardConfig

CAUSES = ("collision", "red_light", "stop_sign", "route_deviation", "blocked")
VIOLATIONS = ("collision", "red_light", "stop_sign")  # cost the speed too
FAILURES = (*VIOLATIONS, "route_deviation")  # being blocked only cuts the episode off


class Think2DriveConfig(struct.PyTreeNode):
    """What Think2Drive's reward has of its own."""

    speed_span: float = 7.5
    """Difference to the desired speed that costs 1, m/s."""
    # source: paper, Baselines
    limit_frac: float = 0.8
    """Free speed as a fraction of the speed limit."""
    # source: paper, Baselines
    vehicle_margin: float = 8.0
    """Distance to a vehicle on the route at which to stand, m."""
    # source: paper, Baselines
    light_margin: float = 4.0
    """Distance to a red light's line at which to stand, m."""
    # source: paper, Baselines
    stop_sign_margin: float = 2.5
    """Distance to a stop sign's line at which to stand, m."""
    # source: paper, Baselines
    span: float = 12.5
    """Distance over which the desired speed falls, m."""
    # source: paper, Baselines
    deviation_span: float = 8.0
    """Distance from the route that costs 1, m."""
    # source: paper, Baselines
    deviation_weight: float = 2.0
    """Weight of that cost."""
    # source: paper, Baselines
    steer_weight: float = 0.5
    """Weight of the cost of steering."""
    # source: paper, Baselines
    steer_threshold: float = 0.01
    """Change of steering beyond which it costs."""
    # source: ours, Roach's number: the paper does not define the term
    steer_price: float = 0.1
    """What it costs, before the weight."""
    # source: ours, Roach's number: the paper does not define the term
    deviation_distance: float = 15.0
    """Distance from the route beyond which the episode ends, m."""
    # source: paper, Baselines
    blocked_s: float = 100.0
    """Longest time the ego may stand, s."""
    # source: paper, Baselines
    goal_distance: float = 10.0
    """Distance to the goal at which the route is finished, m."""
    # source: paper, Baselines
    goal_bonus: float = 1.0
    """Paid there."""
    # source: paper, Baselines

    def __post_init__(self) -> None:
        """Refuses negative numbers and divisions by zero."""
        checks.refuse_negative(self, "reward.think2drive")
        spans = ("speed_span", "span", "deviation_span")
        checks.refuse_zero(self, "reward.think2drive", *spans)


def compute(
    before: SimState,
    ego: EgoState,
    agents: Agents,
    situation: Situation,
    vehicle: VehicleParams,
    config: RewardConfig,
    dt: float,
) -> tuple[jax.Array, jax.Array, RewardState, RewardTerms]:
    """The reward of one step; see `reward.compute`."""
    numbers = config.think2drive
    memory, causes = _causes(before, ego, agents, situation, vehicle, config, dt)
    terminated = functools.reduce(operator.or_, (causes[name] for name in FAILURES))
    violated = functools.reduce(operator.or_, (causes[name] for name in VIOLATIONS))
    finished = route_completion.is_near_goal(
        situation.route_s, situation.route_length, numbers.goal_distance
    )
    terms = RewardTerms(
        added={
            **_shaping(before, ego, agents, situation, memory, config),
            "goal": jnp.asarray(numbers.goal_bonus, jnp.float32) * (finished & ~terminated),
        },
        soft={},
        terminated=causes,
        finished=finished,
        timeout=timeout.is_timeout(before.step_count + 1, config.time_limit_s, dt),
        penalty=terminal.penalty(terminated, violated, ego.speed),
    )
    shaped = functools.reduce(
        operator.add, (value for name, value in terms.added.items() if name != "goal")
    )
    at_end = terms.added["goal"] - terms.penalty
    paid = jnp.where(terminated | finished, at_end, shaped)
    return paid, terminated, memory, terms


def _shaping(
    before: SimState,
    ego: EgoState,
    agents: Agents,
    situation: Situation,
    memory: RewardState,
    config: RewardConfig,
) -> dict[str, jax.Array]:
    """The weighted summands of a step that ends nothing."""
    numbers = config.think2drive
    desired = target_speed(ego, agents, situation, memory.stop_satisfied, config)
    moved = ego.xy - before.ego.xy
    steering = action.penalty(
        before.ego.steer, ego.steer, numbers.steer_threshold, numbers.steer_price
    )
    deviation = position.penalty(situation.route_lateral, numbers.deviation_span)
    return {
        "speed": desired_speed.match(ego.speed, desired, numbers.speed_span),
        "travel": jnp.hypot(moved[0], moved[1]),
        "deviation": numbers.deviation_weight * deviation,
        "steer": numbers.steer_weight * steering,
    }


def target_speed(
    ego: EgoState,
    agents: Agents,
    situation: Situation,
    stop_satisfied: jax.Array,
    config: RewardConfig,
) -> jax.Array:
    """The speed that the rule asks for: the least that limit and hazards leave.

    Args:
      ego: the ego.
      agents: (N,) the others.
      situation: the ego's situation, its look-ups of the others included.
      stop_satisfied: (Q,) bool, the ego has halted at that sign.
      config: numbers.

    Returns:
      () m/s.
    """
    numbers = config.think2drive
    is_red = (situation.stop_kind == STOP_LIGHT) & (situation.stop_light == LIGHT_RED)
    gap = situation.others.route_gap
    distances = [
        (hazards.vehicle_on_route(ego, agents, gap, config.z_gap), numbers.vehicle_margin),
        (
            hazards.light(ego, 0.0, situation, is_red, config.line_range, config.line_range),
            numbers.light_margin,
        ),
        (
            hazards.stop_sign(ego, situation, stop_satisfied, config.line_range),
            numbers.stop_sign_margin,
        ),
    ]
    free = numbers.limit_frac * situation.speed_limit
    speeds = [
        desired_speed.approaching(distance, margin, numbers.span, free)
        for distance, margin in distances
    ]
    return functools.reduce(jnp.minimum, speeds)  # without a hazard each of them is the free speed


def _causes(
    before: SimState,
    ego: EgoState,
    agents: Agents,
    situation: Situation,
    vehicle: VehicleParams,
    config: RewardConfig,
    dt: float,
) -> tuple[RewardState, dict[str, jax.Array]]:
    """What ends the episode, by the names of `CAUSES`, and the memory after the step."""
    numbers = config.think2drive
    memory, ran_light, ran_sign = remembered.advance(before, ego, situation, vehicle, config, dt)
    causes = {
        "collision": collision.collided(ego, agents, vehicle, config.z_gap),
        "red_light": ran_light,
        "stop_sign": ran_sign,
        "route_deviation": situation.route_distance > numbers.deviation_distance,
        "blocked": blocked.is_blocked(memory.stopped_s, numbers.blocked_s, dt),
    }
    return memory, causes


REWARD = Reward(
    init=remembered.init,
    compute=compute,
    added=("speed", "travel", "deviation", "steer", "goal"),
    soft=(),
    causes=CAUSES,
    at_finish="truncates",
)
