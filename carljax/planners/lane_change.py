"""When to change lanes: where the route says so, or later, once there is room.

Room is as MOBIL has it: nobody on the other lane has to brake hard. Source of the idea: Kesting,
Treiber, Helbing, General lane-changing model MOBIL (2007); PDM-Lite has its scenarios' own rules.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.planners import way as way_module
from carljax.planners.way import Stretch
from carljax.sim.bicycle import VehicleParams
from carljax.sim.road_map import RoadMap
from carljax.sim.types import Agents, EgoState

LEAD_M, LEAD_S = 3.0, 1.0  # m and s before a change at which it is decided. source: ours
# What is left to others: m, s of their speed, and s of the speed at which they close in. source:
# ours, an IDM driver's gap and headway, and braking by 1 to 2 m/s^2
GAP_M, HEADWAY_S, CLOSING_S = 3.0, 0.3, 2.5
# m by which a change is put off at most: as far back as the window of the route reaches.
LONGEST_DELAY = float(way_module.MORE_BACK - 4)
JUNCTION_MARGIN = 3.0  # m before a junction at which it is over. source: ours


def postpone(
    found: Stretch,
    ego: EgoState,
    agents: Agents,
    delay: jax.Array,
    road_map: RoadMap,
    car: VehicleParams,
) -> tuple[jax.Array, jax.Array]:
    """Puts the next change of lane off while there is no room.

    Args:
      found: the ego on its route.
      ego: the ego.
      agents: (N,) the others.
      delay: () m by which changes are put off so far.
      road_map: the map.
      car: the ego's box.

    Returns:
      () m by which they are put off now, and () m that the ego may go on in its lane before it has
      to wait for room; infinity where it need not.
    """
    half = float(way_module.CHANGE_LENGTH)
    place = jnp.arange(found.sideways.shape[0])
    open_jump = (found.sideways != 0.0) & (place + delay + half > found.at)
    has_jump = open_jump.any()
    jump = jnp.argmax(open_jump)
    begins = jump - half
    lead = LEAD_M + LEAD_S * ego.speed
    is_begun = found.at > begins + delay + 1.0
    is_near = found.at > begins + delay - lead
    blocked = has_jump & is_near & ~is_begun & ~_has_room(found, jump, ego, agents, road_map, car)
    inside = found.route.in_junction & (place > jump)
    last = jnp.where(inside.any(), jnp.argmax(inside), found.route.num_points)
    longest = jnp.clip(last - JUNCTION_MARGIN - half - jump, 0.0, LONGEST_DELAY)
    pushed = jnp.minimum(found.at + lead - begins, longest)
    wait = jnp.where(blocked, begins + longest - found.at, jnp.inf)
    delay = jnp.where(blocked, jnp.maximum(delay, pushed), delay)
    # The next change is put off for reasons of its own.
    is_open = has_jump & (found.at > begins - lead)
    return jnp.where(is_open, delay, 0.0), wait


def _has_room(
    found: Stretch,
    jump: jax.Array,
    ego: EgoState,
    agents: Agents,
    road_map: RoadMap,
    car: VehicleParams,
) -> jax.Array:
    """() bool, nobody is too near on the lane that the route jumps to, nor coming up on it."""
    lane = found.route.lane[jump]
    beside = found.route.lane_s[jump] - (jump - found.at)
    to_come = agents.lane_s - road_map.lane_length[jnp.maximum(agents.lanes[:, 0], 0)]
    is_on, is_coming = agents.lanes[:, 0] == lane, agents.lanes[:, 1] == lane
    ahead = jnp.where(is_on, agents.lane_s, to_come) - beside
    gap = jnp.abs(ahead) - 0.5 * (agents.length + car.length)
    closing = jnp.where(ahead > 0.0, ego.speed - agents.speed, agents.speed - ego.speed)
    behind_speed = jnp.where(ahead > 0.0, ego.speed, agents.speed)
    needed = GAP_M + HEADWAY_S * behind_speed + CLOSING_S * jnp.maximum(closing, 0.0)
    return ~((is_on | is_coming) & agents.valid & (gap < needed)).any()
