"""Who is in the way: where along the way the ego's box would first touch others as they stand now.

Boxes are tested, not lanes: so a lorry that stands across, a pedestrian on the road and a car that
is half way into the lane are found alike.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from carljax.planners.way import Way
from carljax.reward import collision
from carljax.sim import geometry
from carljax.sim.bicycle import VehicleParams
from carljax.sim.types import Agents, EgoState

RANGE = 72  # m looked ahead. source: ours, braking from 80 km/h takes 66 m at 3.72 m/s^2
SIDE_MARGIN = 0.25  # m kept free on either side. source: ours
Z_GAP = 3.0  # m in height that keep two apart. source: as for collisions
SAME_WAY = 0.5  # cosine of the angle to the way within which one drives along it. source: ours


class InWay(struct.PyTreeNode):
    """What each of the others means to the ego's way.

    Attributes:
      gap: (N,) m that the ego may move along its way before it touches this one; infinity where it
        would not within `RANGE`.
      speed: (N,) m/s of this one along the way, not negative.
      same_way: (N,) bool, it points along the way, to within 60 degrees.
    """

    gap: jax.Array
    speed: jax.Array
    same_way: jax.Array


def in_way(ego: EgoState, agents: Agents, way: Way, car: VehicleParams) -> InWay:
    """Finds all that stand or drive on the ego's way.

    Args:
      ego: the ego.
      agents: (N,) the others.
      way: the ego's way.
      car: its box.

    Returns:
      (N,) findings.
    """
    xy, yaw = way.xy[: RANGE + 1], way.yaw[: RANGE + 1]
    touches = geometry.boxes_overlap(
        xy[:, None],
        yaw[:, None],
        car.length,
        car.width + 2.0 * SIDE_MARGIN,
        agents.xy,
        agents.yaw,
        agents.length,
        agents.width,
    )  # (RANGE + 1, N)
    touches &= collision.is_near_in_height(ego, agents, Z_GAP)
    first = jnp.argmax(touches, axis=0)
    before = jnp.maximum(first - 1, 0)
    turned = agents.yaw - yaw[first]
    # The rest of the metre in which the boxes meet, by their extents along the way.
    extent = agents.length * jnp.abs(jnp.cos(turned)) + agents.width * jnp.abs(jnp.sin(turned))
    along = geometry.to_frame(agents.xy, xy[before], yaw[before])[:, 0]
    rest = jnp.clip(along - 0.5 * (car.length + extent), 0.0, 1.0)
    gap = jnp.where(first > 0, before + rest, 0.0)
    return InWay(
        gap=jnp.where(touches.any(axis=0), gap, jnp.inf),
        speed=jnp.maximum(agents.speed * jnp.cos(turned), 0.0),
        same_way=jnp.cos(turned) > SAME_WAY,
    )
