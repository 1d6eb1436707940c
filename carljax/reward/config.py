"""Which reward, its numbers and named options. The default is the paper's CARLA reward.

What only one of the other rewards has stands beside that reward; what is here holds for all that
make use of it.
Numbers are pytree leaves, so a sweep over them is a `vmap`; options are static. Where the authors'
code differs from the paper the code's way is an option, or a number said beside the paper's.
"""

from __future__ import annotations

import dataclasses
import math
import typing
from typing import Literal

from flax import struct

from carljax.reward import checks
from carljax.reward.carl_nuplan import CarlNuplanConfig
from carljax.reward.roach import RoachConfig
from carljax.reward.think2drive import Think2DriveConfig

Name = Literal[
    "carl", "carl-nuplan", "carl-nuplan-survival", "carl-nuplan-tuned", "roach", "think2drive"
]


class RewardConfig(struct.PyTreeNode):
    """One of several rewards; docs/rewards.md has their formulas."""

    name: Name = struct.field(pytree_node=False, default="carl")
    """The reward."""
    ttc_forecast: Literal["arc", "straight"] = struct.field(pytree_node=False, default="arc")
    """Forecast for time to collision: arcs of a kinematic bicycle up to 1.0 s, or the code's
    straight lines up to 0.9 s."""
    # source: paper, Soft Penalties (arc); the authors' code (straight)
    comfort_limits: Literal["carla", "nuplan"] = struct.field(pytree_node=False, default="carla")
    """Which column of the paper's table of comfort thresholds."""
    round_progress: bool = struct.field(pytree_node=False, default=False)
    """Round route completion to 0.01 % before taking differences, as the code does."""
    yellow_is_red: bool = struct.field(pytree_node=False, default=False)
    """Treat a yellow light as a red one; an option of the code that CaRL leaves off."""
    timeout_terminates: bool = struct.field(pytree_node=False, default=False)
    """Let the time limit terminate the episode, as the code does; otherwise it truncates it."""
    terminal_penalty: float = 1.0
    """Paid on a collision and on running a red light."""
    # source: paper, Terminal Penalties
    z_gap: float = 3.0
    """Height difference beyond which two boxes cannot meet, m."""
    # source: ours; between a car's height and the clearance of an overpass
    off_road_frac: float = 0.95
    """Fraction of the footprint off the drivable area above which the ego is off road."""
    # source: the authors' code; the paper gives none
    deviation_distance: float = 30.0
    """Distance to the route that ends the episode, m."""
    # source: paper, Terminal Penalties
    deviation_far: float = 15.0
    """Distance to the route from which advancing counts as far from it, m."""
    # source: the authors' code
    deviation_far_frac: float = 0.3
    """Fraction of the route that may be advanced far from it; infinity switches the rule off."""
    # source: the authors' code; the paper has no such rule
    blocked_speed: float = 0.1
    """Speed below which the ego stands, m/s."""
    # source: paper, Terminal Penalties
    blocked_s: float = 90.0
    """Longest time it may stand, s."""
    # source: paper, Terminal Penalties
    time_limit_s: float = 1200.0
    """Longest episode, s."""
    # source: the authors' code
    halt_speed: float = 0.1
    """Speed below which the ego has halted at a stop sign, m/s."""
    # source: the authors' code
    line_lane_widths: float = 5.0
    """Lane widths by which a stop line reaches to either side of its centre."""
    # source: the authors' code
    line_range: float = 30.0
    """Distance along the route between ego and stop line within which the line counts, m."""
    # source: the authors' code (red lights)
    red_light_tail_frac: float = 0.8
    """Point that must not cross at red: behind the centre by this fraction of half the length."""
    # source: the authors' code
    stop_sign_tail_frac: float = 0.0
    """Likewise the point that must not cross a stop line unless the ego has halted."""
    # source: the authors' code (centre); 1 waits for the rear bumper
    outside_lanes_margin: float = 0.5
    """Distance past the lane's edge at which the ego is outside its lanes, m."""
    # source: the authors' code
    wrong_way_angle: float = math.radians(120.0)
    """Angle to the lane's direction from which the ego drives against traffic, rad."""
    # source: the authors' code
    speeding_range: float = 8.0 / 3.6
    """Excess speed at which the factor reaches zero, m/s."""
    # source: paper, 8 km/h; the code has 2.23 m/s
    ttc_factor: float = 0.5
    """Factor while a time-to-collision violation holds."""
    # source: paper, Soft Penalties
    ttc_ticks: int = 500
    """Steps for which it holds."""
    # source: paper; the authors' C++ trainer has 100
    ttc_min_speed: float = 0.1
    """Ego speed below which there is none, m/s."""
    # source: the authors' code
    comfort_weight: float = 0.5
    """What is lost when all six comfort metrics are violated."""
    # source: paper, Soft Penalties; 1 gives the code's nuPlan factor passed / 6
    comfort_ticks: int = 500
    """Steps for which a comfort violation holds."""
    # source: paper, Soft Penalties

    carl_nuplan: CarlNuplanConfig = dataclasses.field(default_factory=CarlNuplanConfig)
    """What the carl-nuplan rewards have of their own."""
    roach: RoachConfig = dataclasses.field(default_factory=RoachConfig)
    """What roach has of its own."""
    think2drive: Think2DriveConfig = dataclasses.field(default_factory=Think2DriveConfig)
    """What think2drive has of its own."""

    def __post_init__(self) -> None:
        """Refuses unknown names and negative numbers."""
        names = typing.get_args(Name)
        if self.name not in names:
            raise ValueError(f"reward.name: {self.name!r} is none of {', '.join(names)}")
        checks.refuse_negative(self, "reward")
        checks.refuse_zero(self, "reward", "speeding_range")
