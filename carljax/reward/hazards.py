"""Hazards: how far it is to the nearest road user, light or sign that calls for a lower speed.

Each function gives a distance, infinity where there is no such hazard. Distances are between
centres. Source of reaches and angles: Roach's hazard detectors, as the authors' code reproduces
them; those take the ten nearest within 15 m first, which are all that fit within the reach here.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.reward import stop_line
from carljax.reward.collision import is_near_in_height
from carljax.sim import geometry
from carljax.sim.types import KIND_PEDESTRIAN, KIND_VEHICLE, STOP_SIGN, Agents, EgoState, Situation

# Degrees: a pedestrian at d m counts within 162 / (clip(d, 1.5, 10.5) + 0.3) of straight ahead.
# source: Roach
PEDESTRIAN_CONE = 162.0
PEDESTRIAN_NEAR, PEDESTRIAN_FAR, PEDESTRIAN_OFFSET = 1.5, 10.5, 0.3


def _polar(ego: EgoState, agents: Agents) -> tuple[jax.Array, jax.Array]:
    """(N,) m to each of the others, and (N,) rad away from straight ahead, not negative."""
    offset = geometry.to_frame(agents.xy, ego.xy, ego.yaw)
    return jnp.hypot(offset[:, 0], offset[:, 1]), jnp.abs(jnp.arctan2(offset[:, 1], offset[:, 0]))


def _nearest(distance: jax.Array, counts: jax.Array) -> jax.Array:
    """() the least distance of those that count, infinity if none does."""
    return jnp.min(jnp.where(counts, distance, jnp.inf), initial=jnp.inf)


def vehicle_ahead(
    ego: EgoState,
    agents: Agents,
    reach: jax.Array | float,
    bearing: jax.Array | float,
    turn: jax.Array | float,
    z_gap: jax.Array | float,
) -> jax.Array:
    """Distance to the nearest vehicle in front that doesn't come towards the ego.

    Args:
      ego: the ego.
      agents: (N,) the others.
      reach: m within which they count.
      bearing: rad away from straight ahead, below which they count.
      turn: rad between both yaws, up to which they count.
      z_gap: m, height difference that keeps apart.

    Returns:
      () m.
    """
    distance, angle = _polar(ego, agents)
    goes_along = jnp.abs(geometry.wrap_angle(agents.yaw - ego.yaw)) <= turn
    counts = (distance <= reach) & (angle < bearing) & goes_along
    counts &= (agents.kind == KIND_VEHICLE) & is_near_in_height(ego, agents, z_gap)
    return _nearest(distance, counts)


def pedestrian_ahead(
    ego: EgoState,
    agents: Agents,
    on_road: jax.Array,
    reach: jax.Array | float,
    z_gap: jax.Array | float,
) -> jax.Array:
    """Distance to the nearest pedestrian off the pavement and in front; near ones in a wider cone.

    Args:
      ego: the ego.
      agents: (N,) the others.
      on_road: (N,) bool, they are on road, parking lane or shoulder.
      reach: m within which they count.
      z_gap: m, height difference that keeps apart.

    Returns:
      () m.
    """
    distance, angle = _polar(ego, agents)
    clipped = jnp.clip(distance, PEDESTRIAN_NEAR, PEDESTRIAN_FAR)
    cone = jnp.radians(PEDESTRIAN_CONE / (clipped + PEDESTRIAN_OFFSET))
    counts = (distance <= reach) & (angle < cone) & on_road
    counts &= (agents.kind == KIND_PEDESTRIAN) & is_near_in_height(ego, agents, z_gap)
    return _nearest(distance, counts)


def vehicle_on_route(
    ego: EgoState, agents: Agents, route_gap: jax.Array, z_gap: jax.Array | float
) -> jax.Array:
    """Distance along the route to the next vehicle on it.

    Args:
      ego: the ego.
      agents: (N,) the others.
      route_gap: (N,) m along the route, infinity where they aren't on it ahead.
      z_gap: m, height difference that keeps apart.

    Returns:
      () m.
    """
    counts = (agents.kind == KIND_VEHICLE) & is_near_in_height(ego, agents, z_gap)
    return _nearest(route_gap, counts)


def light(
    ego: EgoState,
    behind: jax.Array | float,
    situation: Situation,
    is_closed: jax.Array,
    reach: jax.Array | float,
    line_range: jax.Array | float,
) -> jax.Array:
    """Distance to the nearest closed light's stop line that a point of the ego has yet to cross.

    Args:
      ego: the ego.
      behind: m, how far behind the ego's centre that point is.
      situation: route progress and stop lines.
      is_closed: (Q,) bool, lights that must not be passed now.
      reach: m between point and line, within which it counts.
      line_range: m along the route, within which it counts.

    Returns:
      () m, from the ego's centre.
    """
    point = stop_line.behind_centre(ego, behind)
    offset = geometry.to_frame(point, situation.stop_xy, situation.stop_yaw)
    counts = (offset[:, 0] < 0.0) & (jnp.hypot(offset[:, 0], offset[:, 1]) <= reach)
    counts &= jnp.cos(ego.yaw - situation.stop_yaw) > 0.0
    counts &= stop_line.in_reach(situation, line_range) & is_closed
    return _nearest(_distance(ego, situation), counts)


def stop_sign(
    ego: EgoState, situation: Situation, satisfied: jax.Array, reach: jax.Array | float
) -> jax.Array:
    """Distance to the nearest stop sign's line ahead at which the ego has not halted yet.

    Args:
      ego: the ego.
      situation: route progress and stop lines.
      satisfied: (Q,) bool, the ego has halted there.
      reach: m along the route, within which it counts.

    Returns:
      () m, from the ego's centre.
    """
    ahead = geometry.to_frame(ego.xy, situation.stop_xy, situation.stop_yaw)[:, 0] < 0.0
    counts = ahead & stop_line.in_reach(situation, reach) & ~satisfied
    return _nearest(_distance(ego, situation), counts & (situation.stop_kind == STOP_SIGN))


def _distance(ego: EgoState, situation: Situation) -> jax.Array:
    """(Q,) m from the ego's centre to each stop line's."""
    offset = situation.stop_xy - ego.xy
    return jnp.hypot(offset[:, 0], offset[:, 1])
