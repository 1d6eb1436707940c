"""Background activity: which cars come back, where to, how fast, and never in sight."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_world import road

from carljax.sim import episodes, population, respawn, road_map_builder, spawn, town, traffic
from carljax.sim.population import Population
from carljax.sim.route import Route
from carljax.sim.types import KIND_NONE, EgoState

NUM_WORLDS, NUM_CARS, NUM_POINTS = 400, 6, 400
FRONT, BACK, SIDE = 78.0, 50.0, 64.0  # m, the image of CaRL


def make_ego(xy, yaw, speed):
    """Egos, one a row."""
    zeros = jnp.zeros(len(yaw), jnp.float32)
    fields = dict.fromkeys(EgoState.__dataclass_fields__, zeros)
    given = {"xy": xy, "yaw": yaw, "speed": speed}
    return EgoState(**fields | {name: jnp.asarray(x, jnp.float32) for name, x in given.items()})


respawn_all = jax.jit(
    jax.vmap(
        lambda agents, others, ego, routes, world, idx, road_map, key: respawn.respawn(
            agents, others, ego, routes, world, idx, road_map, key, spawn.CELL
        ),
        in_axes=(0, 0, 0, None, 0, 0, None, 0),
    )
)
initial_all = jax.jit(jax.vmap(traffic.initial, in_axes=(0, 0, 0, None, 0)))


@pytest.fixture(scope="module")
def road_map(bundled):
    """The grid, and a road of 300 m from x = -150 to 150 that ends there."""
    return road_map_builder.build([bundled["grid"], town.from_network(road(0, 300))])


TOWNS = np.arange(NUM_WORLDS) % 2  # of each world


@pytest.fixture(scope="module")
def routes(bundled, road_map):
    """A route for each world: 400 m through the grid, or along the road."""
    bank = episodes.make_bank([bundled["grid"]], 20, Population(1, 0, 0), 0, route_length=400.0)
    last = int(road_map.lane_length.shape[0]) - 1
    lane = np.full((NUM_WORLDS, NUM_POINTS), last)
    s = np.tile(np.minimum(np.arange(NUM_POINTS), 300.0), (NUM_WORLDS, 1))
    num = np.full(NUM_WORLDS, 301)
    for world in np.flatnonzero(TOWNS == 0):
        row = world // 2 % 20
        num[world] = min(int(bank.routes.num_points[row]), NUM_POINTS)
        lane[world] = np.asarray(bank.routes.lane[row])[:NUM_POINTS]
        s[world] = np.asarray(bank.routes.lane_s[row])[:NUM_POINTS]
    fields = dict.fromkeys(Route.__dataclass_fields__, jnp.zeros(NUM_WORLDS))
    given = {"lane": lane, "num_points": num, "town": TOWNS}
    whole = {name: jnp.asarray(x, jnp.int32) for name, x in given.items()}
    return Route(**fields | whole | {"lane_s": jnp.asarray(s, jnp.float32)})


def put(road_map, lane, s, seed=0, speed=0.0):
    """Agents at places on lanes, (B, N)."""
    keys = jax.random.split(jax.random.key(seed), len(lane))
    lane, s = jnp.asarray(lane, jnp.int32), jnp.asarray(s, jnp.float32)
    return initial_all(lane, s, jnp.full_like(s, speed), road_map, keys)


def places_in(road_map, rng):
    """Random places on lanes of each world's town."""
    lane_town, length = np.asarray(road_map.lane_town), np.asarray(road_map.lane_length)
    lane = np.stack([rng.choice(np.flatnonzero(lane_town == t), NUM_CARS) for t in TOWNS])
    return lane, rng.uniform(0, 1, lane.shape) * length[lane]


NOBODY = jax.tree.map(lambda x: jnp.stack([x] * NUM_WORLDS), population.nobody(1))
WORLDS = jnp.arange(NUM_WORLDS, dtype=jnp.int32)


def come_back(road_map, agents, ego, routes, idx, seed=5, others=NOBODY):
    keys = jax.random.split(jax.random.key(seed), NUM_WORLDS)
    idx = jnp.asarray(idx, jnp.int32)
    return respawn_all(agents, others, ego, routes, WORLDS, idx, road_map, keys)


@pytest.fixture(scope="module")
def ego(road_map, routes):
    """Egos somewhere on their routes, and the route point of each."""
    rng = np.random.default_rng(3)
    idx = rng.integers(60, 200, NUM_WORLDS)
    lane = np.asarray(routes.lane)[WORLDS, idx][:, None]
    at = put(road_map, lane, np.asarray(routes.lane_s)[WORLDS, idx][:, None])
    return make_ego(at.xy[:, 0], at.yaw[:, 0], np.full(NUM_WORLDS, 8.0)), idx


@pytest.fixture(scope="module")
def moved(road_map, routes, ego):
    """Random worlds before and after: the map, ego, agents before, agents after."""
    rng = np.random.default_rng(0)
    lane, s = places_in(road_map, rng)
    lane[rng.uniform(size=lane.shape) < 0.1] = -1  # empty slots
    before = put(road_map, lane, s, speed=5.0)
    after = come_back(road_map, before, ego[0], routes, ego[1])
    return jax.tree.map(np.asarray, (road_map, ego[0], before, after))


def changed(before, after):
    return (before.lanes != after.lanes).any(axis=-1) | (before.lane_s != after.lane_s)


def in_view(xy, ego_xy, ego_yaw, more=0.0):
    """Whether places (..., 2) lie within the image, in float64."""
    d = np.asarray(xy, float) - ego_xy
    ahead = d @ [np.cos(ego_yaw), np.sin(ego_yaw)]
    left = d @ [-np.sin(ego_yaw), np.cos(ego_yaw)]
    return (ahead < FRONT + more) & (ahead > -BACK - more) & (np.abs(left) < SIDE + more)


def test_at_most_one_car_a_step_and_often_one(moved):
    _, _, before, after = moved
    num = changed(before, after).sum(axis=1)
    assert num.max() == 1 and num.mean() > 0.2


def test_only_the_farthest_of_those_that_have_been_left_behind_is_moved(moved):
    rows, ego, before, after = moved
    near = 0
    for b, i in np.argwhere(changed(before, after)):
        offset = before.xy[b] - ego.xy[b].astype(float)
        away = np.hypot(*offset.T)
        yaw = before.yaw[b]
        velocity = before.speed[b][:, None] * np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
        velocity -= 8.0 * np.array([np.cos(ego.yaw[b]), np.sin(ego.yaw[b])])
        hidden = ~in_view(before.xy[b], ego.xy[b], ego.yaw[b], 6.0)
        length = rows.lane_length[before.lanes[b, :, 0]]
        ended = (before.lanes[b, :, 1] < 0) & (before.lane_s[b] > length - 8.0)
        leaves = (away > 100.0) & ((offset * velocity).sum(axis=1) > 0)
        gone = (away > 150.0) | ((ended | leaves) & hidden)
        gone &= before.kind[b] != KIND_NONE
        assert gone[i] and away[i] == away[gone].max()
        near += away[i] < 150
    assert near > 0


def test_they_come_back_out_of_sight_but_near(moved):
    rows, ego, before, after = moved
    for b, i in np.argwhere(changed(before, after)):
        # The whole car, up to 10 m long, is out of the image.
        assert not in_view(after.xy[b, i], ego.xy[b], ego.yaw[b], 5.0)
        # 135 m along the route, then up to 60 m down a junction's arm or 25 m across the road
        assert np.hypot(*(after.xy[b, i] - ego.xy[b])) < 135 + 60 + 20
        assert rows.lane_town[after.lanes[b, i, 0]] == TOWNS[b]
        assert not rows.lane_in_junction[after.lanes[b, i, 0]]


def test_they_come_back_where_there_is_room(moved):
    _, _, before, after = moved
    for b, i in np.argwhere(changed(before, after)):
        others = before.xy[b][before.kind[b] != KIND_NONE]
        assert np.hypot(*(others - after.xy[b, i]).T).min() > 14.0


def test_they_do_not_come_back_into_a_scenarios_car(moved, road_map, routes, ego):
    # In each world one stands just where a car came back before.
    _, _, before, after = moved
    which = changed(before, after)
    row = which.argmax(axis=1)
    there = jax.tree.map(lambda x: jnp.asarray(x[WORLDS, row][:, None]), after)
    again = come_back(road_map, before, ego[0], routes, ego[1], others=there)
    assert which.any() and not np.asarray(changed(before, again))[which.any(axis=1)].any()


def test_they_drive_on_along_the_lane_graph(moved):
    rows, _, before, after = moved
    for b, i in np.argwhere(changed(before, after)):
        lanes = after.lanes[b, i]
        if TOWNS[b] == 0:  # the grid has no dead end
            assert lanes[1] in rows.lane_successors[lanes[0]]
            assert lanes[2] in rows.lane_successors[lanes[1]]
        else:
            assert lanes[1:].tolist() == [-1, -1]
        assert after.wait_s[b, i] == 0 and not after.has_stopped[b, i]


def test_they_can_stop_behind_whom_they_follow_and_be_followed(moved):
    rows, _, before, after = moved
    fast = 0
    for b, i in np.argwhere(changed(before, after)):
        lane, s, speed = after.lanes[b, i, 0], after.lane_s[b, i], after.speed[b, i]
        used = (before.kind[b] != KIND_NONE) & (np.arange(NUM_CARS) != i)
        on = used & (before.lanes[b, :, 0] == lane)
        ahead = before.lane_s[b][on & (before.lane_s[b] > s)] - s - 10.0
        room = min([*ahead, rows.lane_length[lane] - s])
        # 3 m/s^2, and no faster than 0.9 of the limit
        assert speed**2 <= 2 * 3.0 * max(room, 0.0) + 1e-2
        assert speed <= 0.9 * rows.lane_speed_limit[lane] + 1e-4
        behind = s - before.lane_s[b][on & (before.lane_s[b] <= s)]
        closing = (5.0**2 - speed**2) / 6.0
        assert (behind >= closing + 10.0 - 1e-3).all()
        fast += speed > 7.0
    assert fast > 10


def test_nobody_else_notices(moved):
    _, _, before, after = moved
    still = ~changed(before, after)
    for name in ("lanes", "lane_s", "speed", "kind", "length", "width", "desired_speed_frac"):
        x, y = getattr(before, name), getattr(after, name)
        np.testing.assert_array_equal(x[still], y[still])
    np.testing.assert_allclose(before.xy[still], after.xy[still], atol=1e-5)
    np.testing.assert_array_equal(before.kind, after.kind)


def test_with_nobody_left_behind_nothing_happens(moved, road_map, routes, ego):
    _, _, before, _ = moved
    away = np.hypot(*np.moveaxis(before.xy - np.asarray(ego[0].xy)[:, None], -1, 0))
    near = (before.kind != KIND_NONE) & (away < 99.0) & (before.lanes[..., 1] >= 0)
    agents = before.replace(kind=np.where(near, before.kind, KIND_NONE))
    after = come_back(road_map, agents, ego[0], routes, ego[1])
    assert near.sum() > 100 and not np.asarray(changed(agents, after)).any()


@pytest.mark.parametrize(("yaw", "moves"), [(np.pi, True), (0.0, False)])
def test_at_a_dead_end_cars_are_taken_once_out_of_sight(road_map, routes, yaw, moves):
    # The car waits at the road's end; the ego is 70 m away and looks the other way (it sees 50 m
    # back) or towards the car (it sees 78 m ahead).
    last = int(road_map.lane_length.shape[0]) - 1
    lane = np.full((NUM_WORLDS, NUM_CARS), -1)
    lane[TOWNS == 1, 0] = last
    agents = put(road_map, lane, np.full(lane.shape, 297.0))
    still = np.zeros(NUM_WORLDS)
    ego = make_ego(np.tile([77.0, 0.0], (NUM_WORLDS, 1)), np.full(NUM_WORLDS, yaw), still)
    after = come_back(road_map, agents, ego, routes, np.full(NUM_WORLDS, 227))
    num = np.asarray(changed(agents, after)).sum()
    assert num >= 3 if moves else num == 0


def test_they_come_ahead_behind_oncoming_and_from_junction_arms(road_map, routes, ego):
    # One car far away in each world of the grid, drawn for again and again.
    rows = jax.tree.map(np.asarray, road_map)
    found = {"ahead": 0, "behind": 0, "oncoming": 0, "arm": 0}
    lane, s = np.asarray(routes.lane), np.asarray(routes.lane_s)
    agents = put(road_map, np.zeros((NUM_WORLDS, 1), int), np.full((NUM_WORLDS, 1), 20.0))
    agents = agents.replace(xy=jnp.full_like(agents.xy, 1e4))
    for seed in range(3):
        after = come_back(road_map, agents, ego[0], routes, ego[1], seed)
        for b in np.flatnonzero((TOWNS == 0) & np.asarray(changed(agents, after))[:, 0]):
            at, place = int(after.lanes[b, 0, 0]), float(after.lane_s[b, 0])
            away = np.flatnonzero(lane[b] == at) - ego[1][b]
            mine = np.abs(s[b][np.flatnonzero(lane[b] == at)] - place) < 1.5
            yaw = float(after.yaw[b, 0])
            route_xy = np.asarray(
                put_points(
                    rows,
                    lane[b, ego[1][b] + 80 : ego[1][b] + 140],
                    s[b, ego[1][b] + 80 : ego[1][b] + 140],
                )
            )
            to_route = np.hypot(*(route_xy[:, :2] - np.asarray(after.xy[b, 0])).T)
            turned = np.cos(route_xy[:, 2] - yaw)[to_route.argmin()]
            ends = rows.lane_successors[at]
            joins = np.isin(
                rows.lane_junction[ends[ends >= 0]],
                rows.lane_junction[lane[b, ego[1][b] : ego[1][b] + 140]],
            )
            if (mine & (away > 80)).any():
                found["ahead"] += 1
            elif (mine & (away < -50)).any():
                found["behind"] += 1
            elif to_route.min() < 25 and turned < -0.8:
                found["oncoming"] += 1
            elif joins.any():
                found["arm"] += 1
    assert min(found.values()) >= 10, found


def put_points(rows, lane, s):
    """x, y and yaw of places on lanes, (n, 3)."""
    count = rows.lane_num_points[lane]
    step = rows.lane_length[lane] / (count - 1)
    row = rows.lane_start[lane] + np.clip(np.rint(s / step), 0, count - 1).astype(int)
    return np.column_stack([rows.point_xy[row], rows.point_yaw[row]])
