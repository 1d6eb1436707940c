"""Minimum speed: the ego's mean speed against that of the traffic around it, stage by stage.

Source: CARLA leaderboard 2.0: `NUM_STAGES` of equal length; the last one is measured where the
route ends, if that is past `LAST_FROM`. Traffic at a light counts too, with speed 0.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from carljax.sim.types import KIND_VEHICLE, Agents, EgoState

NUM_STAGES = 4  # source: CARLA leaderboard 2.0
LAST_FROM = 0.95  # of the route. source: CARLA leaderboard 2.0
# m from the ego. source: ours; CARLA's leaderboard takes all background cars, which live near it
AROUND = 100.0


class MinSpeed(struct.PyTreeNode):
    """Speeds on the present stage and what came out of the earlier ones.

    Attributes:
      ego_sum: () m/s, sum over the steps with traffic around.
      traffic_sum: () m/s, likewise of the mean over that traffic.
      begin_s: () m on the route, where the stage began.
      num_stages: () int32, stages measured.
      percent: (NUM_STAGES,) the ego's speed in percent of the traffic's; 100 before it is measured
        and where there was no moving traffic.
    """

    ego_sum: jax.Array
    traffic_sum: jax.Array
    begin_s: jax.Array
    num_stages: jax.Array
    percent: jax.Array


def start() -> MinSpeed:
    """At the start of a route."""
    zero = jnp.zeros((), jnp.float32)
    return MinSpeed(
        ego_sum=zero,
        traffic_sum=zero,
        begin_s=zero,
        num_stages=jnp.zeros((), jnp.int32),
        percent=jnp.full(NUM_STAGES, 100.0, jnp.float32),
    )


def update(
    measured: MinSpeed, ego: EgoState, traffic: Agents, route_s: jax.Array, length: jax.Array
) -> MinSpeed:
    """Closes the stage if the ego has passed its end, then adds the speeds of this step.

    Args:
      measured: so far.
      ego: the ego.
      traffic: the vehicles of ordinary traffic.
      route_s: () m, progress on the route.
      length: () m, of the route.

    Returns:
      The measurement with this step.
    """
    is_over = route_s - measured.begin_s > length / NUM_STAGES
    measured = _close_where(is_over, measured, route_s)
    away = ((traffic.xy - ego.xy) ** 2).sum(axis=1)
    counted = (traffic.kind == KIND_VEHICLE) & (away < AROUND**2)
    num = counted.sum()
    mean = jnp.where(counted, traffic.speed, 0.0).sum() / jnp.maximum(num, 1)
    return measured.replace(
        ego_sum=measured.ego_sum + jnp.where(num > 0, ego.speed, 0.0),
        traffic_sum=measured.traffic_sum + mean,
    )


def finish_where(
    ended: jax.Array, measured: MinSpeed, route_s: jax.Array, length: jax.Array
) -> MinSpeed:
    """Closes the last stage where the route has ended late enough.

    Args:
      ended: () bool.
      measured: so far.
      route_s: () m, progress on the route.
      length: () m, of the route.

    Returns:
      The measurement, with the last stage in it.
    """
    return _close_where(ended & (route_s > LAST_FROM * length), measured, route_s)


def _close_where(is_over: jax.Array, measured: MinSpeed, route_s: jax.Array) -> MinSpeed:
    has_traffic = measured.traffic_sum > 0.0
    ratio = measured.ego_sum / jnp.where(has_traffic, measured.traffic_sum, 1.0)
    percent = jnp.where(has_traffic, 100.0 * ratio, 100.0)
    here = is_over & (jnp.arange(NUM_STAGES) == measured.num_stages)
    return MinSpeed(
        ego_sum=jnp.where(is_over, 0.0, measured.ego_sum),
        traffic_sum=jnp.where(is_over, 0.0, measured.traffic_sum),
        begin_s=jnp.where(is_over, route_s, measured.begin_s),
        num_stages=measured.num_stages + is_over.astype(jnp.int32),
        percent=jnp.where(here, percent, measured.percent),
    )
