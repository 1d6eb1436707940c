"""The lanes that a vehicle of traffic will take: drawn as it goes."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.sim import vehicles
from carljax.sim.road_map import RoadMap


def next_lane(lane: jax.Array, model: jax.Array, road_map: RoadMap, key: jax.Array) -> jax.Array:
    """(N,) int32, a successor of each lane drawn uniformly from those that suit; -1 at dead ends.

    Args:
      lane: (N,) int32, -1 for none.
      model: (N,) int32, class of the vehicle that will drive there.
      road_map: the map.
      key: PRNG key.
    """
    successors = road_map.lane_successors[jnp.maximum(lane, 0)]  # (N, F)
    there = successors >= 0
    suited = there & vehicles.suits(model[:, None], jnp.maximum(successors, 0), road_map)
    open_to = jnp.where(suited.any(axis=1, keepdims=True), suited, there)
    number = jnp.cumsum(open_to, axis=1)  # of each, from 1
    drawn = jax.random.uniform(key, lane.shape) * number[:, -1]
    drawn = jnp.argmax(open_to & (number > drawn[:, None]), axis=1)
    chosen = jnp.take_along_axis(successors, drawn[:, None], axis=1)[:, 0]
    return jnp.where(lane >= 0, chosen, -1)


def plan(lane: jax.Array, model: jax.Array, road_map: RoadMap, key: jax.Array) -> jax.Array:
    """(N, 3) int32, a plan that begins with the given lanes."""
    key_second, key_third = jax.random.split(key)
    second = next_lane(lane, model, road_map, key_second)
    third = next_lane(second, model, road_map, key_third)
    return jnp.stack([lane, second, third], axis=1)
