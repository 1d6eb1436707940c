"""Crossing a stop line: what running a red light and running a stop sign have in common.

A line is crossed in the step in which a fixed point of the ego goes from before it to beyond it,
facing its way. So neither a light that turns red when the car is already beyond nor a line that the
car never drove over counts.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.sim import geometry
from carljax.sim.types import EgoState, Situation


def behind_centre(ego: EgoState, distance: jax.Array | float) -> jax.Array:
    """The ego's point at a distance behind its centre.

    Args:
      ego: the ego.
      distance: m.

    Returns:
      (2,) m, world.
    """
    return ego.xy - distance * jnp.stack([jnp.cos(ego.yaw), jnp.sin(ego.yaw)])


def in_reach(situation: Situation, line_range: jax.Array | float) -> jax.Array:
    """Lines near the ego along the route: another pass through the same junction does not count.

    Args:
      situation: route progress and stop lines.
      line_range: m.

    Returns:
      (Q,) bool.
    """
    return jnp.abs(situation.stop_s - situation.route_s) <= line_range


def crossed(
    before: EgoState,
    after: EgoState,
    distance: jax.Array | float,
    situation: Situation,
    lane_widths: jax.Array | float,
) -> jax.Array:
    """Lines that a point of the ego has gone over in this step.

    Args:
      before: the ego a step ago.
      after: the ego now.
      distance: m, how far behind its centre the point is.
      situation: the stop lines.
      lane_widths: half width of a line in lane widths.

    Returns:
      (Q,) bool.
    """
    start = geometry.to_frame(
        behind_centre(before, distance), situation.stop_xy, situation.stop_yaw
    )
    end = geometry.to_frame(behind_centre(after, distance), situation.stop_xy, situation.stop_yaw)
    goes_over = (start[:, 0] < 0.0) & (end[:, 0] >= 0.0)
    share = start[:, 0] / jnp.where(goes_over, start[:, 0] - end[:, 0], 1.0)
    lateral = start[:, 1] + share * (end[:, 1] - start[:, 1])
    is_within = jnp.abs(lateral) <= lane_widths * situation.stop_width
    return goes_over & is_within & (jnp.cos(after.yaw - situation.stop_yaw) > 0.0)
