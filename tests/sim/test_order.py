"""The order of many cars, against one worked out car by car."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from carljax.sim import order

LANES, REACH = 12, 100.0


def some_cars(num, seed):
    rng = np.random.default_rng(seed)
    way = rng.integers(-1, LANES, num).astype(np.int32)
    return way, rng.uniform(0.0, REACH, num).astype(np.float32)


@pytest.mark.parametrize("num", [5, 60, 300])
def test_the_next_on_a_way_are_found_in_their_order(num):
    way, place = some_cars(num, num)
    ways = np.arange(-1, LANES, dtype=np.int32).repeat(3)
    places = np.random.default_rng(1).uniform(0.0, REACH, ways.size).astype(np.float32)

    @jax.jit
    def look(way, place):
        cars = {"number": jnp.arange(num), "place": place}
        return order.following(order.sort(way, place, cars, LANES, REACH), ways, places, 6)

    found, is_there = jax.tree.map(np.asarray, look(way, place))
    assert is_there.shape == (6, ways.size) and is_there.any() and not is_there.all()
    np.testing.assert_array_equal(found["place"], place[found["number"]])
    for k, (here, start) in enumerate(zip(ways, places, strict=True)):
        ahead = [n for n in np.argsort(place) if way[n] == here >= 0 and place[n] >= start]
        got = found["number"][is_there[:, k], k]
        # Places are told apart to a small fraction of the reach: none here is as near to a start.
        np.testing.assert_array_equal(got, ahead[:6])


def test_all_beyond_the_reach_are_at_its_end():
    way, place = np.zeros(4, np.int32), np.array([90.0, 1e6, 150.0, 3.0], np.float32)
    cars = order.sort(jnp.asarray(way), jnp.asarray(place), jnp.arange(4), LANES, REACH)
    assert cars.cars.tolist() == [3, 0, 1, 2]
    found, is_there = order.following(cars, jnp.array(0), jnp.array(1e9), 3)
    assert found[is_there].tolist() == [1, 2]


def test_more_than_fit_are_refused():
    cars = jnp.zeros(1 << 10, jnp.int32)
    with pytest.raises(ValueError, match="1024 cars on 65536 lanes"):
        order.sort(cars, cars, cars, 1 << 16, REACH)
    assert order.sort(cars, cars, cars, (1 << 14) - 1, REACH).place_bits == 6
