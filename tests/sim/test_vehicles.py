"""Classes of vehicles: sizes, who drives where, and how."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_world import arc, lane, link, network, straight

from carljax.sim import lane_plan, road_map_builder, town, vehicles
from carljax.sim.idm import IDMParams
from carljax.sim.vehicles import BICYCLE, BUS, CAR, CLASSES, MOTORBIKE, TRUCK, VAN

NUM = 20_000
draw = jax.jit(vehicles.draw)


@pytest.fixture(scope="module")
def roads():
    """A street of 10 m/s that parts into a bend of 10 m radius and the way on; a road of 25 m/s."""
    lanes = [
        straight((0, 0), (100, 0)),
        arc((100, 0), 0.0, 10.0, np.pi / 2),
        straight((100, 0), (200, 0)),
        lane(np.stack([np.arange(0, 301.0), np.full(301, 50.0)], axis=-1), speed_limit=25.0),
    ]
    the_town = town.from_network(network(link(lanes, [(0, 1), (0, 2)])))
    return road_map_builder.build([the_town]), the_town.lanes.raw_lane.tolist()


def drawn(roads, raw, room=50.0):
    road_map, row = roads
    lanes = jnp.full(NUM, row[raw], jnp.int32)
    got = draw(lanes, jnp.full(NUM, room, jnp.float32), road_map, jax.random.key(0))
    return tuple(np.asarray(x) for x in got)


def test_shares_and_sizes(roads):
    model, length, width = drawn(roads, 0)
    share = np.bincount(model, minlength=len(CLASSES)) / NUM
    # 20,000 draws: three standard deviations are at most 3 sqrt(0.25 / 20,000) = 0.011
    np.testing.assert_allclose(share, [one.share for one in CLASSES], atol=0.011)
    np.testing.assert_allclose(sum(one.share for one in CLASSES), 1.0)
    for row, one in enumerate(CLASSES):
        for got, (low, high) in ((length, one.length), (width, one.width)):
            mine = got[model == row]
            assert low - 1e-5 <= mine.min() < low + 0.1 * (high - low)
            assert high + 1e-5 >= mine.max() > high - 0.1 * (high - low)
    assert length.max() <= 10.3 + 1e-5 and width.max() <= 2.6 + 1e-5


def test_only_what_has_room(roads):
    model, length, _ = drawn(roads, 0, room=7.0)
    assert length.max() <= 7.0
    assert set(model) == {CAR, VAN, MOTORBIKE, BICYCLE}


def test_no_lorries_in_tight_bends_and_no_bicycles_on_fast_roads(roads):
    assert not {TRUCK, BUS} & set(drawn(roads, 1)[0])
    fast = set(drawn(roads, 3)[0])
    assert BICYCLE not in fast and BUS in fast


def test_plans_keep_off_lanes_that_do_not_suit_where_there_is_a_choice(roads):
    road_map, row = roads
    starts = jnp.full(2000, row[0], jnp.int32)
    following = jax.jit(lane_plan.next_lane)

    def chosen(model):
        models = jnp.full(2000, model, jnp.int32)
        return np.asarray(following(starts, models, road_map, jax.random.key(1)))

    assert set(chosen(BUS)) == {row[2]}
    assert set(chosen(CAR)) == {row[1], row[2]}
    # uniformly: three standard deviations of 2,000 coins are 3 sqrt(0.25 / 2,000) = 0.034
    np.testing.assert_allclose((chosen(CAR) == row[1]).mean(), 0.5, atol=0.034)
    ends = following(jnp.array([row[2], -1]), jnp.array([CAR, CAR]), road_map, jax.random.key(1))
    assert ends.tolist() == [-1, -1]


def test_a_long_vehicle_turns_where_there_is_no_other_way(roads):
    road_map, row = roads
    only = road_map.replace(lane_successors=jnp.full_like(road_map.lane_successors, row[1]))
    onward = lane_plan.next_lane(jnp.array([row[0]]), jnp.array([BUS]), only, jax.random.key(0))
    assert onward.tolist() == [row[1]]


def test_drivers_and_their_speeds():
    model = jnp.array([CAR, TRUCK, BICYCLE])
    params = vehicles.driver(model, IDMParams(accel_max=2.0, comfort_brake=3.0))
    np.testing.assert_allclose(params.accel_max, [2.0, 1.0, 0.92], rtol=1e-6)
    np.testing.assert_allclose(params.comfort_brake, [3.0, 2.7, 2.01], rtol=1e-6)
    assert params.min_gap == 2.0 and params.exponent == 4
    # 80 and 20 km/h
    np.testing.assert_allclose(vehicles.speed_cap(model)[1:], [80 / 3.6, 20 / 3.6], atol=0.05)


def test_typical_sizes():
    length, width = vehicles.typical_size(jnp.array([CAR, BUS]))
    np.testing.assert_allclose(length, [4.5, 10.1], rtol=1e-6)
    np.testing.assert_allclose(width, [2.0, 2.55], rtol=1e-6)
