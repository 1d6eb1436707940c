"""Cars in the order in which they follow one another, where there are too many to look at all.

One integer holds way, place and number of a car: a CPU sorts plain integers ten times as fast as
tuples. Then the cars next to a place stand side by side.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from carljax.sim.once import once

MANY = 96  # cars, from which on looking at all pairs costs more. source: ours, measured
_LEAST_PLACE_BITS = 6  # of a key: on a lane of a kilometre, 16 m


class Order(struct.PyTreeNode):
    """Cars in their order.

    Attributes:
      keys: (M,) int32, sorted: way, place on it and number of a car.
      way: (M,) int32, where they are.
      cars: what is known of them, in that order.
      reach: m; what lies before 0 or beyond counts as equal to these.
      place_bits: static, of a key.
    """

    keys: jax.Array
    way: jax.Array
    cars: Any
    reach: jax.Array | float
    place_bits: int = struct.field(pytree_node=False)


def sort(
    way: jax.Array, place: jax.Array, cars: Any, num_ways: int, reach: jax.Array | float
) -> Order:
    """Sorts cars by way, and by place on it.

    Args:
      way: (M,) int32, the lane or junction of each; -1 for none.
      place: (M,) m along it.
      cars: tree of (M,) arrays, what will be asked of them.
      num_ways: more than any way.
      reach: m, the largest place that is told from others, to a fraction of it that depends on how
        many cars and ways there are: of 256 cars on 2,048 lanes to 1 / 1,024.

    Raises:
      ValueError: too many cars on too many ways for one integer.
    """
    num = way.shape[0]
    place_bits = 31 - num.bit_length() - num_ways.bit_length()
    if place_bits < _LEAST_PLACE_BITS:
        raise ValueError(f"{num} cars on {num_ways} lanes are too many to be put in order")
    order = Order(way, way, cars, reach, place_bits)
    keys = jnp.sort(_key(order, way, place) + jnp.arange(num))
    number = keys & (2 ** num.bit_length() - 1)
    way, cars = once(jax.tree.map(lambda x: x[number], (way, cars)))
    return order.replace(keys=keys, way=way, cars=cars)


def _key(order: Order, way: jax.Array, place: jax.Array | float) -> jax.Array:
    """What sorts before all cars that are at the place or after it on a way."""
    last = 2**order.place_bits - 1
    step = jnp.clip(jnp.asarray(place * (last / order.reach), jnp.int32), 0, last)
    return (((1 + way) << order.place_bits) + step) << order.way.shape[0].bit_length()


def following(
    order: Order, way: jax.Array, place: jax.Array | float, count: int
) -> tuple[Any, jax.Array]:
    """The next cars from places on; such at the places or little before them may be among them.

    Args:
      order: of all cars.
      way: (...,) int32.
      place: m along it, of that shape.
      count: how many are looked for.

    Returns:
      The cars (count, ...); the same shape bool, they are on that way. Those that are not come
      later in the order, or not at all.
    """
    first = jnp.searchsorted(order.keys, _key(order, way, place), method="scan_unrolled")
    at = first + jnp.arange(count).reshape(-1, *(1,) * first.ndim)
    last = order.keys.shape[0] - 1
    found_way, cars = jax.tree.map(lambda x: x[jnp.minimum(at, last)], (order.way, order.cars))
    return cars, (found_way == way) & (at <= last) & (way >= 0)
