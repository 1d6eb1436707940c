"""Cars far behind come back: which, where to, and never in sight."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_world import road

from carljax.sim import population, respawn, road_map_builder, spawn, town, traffic, vehicles
from carljax.sim.types import KIND_NONE, EgoState

NUM_WORLDS, NUM_CARS = 300, 6
FRONT, BACK, SIDE = 80.0, 52.0, 66.0  # m, the image of CaRL reaches 78, 50 and 64 m


def make_ego(xy, yaw):
    """Egos, one a row."""
    zeros = jnp.zeros(len(yaw), jnp.float32)
    fields = dict.fromkeys(EgoState.__dataclass_fields__, zeros)
    xy, yaw = (jnp.asarray(x, jnp.float32) for x in (xy, yaw))
    return EgoState(**fields | {"xy": xy, "yaw": yaw})


respawn_all = jax.jit(
    jax.vmap(
        lambda agents, others, ego, town, road_map, key: respawn.respawn(
            agents, others, ego, town, road_map, key, spawn.CELL
        ),
        in_axes=(0, 0, 0, 0, None, 0),
    )
)
initial_all = jax.jit(jax.vmap(traffic.initial, in_axes=(0, 0, 0, None, 0)))


@pytest.fixture(scope="module")
def road_map(bundled):
    """The grid, and a road of 300 m from x = -150 to 150 that ends there."""
    return road_map_builder.build([bundled["grid"], town.from_network(road(0, 300))])


TOWNS = np.arange(NUM_WORLDS) % 2  # of each world


def put(road_map, lane, s, seed=0):
    """Agents at rest at places on lanes, (B, N)."""
    keys = jax.random.split(jax.random.key(seed), len(lane))
    lane, s = jnp.asarray(lane, jnp.int32), jnp.asarray(s, jnp.float32)
    return initial_all(lane, s, jnp.zeros_like(s), road_map, keys)


def places_in(road_map, rng):
    """Random places on lanes of each world's town."""
    lane_town, length = np.asarray(road_map.lane_town), np.asarray(road_map.lane_length)
    lane = np.stack([rng.choice(np.flatnonzero(lane_town == t), NUM_CARS) for t in TOWNS])
    return lane, rng.uniform(0, 1, lane.shape) * length[lane]


NOBODY = jax.tree.map(lambda x: jnp.stack([x] * NUM_WORLDS), population.nobody(1))


def come_back(road_map, agents, ego, towns, seed=5, others=NOBODY):
    keys = jax.random.split(jax.random.key(seed), NUM_WORLDS)
    return respawn_all(agents, others, ego, jnp.asarray(towns, jnp.int32), road_map, keys)


@pytest.fixture(scope="module")
def moved(road_map):
    """Random worlds before and after: the map, ego, agents before, agents after."""
    rng = np.random.default_rng(0)
    lane, s = places_in(road_map, rng)
    lane[rng.uniform(size=lane.shape) < 0.1] = -1  # empty slots
    at = put(road_map, *places_in(road_map, rng), 1)
    ego = make_ego(at.xy[:, 0], at.yaw[:, 0])
    before = put(road_map, lane, s)
    after = come_back(road_map, before, ego, TOWNS)
    return jax.tree.map(np.asarray, (road_map, ego, before, after))


def changed(before, after):
    return (before.lanes != after.lanes).any(axis=-1) | (before.lane_s != after.lane_s)


def in_view(xy, ego_xy, ego_yaw):
    """Whether places (..., 2) lie within the image, in float64."""
    d = np.asarray(xy, float) - ego_xy
    ahead = d @ [np.cos(ego_yaw), np.sin(ego_yaw)]
    left = d @ [-np.sin(ego_yaw), np.cos(ego_yaw)]
    return (ahead < FRONT) & (ahead > -BACK) & (np.abs(left) < SIDE)


def test_at_most_one_car_a_step_and_often_one(moved):
    _, _, before, after = moved
    num = changed(before, after).sum(axis=1)
    assert num.max() == 1 and num.mean() > 0.3


def test_only_the_farthest_of_those_out_of_reach_is_moved(moved):
    rows, ego, before, after = moved
    num_ended = 0
    for b, i in np.argwhere(changed(before, after)):
        away = np.hypot(*(before.xy[b] - ego.xy[b]).T)
        length = rows.lane_length[before.lanes[b, :, 0]]
        ended = (before.lanes[b, :, 1] < 0) & (before.lane_s[b] > length - 8.0)
        ended &= ~in_view(before.xy[b], ego.xy[b], ego.yaw[b])
        gone = ((away > 150.0) | ended) & (before.kind[b] != KIND_NONE)
        assert gone[i] and away[i] == away[gone].max()
        num_ended += away[i] < 150
    assert num_ended > 0


def test_they_come_back_out_of_sight_but_near(moved):
    rows, ego, before, after = moved
    for b, i in np.argwhere(changed(before, after)):
        assert not in_view(after.xy[b, i], ego.xy[b], ego.yaw[b])
        # The ring is 60 to 140 m from the middle of the ego's cell, 14 m from its corners.
        assert 60 - 14.2 < np.hypot(*(after.xy[b, i] - ego.xy[b])) < 140 + 14.2
        assert rows.lane_town[after.lanes[b, i, 0]] == TOWNS[b]
        assert not rows.lane_in_junction[after.lanes[b, i, 0]]


def test_they_come_back_where_there_is_room(moved):
    _, _, before, after = moved
    for b, i in np.argwhere(changed(before, after)):
        others = before.xy[b][before.kind[b] != KIND_NONE]
        assert np.hypot(*(others - after.xy[b, i]).T).min() > 14.0


def test_they_do_not_come_back_into_a_scenarios_car(moved, road_map):
    _, ego, before, after = moved
    there = changed(before, after)
    who = there.argmax(axis=1)
    xy = after.xy[np.arange(NUM_WORLDS), who] + [13.9 / np.sqrt(2)] * 2  # 14 m are kept
    others = NOBODY.replace(xy=jnp.float32(xy[:, None]), kind=jnp.ones_like(NOBODY.kind))
    again = come_back(road_map, before, ego, TOWNS, others=others)
    assert there.any(axis=1).sum() > 50 and not changed(before, again)[there.any(axis=1)].any()


def test_they_drive_on_along_the_lane_graph(moved):
    rows, _, before, after = moved
    for b, i in np.argwhere(changed(before, after)):
        lanes = after.lanes[b, i]
        if TOWNS[b] == 0:  # the grid has no dead end
            assert lanes[1] in rows.lane_successors[lanes[0]]
            assert lanes[2] in rows.lane_successors[lanes[1]]
        else:
            assert lanes[1:].tolist() == [-1, -1]
        limit = min(rows.lane_speed_limit[lanes[0]], rows.lane_curve_speed[lanes[0]])
        # no faster than stops within 14 - 6 m at 3 m/s^2
        cap = vehicles.CLASSES[after.model[b, i]].speed_cap
        want = min(0.8 * limit, np.sqrt(2 * 3.0 * 8.0), cap)
        np.testing.assert_allclose(after.speed[b, i], want, rtol=1e-5)
        assert after.wait_s[b, i] == 0 and not after.has_stopped[b, i]


def test_nobody_else_notices(moved):
    _, _, before, after = moved
    still = ~changed(before, after)
    for name in ("lanes", "lane_s", "speed", "kind", "length", "width", "desired_speed_frac"):
        x, y = getattr(before, name), getattr(after, name)
        np.testing.assert_array_equal(x[still], y[still])
    np.testing.assert_allclose(before.xy[still], after.xy[still], atol=1e-5)
    np.testing.assert_array_equal(before.kind, after.kind)


def test_with_nobody_far_away_nothing_happens(moved, road_map):
    _, ego, before, _ = moved
    away = np.hypot(*np.moveaxis(before.xy - ego.xy[:, None], -1, 0))
    near = (before.kind != KIND_NONE) & (away < 149.0) & (before.lanes[..., 1] >= 0)
    agents = before.replace(kind=np.where(near, before.kind, KIND_NONE))
    after = come_back(road_map, agents, ego, TOWNS)
    assert near.sum() > 100 and not np.asarray(changed(agents, after)).any()


@pytest.mark.parametrize(("yaw", "moves"), [(np.pi, True), (0.0, False)])
def test_at_a_dead_end_cars_are_taken_once_out_of_sight(road_map, yaw, moves):
    # The car waits at the road's end; the ego is 70 m away and looks the other way (it sees 50 m
    # back) or towards the car (it sees 78 m ahead).
    last = int(road_map.lane_length.shape[0]) - 1
    lane = np.full((NUM_WORLDS, NUM_CARS), -1)
    lane[:, 0] = last
    agents = put(road_map, lane, np.full(lane.shape, 297.0))
    ego = make_ego(np.tile([77.0, 0.0], (NUM_WORLDS, 1)), np.full(NUM_WORLDS, yaw))
    after = come_back(road_map, agents, ego, np.ones(NUM_WORLDS))
    num = np.asarray(changed(agents, after)).sum()
    assert num > 30 if moves else num == 0
