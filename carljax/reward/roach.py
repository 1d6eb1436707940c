"""Roach's reward: nearness to a rule's speed, to the route and to its direction, added up.

r = r_speed + r_position + r_rotation + r_action + r_terminal, with the numbers of Zhang et al.,
End-to-End Urban Driving by Imitating a Reinforcement Learning Coach (2021); those of the CaRL
paper's reproduction are said beside them. Roach's routes have no end, so a finished route cuts the
episode off. r_action looks at the steering that the car was given.
"""

from __future__ import annotations

import functools
import math
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
    lateral_distance,
    pedestrian_overlap,
    position,
    rotation,
    route_completion,
    terminal,
    timeout,
)
from carljax.reward import memory as remembered
from carljax.reward.kind import Reward
from carljax.sim.bicycle import VehicleParams
from carljax.sim.types import (
    LIGHT_GREEN,
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

CAUSES = (
    "collision",
    "pedestrian_overlap",
    "red_light",
    "stop_sign",
    "lateral_distance",
    "blocked",
)
VIOLATIONS = ("collision", "pedestrian_overlap", "red_light", "stop_sign")  # cost the speed too


class RoachConfig(struct.PyTreeNode):
    """What Roach's reward has of its own."""

    charge_every_end: bool = struct.field(pytree_node=False, default=False)
    """Pay 1 at the end of the route and at the time limit too, as the CaRL paper's reproduction
    does."""
    max_speed: float = 6.0
    """Free speed, and difference to the desired speed that costs 1, m/s."""
    # source: Roach
    vehicle_margin: float = 8.0
    """Distance to a vehicle at which to stand, m."""
    # source: Roach
    pedestrian_margin: float = 6.0
    """Distance to a pedestrian at which to stand, m."""
    # source: Roach
    light_margin: float = 5.0
    """Distance to a red or yellow light's line at which to stand, m."""
    # source: Roach
    stop_sign_margin: float = 5.0
    """Distance to a stop sign's line at which to stand, m."""
    # source: Roach; the CaRL paper's reproduction has 4
    span: float = 5.0
    """Distance over which the desired speed falls, m."""
    # source: Roach
    stop_sign_span: float = 5.0
    """Likewise before a stop sign, m."""
    # source: Roach; the CaRL paper's reproduction has 4
    hazard_reach: float = 9.5
    """Distance within which vehicles and pedestrians count, m."""
    # source: Roach
    vehicle_bearing: float = math.radians(45.0)
    """Angle from straight ahead within which vehicles count, rad."""
    # source: Roach
    vehicle_turn: float = math.radians(150.0)
    """Largest difference of yaws of a vehicle that counts, rad."""
    # source: Roach
    light_reach: float = 18.0
    """Distance between the ego's tail and a light's line within which it counts, m."""
    # source: Roach
    stop_sign_reach: float = 20.0
    """Distance along the route within which a stop sign counts, m."""
    # source: the authors' code, its detector
    position_span: float = 2.0
    """Distance from the route that costs 1, m."""
    # source: Roach
    steer_threshold: float = 0.01
    """Change of steering beyond which it costs."""
    # source: Roach
    steer_price: float = 0.1
    """What it costs."""
    # source: Roach
    lateral_least: float = 3.5
    """Distance from the route that never ends the episode, m."""
    # source: Roach
    lateral_jump: float = 0.8
    """Change of that distance that counts as a jump, m."""
    # source: Roach
    pedestrian_scale: float = 2.0
    """How much larger pedestrians are drawn."""
    # source: Roach

    def __post_init__(self) -> None:
        """Refuses negative numbers and divisions by zero."""
        checks.refuse_negative(self, "reward.roach")
        spans = ("max_speed", "span", "stop_sign_span", "position_span")
        checks.refuse_zero(self, "reward.roach", *spans)


class RoachState(RewardState):
    """What Roach's reward remembers besides.

    Attributes:
      lateral: () m, distance from the route a step ago.
    """

    lateral: jax.Array


def init(ego: EgoState, num_stop_lines: int) -> RoachState:
    """What Roach's reward remembers at the start of a route.

    Args:
      ego: the ego at the start.
      num_stop_lines: Q, places for the route's stop lines.

    Returns:
      Memory with nothing in it.
    """
    return RoachState(**vars(remembered.init(ego, num_stop_lines)), lateral=jnp.float32(0.0))


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
    numbers = config.roach
    memory, causes = _causes(before, ego, agents, situation, vehicle, config, dt)
    terminated = functools.reduce(operator.or_, causes.values())
    finished = route_completion.is_finished(situation.route_idx, situation.route_num_points)
    is_timeout = timeout.is_timeout(before.step_count + 1, config.time_limit_s, dt)
    charged = terminated | finished | is_timeout if numbers.charge_every_end else terminated
    violated = functools.reduce(operator.or_, (causes[name] for name in VIOLATIONS))
    desired = target_speed(ego, agents, situation, memory.stop_satisfied, vehicle, config)
    terms = RewardTerms(
        added={
            "speed": desired_speed.match(ego.speed, desired, numbers.max_speed),
            "position": position.penalty(situation.route_lateral, numbers.position_span),
            "rotation": rotation.penalty(ego.yaw, situation.route_yaw),
            "action": action.penalty(
                before.ego.steer, ego.steer, numbers.steer_threshold, numbers.steer_price
            ),
        },
        soft={},
        terminated=causes,
        finished=finished,
        timeout=is_timeout,
        penalty=terminal.penalty(charged, violated, ego.speed),
    )
    paid = functools.reduce(operator.add, terms.added.values()) - terms.penalty
    return paid, terminated, memory, terms


def target_speed(
    ego: EgoState,
    agents: Agents,
    situation: Situation,
    stop_satisfied: jax.Array,
    vehicle: VehicleParams,
    config: RewardConfig,
) -> jax.Array:
    """The speed that Roach's rule asks for: the least that any hazard leaves.

    Args:
      ego: the ego.
      agents: (N,) the others.
      situation: the ego's situation, its look-ups of the others included.
      stop_satisfied: (Q,) bool, the ego has halted at that sign.
      vehicle: the ego's box.
      config: numbers.

    Returns:
      () m/s.
    """
    numbers, z_gap = config.roach, config.z_gap
    is_closed = (situation.stop_kind == STOP_LIGHT) & (situation.stop_light != LIGHT_GREEN)
    tail = config.red_light_tail_frac * 0.5 * vehicle.length
    vehicle_m = hazards.vehicle_ahead(
        ego, agents, numbers.hazard_reach, numbers.vehicle_bearing, numbers.vehicle_turn, z_gap
    )
    pedestrian_m = hazards.pedestrian_ahead(
        ego, agents, situation.others.on_road, numbers.hazard_reach, z_gap
    )
    light_m = hazards.light(ego, tail, situation, is_closed, numbers.light_reach, config.line_range)
    sign_m = hazards.stop_sign(ego, situation, stop_satisfied, numbers.stop_sign_reach)
    limits = [
        (vehicle_m, numbers.vehicle_margin, numbers.span),
        (pedestrian_m, numbers.pedestrian_margin, numbers.span),
        (light_m, numbers.light_margin, numbers.span),
        (sign_m, numbers.stop_sign_margin, numbers.stop_sign_span),
    ]
    speeds = [desired_speed.approaching(*limit, numbers.max_speed) for limit in limits]
    return functools.reduce(jnp.minimum, speeds)


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
    numbers = config.roach
    memory, ran_light, ran_sign = remembered.advance(before, ego, situation, vehicle, config, dt)
    lateral = jnp.abs(situation.route_lateral)
    limit = lateral_distance.limit(
        before.reward_state.lateral,  # type: ignore[attr-defined]
        lateral,
        numbers.lateral_least,
        numbers.lateral_jump,
    )
    causes = {
        "collision": collision.collided(ego, agents, vehicle, config.z_gap),
        "pedestrian_overlap": pedestrian_overlap.overlaps(
            ego, agents, vehicle, numbers.pedestrian_scale, config.z_gap
        ),
        "red_light": ran_light,
        "stop_sign": ran_sign,
        "lateral_distance": lateral_distance.is_beyond(lateral, limit),
        "blocked": blocked.is_blocked(memory.stopped_s, config.blocked_s, dt),
    }
    return memory.replace(lateral=lateral), causes


REWARD = Reward(
    init=init,
    compute=compute,
    added=("speed", "position", "rotation", "action"),
    soft=(),
    causes=CAUSES,
    at_finish="truncates",
)
