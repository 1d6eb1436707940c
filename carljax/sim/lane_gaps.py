"""Whom a car would come between on a lane, and how they drive: what MOBIL asks about."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from carljax.sim import idm, vehicles
from carljax.sim.idm import IDMParams
from carljax.sim.lane_shift import FAR, changing, with_leaving
from carljax.sim.right_of_way import Mover
from carljax.sim.road_map import RoadMap
from carljax.sim.types import Agents


class Others(struct.PyTreeNode):
    """Whom a car may come between, (N + 1 + AT_ONCE,): agents, the ego, cars that leave a lane.

    Attributes:
      mover: where they are.
      desired: m/s, free speed.
      driver: their driver model, arrays like the others.
    """

    mover: Mover
    desired: jax.Array
    driver: IDMParams


class Gaps(struct.PyTreeNode):
    """Whom a place on a lane has before and behind it, (M,).

    Attributes:
      ahead, behind: m between bumpers, infinite where there is nobody.
      leader_speed: m/s.
      follower_speed, follower_desired: m/s.
      follower: its driver model.
    """

    ahead: jax.Array
    behind: jax.Array
    leader_speed: jax.Array
    follower_speed: jax.Array
    follower_desired: jax.Array
    follower: IDMParams


def others(
    agents: Agents, movers: Mover, desired: jax.Array, road_map: RoadMap, params: IDMParams
) -> Others:
    """Everybody, with how they drive; the ego counts as a car that drives at the limit at least."""
    row, _ = changing(agents)
    ego_limit = road_map.lane_speed_limit[jnp.maximum(movers.lane[-1], 0)]
    ego_desired = jnp.maximum(ego_limit, movers.speed[-1])
    model = jnp.append(agents.model, vehicles.CAR)
    return Others(
        mover=with_leaving(movers, agents),
        desired=jnp.concatenate([desired, ego_desired[None], desired[row]]),
        driver=vehicles.driver(jnp.concatenate([model, agents.model[row]]), params),
    )


def gaps(
    lanes: jax.Array,
    s: jax.Array,
    length: jax.Array,
    itself: jax.Array,
    everybody: Others,
    road_map: RoadMap,
) -> Gaps:
    """Whom a place on a lane has before and behind it; those exactly beside count as behind.

    Args:
      lanes: (M, 3) int32, the lane and the two after it.
      s: (M,) m on the first.
      length: (M,) m, of the vehicle that is or would be there.
      itself: (M,) int32, row of that vehicle among everybody.
      everybody: see `Others`.
      road_map: the map.
    """
    movers = jax.tree.map(lambda x: x[:, None], everybody.mover)
    first, following, third = lanes.T
    is_other = jnp.arange(movers.lane.shape[0])[:, None] != itself
    lane = jnp.where(is_other, movers.lane, -1)  # (everybody, M)
    to_next = road_map.lane_length[jnp.maximum(first, 0)] - s
    to_third = to_next + road_map.lane_length[jnp.maximum(following, 0)]
    on_first = (lane == first) & (lane >= 0)
    on_next = (lane == following) & (lane >= 0)
    on_third = (lane == third) & (lane >= 0)
    offset = movers.s - s
    ahead = jnp.where(on_first & (offset > 0.0), offset, FAR)
    ahead = jnp.minimum(ahead, jnp.where(on_next, to_next + movers.s, FAR))
    ahead = jnp.minimum(ahead, jnp.where(on_third, to_third + movers.s, FAR))
    # From the middle of the place to that of whoever drives up to it.
    arrives = (movers.next_lane == first) & (lane >= 0)
    until = s + movers.entry + movers.half_length
    behind = jnp.where(on_first & (offset <= 0.0), -offset, jnp.where(arrives, until, FAR))
    half = 0.5 * length + movers.half_length
    ahead, behind = ahead - half, behind - half
    nearest, last = ahead.min(axis=0), behind.min(axis=0)

    # Of whoever is nearest: no search by index, which costs more than all the rest.
    def of(is_it: jax.Array, values: Any) -> jax.Array:
        return jnp.where(is_it, values[:, None], 0.0).max(axis=0)

    leads, comes = ahead == nearest, behind == last
    speed, driver = everybody.mover.speed, everybody.driver
    return Gaps(
        ahead=jnp.where(nearest < 0.5 * FAR, nearest, jnp.inf),
        behind=jnp.where(last < 0.5 * FAR, last, jnp.inf),
        leader_speed=of(leads, speed),
        follower_speed=of(comes, speed),
        follower_desired=of(comes, everybody.desired),
        follower=driver.replace(
            accel_max=of(comes, driver.accel_max),
            comfort_brake=of(comes, driver.comfort_brake),
        ),
    )


def follows(side: Gaps, gap: jax.Array, leader_speed: jax.Array) -> jax.Array:
    """(M,) m/s^2 of the car behind a place if its gap and its leader were these."""
    return idm.acceleration(
        side.follower_speed, gap, leader_speed, side.follower_desired, side.follower
    )
