"""How pedestrians move: where they walk, how fast, what they choose, and where they appear."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_world import road
from traffic_world import DT, f32, make_ego
from walking_world import (
    EGO_SIZE,
    car,
    crowds,
    initial,
    inside,
    live_all,
    node_at,
    street,
    stroll_jit,
    to_pavement,
    walker,
)

from carljax.reward.config import RewardConfig
from carljax.sim import crowd, episodes, geometry, pedestrians, population, spawn, town, traffic
from carljax.sim import env as env_module
from carljax.sim import road_map_builder as builder
from carljax.sim.env import EnvConfig
from carljax.sim.raster_canvas import RasterConfig
from carljax.sim.road_map import WALK_CROSSING, WALK_JAYWALK, WALK_PAVEMENT
from carljax.sim.types import KIND_PEDESTRIAN, Walkers

AFAR = make_ego()
NOBODY = population.nobody(1)


@pytest.fixture(scope="module")
def road_map():
    """The street."""
    return builder.build([town.from_network(street())])


def alone(road_map, bodies, walkers, seed=0, cars=NOBODY, num_steps=300):
    """Bodies and walkers of 30 s, NumPy, and no ego."""
    key = jax.random.key(seed)
    path = stroll_jit(road_map, bodies, walkers, cars, AFAR, num_steps, key)
    return jax.tree.map(np.asarray, path[:2])


def test_along_a_straight_pavement_at_their_own_pace(road_map):
    bodies, walkers = walker(road_map, (-90.0, 4.5), (-87.0, 4.5), pace=1.3, offset=0.3)
    bodies, _ = alone(road_map, bodies, walkers)
    # 1.3 m/s at 2 m/s^2 takes 0.65 s and 0.4225 m; steps of 0.1 s end at it in the seventh.
    np.testing.assert_allclose(bodies.speed[:7, 0], [0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.3], atol=0.03)
    # From x = -90.9, the nearest node: 10 s less the half of 0.65 s at 1.3 m/s.
    start = np.asarray(road_map.walk_xyz)[node_at(road_map, -90.0, 4.5), 0]
    np.testing.assert_allclose(bodies.xy[99, 0, 0], start + 1.3 * (10 - 0.325), atol=0.1)
    # To the east, so left is north: 0.3 m beside the middle at 4.5 m.
    np.testing.assert_allclose(bodies.xy[99, 0, 1], 4.8, atol=0.01)
    np.testing.assert_allclose(bodies.yaw[99, 0], 0.0, atol=0.02)


def test_speed_turning_and_acceleration_are_those_of_the_motion(road_map):
    bodies, walkers = walker(road_map, (0.0, -4.5), (0.0, -3.9), pace=1.8)
    path, minds = alone(road_map, bodies, walkers)
    xy, yaw = path.xy[:, 0].astype(float), path.yaw[:, 0].astype(float)
    step = np.hypot(*np.diff(xy, axis=0).T)
    np.testing.assert_allclose((path.speed[1:, 0] + path.speed[:-1, 0]) / 2, step / DT, atol=2e-3)
    turn = (np.diff(yaw) + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(path.yaw_rate[1:, 0], turn / DT, atol=1e-3)
    change = np.diff(path.speed[:, 0].astype(float)) / DT
    np.testing.assert_allclose(path.accel[1:, 0], change, atol=1e-3)
    way = np.arctan2(*np.diff(xy, axis=0)[step > 0.01].T[::-1])
    off = (way - yaw[1:][step > 0.01] + np.pi) % (2 * np.pi) - np.pi
    assert abs(off).max() < 1e-2  # they walk where they look
    assert abs(turn).max() <= 3.0 * DT + 1e-5 and len(np.unique(minds.target)) > 5


def test_across_the_road_when_it_is_free(road_map):
    bodies, walkers = walker(road_map, (0.0, -4.5), (0.0, -3.9), pace=1.4)
    path, _ = alone(road_map, bodies, walkers)
    x, y = path.xy[:, 0].T
    arrives = int(np.argmax(y > 3.9))
    # 8.4 m: the first 0.6 m at no more than 1.2 m/s, the rest at 1.4 m/s; starting costs 0.35 s.
    assert 5.9 < arrives * DT < 7.0
    assert abs(x[:arrives]).max() < 0.35  # on the crosswalk, 3 m


def test_they_wait_for_a_car_and_then_go(road_map):
    bodies, walkers = walker(road_map, (0.0, -4.5), (0.0, -3.9))
    path, _ = alone(road_map, bodies, walkers, cars=car(-25.0, -1.75, 6.0))
    y = path.xy[:, 0, 1]
    passes = int((25.0 - 2.0) / 6.0 / DT)  # its front is at the crosswalk after 3.8 s
    assert y[passes] < -3.9 + 0.6 and path.speed[passes - 5, 0] == 0.0
    assert abs(path.yaw[passes - 5, 0] - np.pi / 2) < 0.1  # looks across
    assert y[-1] > 3.9
    out = int(np.argmax(y > -3.0))
    assert passes * DT < out * DT < (passes * DT + 4.0 / 6.0 + 1.5)


def test_who_never_gets_a_gap_walks_on(road_map):
    # A car every 15 m at 10 m/s, 100 of them, for 150 s.
    one = car(0.0, -1.75, 10.0)
    num = 100
    cars = jax.tree.map(lambda x: jnp.broadcast_to(x, (num, *x.shape[1:])), one)
    x = -10.0 - 15.0 * jnp.arange(num, dtype=jnp.float32)
    cars = cars.replace(xy=jnp.stack([x, jnp.full(num, -1.75, jnp.float32)], axis=-1))
    bodies, walkers = walker(road_map, (0.0, -4.5), (0.0, -3.9))
    path, _ = alone(road_map, bodies, walkers, cars=cars, num_steps=400)
    y, x = path.xy[:, 0, 1], path.xy[:, 0, 0]
    assert (abs(x[:190]) < 0.5).all() and y[:190].max() < -3.2  # waits for 20 s
    assert abs(x[-1]) > 10.0 and y.max() < -3.2  # then goes elsewhere


@pytest.fixture(scope="module")
def choices(road_map):
    """Next nodes of 4,000 people who arrive on the pavement at the crosswalk and elsewhere."""
    graph = town.from_network(street()).walks

    def share(node, came_from):
        num = 4000
        walkers = Walkers(
            node=jnp.full(num, came_from, jnp.int32),
            target=jnp.full(num, node, jnp.int32),
            pace=jnp.full(num, 1.4, jnp.float32),
            offset=jnp.zeros(num, jnp.float32),
            is_reckless=jnp.zeros(num, bool),
        )
        bodies = initial(walkers, road_map)
        bodies = bodies.replace(xy=road_map.walk_xyz[walkers.target, :2])
        one = jax.jit(pedestrians.step, static_argnums=7)
        _, after = one(bodies, walkers, NOBODY, AFAR, EGO_SIZE, road_map, jax.random.key(0), DT)
        return np.bincount(np.asarray(after.target), minlength=len(graph.xyz)) / num

    return graph, share


@pytest.mark.parametrize(("x", "want"), [(0.0, 1 / 3), (18.18, 0.03 / 1.03), (5.0, 0.0)])
def test_they_mostly_go_straight_on(road_map, choices, x, want):
    graph, share = choices
    node = node_at(road_map, x, -4.5)
    beside = [
        n
        for n, k in zip(graph.neighbours[node], graph.kind[node], strict=True)
        if n >= 0 and k == WALK_PAVEMENT
    ]
    came_from = min(beside, key=lambda n: graph.xyz[n, 0])
    onward = max(beside, key=lambda n: graph.xyz[n, 0])
    found = share(node, came_from)
    # Sums of chances: 1 straight on, 0.5 to the crosswalk or 0.03 to cross elsewhere.
    np.testing.assert_allclose(found[onward], 1 - want, atol=0.025)
    assert found[came_from] < 2e-3 and found[: len(graph.xyz)].sum() == 1.0


def test_at_the_end_of_a_pavement_they_turn_round(road_map, choices):
    graph, share = choices
    end = node_at(road_map, 100.0, -4.5)
    before = int(graph.neighbours[end][graph.neighbours[end] >= 0][0])
    assert share(end, before)[before] == 1.0
    bodies, walkers = walker(road_map, (97.0, -4.5), (100.0, -4.5))
    path, _ = alone(road_map, bodies, walkers)
    assert path.xy[:, 0, 0].max() < 101.0 and path.xy[150, 0, 0] < 92.0
    assert abs(path.xy[:150, 0, 1] + 4.5).max() < 1.0


def test_alone_means_the_same_as_among_others(road_map):
    # What one does depends on no other pedestrian, but for the draws.
    first, minds = walker(road_map, (0.0, -4.5), (0.0, -3.9), offset=0.2)
    second, others = walker(road_map, (-90.0, 4.5), (-87.0, 4.5))
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), (first, minds), (second, others))
    one, _ = alone(road_map, first, minds)
    two, _ = alone(road_map, *both)
    np.testing.assert_allclose(one.xy[:50, 0], two.xy[:50, 0], atol=1e-5)


def test_same_key_same_way(road_map):
    bodies, walkers = walker(road_map, (0.0, -4.5), (0.0, -3.9))
    paths = [alone(road_map, bodies, walkers, seed)[0].xy for seed in (0, 0, 1, 2, 3)]
    np.testing.assert_array_equal(paths[0], paths[1])
    assert any((paths[0] != other).any() for other in paths[2:])


NUM_TOWNS, NUM_WALKERS, NUM_CARS, NUM_STEPS = 6, 12, 14, 700


@pytest.fixture(scope="module")
def village(bundled):
    """70 s in six copies of the village: town, map, cars, bodies and walkers over time."""
    one = bundled["village"]
    rows, rng = builder.build([one]), np.random.default_rng(1)
    found = spawn.places(one.lanes)
    chosen = np.stack([rng.permutation(len(found.lane))[:NUM_CARS] for _ in range(NUM_TOWNS)])
    start = jax.jit(jax.vmap(traffic.initial, in_axes=(0, 0, 0, None, 0)))
    keys = jax.random.split(jax.random.key(0), NUM_TOWNS)
    lane = jnp.asarray(found.lane[chosen], jnp.int32)
    cars = start(lane, f32(found.s[chosen]), jnp.zeros(lane.shape, jnp.float32), rows, keys)
    around = one.walks.xyz[rng.choice(np.flatnonzero(~one.walks.is_kerb), NUM_TOWNS), :2]
    walkers = crowds(one.walks, around, NUM_WALKERS, rng)
    bodies = jax.vmap(initial, in_axes=(0, None))(walkers, rows)
    path = live_all(rows, cars, bodies, walkers, keys, NUM_STEPS)
    return one, rows, *jax.tree.map(np.asarray, path)


def edge_kinds(graph, walkers):
    """WALK_* of the edge that each walker is on."""
    kind = np.zeros(walkers.node.shape, int)
    for column in range(graph.neighbours.shape[1]):
        is_it = graph.neighbours[walkers.node, column] == walkers.target
        kind = np.where(is_it, graph.kind[walkers.node, column], kind)
    return kind


def test_people_stay_on_pavements_and_crosswalks(village):
    one, _, _, bodies, walkers = village
    kind = edge_kinds(one.walks, walkers)[:, ::7]
    xy = bodies.xy[:, ::7]
    along = to_pavement(one.network, xy[kind == WALK_PAVEMENT].astype(float))
    # Beside a crosswalk that reaches beyond a pavement they are up to 3 m off it.
    assert (along > 0.3).mean() < 0.03 and along.max() < 3.5
    crossing = xy[kind == WALK_CROSSING].astype(float)
    on = np.zeros(len(crossing), bool)
    for polygon in one.network.crosswalks:
        middle = polygon[:, :2].mean(axis=0)
        on |= inside(middle + 1.25 * (polygon[:, :2] - middle), crossing)
    assert len(crossing) > 20 and (on | (to_pavement(one.network, crossing) < 0.3)).all()
    assert (kind == WALK_JAYWALK).mean() < 0.1


def test_hardly_anybody_is_struck(village, record_property):
    _, _, cars, bodies, walkers = village
    touch = geometry.boxes_overlap(
        bodies.xy[:, :, :, None],
        bodies.yaw[..., None],
        0.5,
        0.5,
        cars.xy[:, :, None],
        cars.yaw[:, :, None],
        cars.length[:, :, None],
        cars.width[:, :, None],
    )
    struck = np.asarray(touch & (cars.speed[:, :, None] > 0.5))
    begins = struck[:, 1:] & ~struck[:, :-1]
    careful = ~walkers.is_reckless[:, 0]
    km = (bodies.speed.sum(axis=1) * DT / 1000.0)[careful].sum()
    rate = begins.any(axis=-1).sum(axis=1)[careful].sum() / km
    record_property("careful pedestrians struck per km walked", float(rate))
    assert km > 4.0 and rate < 0.15


def test_people_keep_moving(village):
    _, _, cars, bodies, _ = village
    assert bodies.speed.mean() > 1.1 and (bodies.speed[:, -100:] < 0.1).mean() < 0.15
    assert cars.speed[:, 300:].mean() > 3.0


respawn_all = jax.jit(
    jax.vmap(
        functools.partial(pedestrians.respawn, cell_size=spawn.CELL),
        in_axes=(0, 0, 0, 0, None, 0),
    )
)


@pytest.fixture(scope="module")
def moved(bundled):
    """300 worlds before and after: town, egos, bodies and walkers before and after."""
    one = bundled["grid"]
    rows, rng, num = builder.build([one]), np.random.default_rng(0), 300
    nodes = np.flatnonzero(~one.walks.is_kerb)
    walkers = [
        crowd.draw(one.walks, 0, one.walks.xyz[n, :2], 6, rng) for n in rng.choice(nodes, num)
    ]
    # Some of them far off, so that not everybody is near the ego.
    egos = one.walks.xyz[rng.choice(nodes, num), :2]
    minds = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *walkers)
    bodies = jax.vmap(initial, in_axes=(0, None))(minds, rows)
    empty = make_ego()
    ego = jax.tree.map(lambda x: jnp.broadcast_to(x, (num, *x.shape)), empty)
    ego = ego.replace(xy=f32(egos), yaw=f32(rng.uniform(-np.pi, np.pi, num)))
    keys = jax.random.split(jax.random.key(0), num)
    after = respawn_all(bodies, minds, ego, jnp.zeros(num, jnp.int32), rows, keys)
    return one, *jax.tree.map(np.asarray, (ego, bodies, minds, *after))


def seen_from(ego, xy):
    """(B, N) m ahead and to the left of each ego, float64."""
    d = xy.astype(float) - ego.xy[:, None]
    cos, sin = np.cos(ego.yaw)[:, None], np.sin(ego.yaw)[:, None]
    return d[..., 0] * cos + d[..., 1] * sin, d[..., 1] * cos - d[..., 0] * sin


def test_one_a_step_appears_out_of_sight_and_not_behind(moved):
    one, ego, before, _, after, minds = moved
    changed = (before.xy != after.xy).any(axis=-1) | (before.kind != after.kind)
    assert changed.sum(axis=1).max() == 1 and 0.2 < changed.sum(axis=1).mean()
    ahead, left = seen_from(ego, after.xy)
    assert ((ahead > 80.0) | (abs(left) > 66.0))[changed].all()  # the image shows 78 m and 64 m
    assert (ahead > -52.0)[changed].all()
    assert np.hypot(ahead, left)[changed].max() < 115.0 + 14.2  # the ring and half a cell
    assert (after.kind[changed] == KIND_PEDESTRIAN).all()
    assert (after.speed[changed] == minds.pace[changed]).all()
    np.testing.assert_allclose(after.xy[changed], one.walks.xyz[minds.node[changed], :2], atol=1e-4)
    neighbours = one.walks.neighbours[minds.node[changed]]
    kinds = one.walks.kind[minds.node[changed]]
    assert ((neighbours == minds.target[changed][:, None]) & (kinds == WALK_PAVEMENT)).any(1).all()


def test_only_who_is_not_there_yet_or_left_behind_is_moved(moved):
    _, ego, before, minds, after, _ = moved
    changed = (before.xy != after.xy).any(axis=-1) | (before.kind != after.kind)
    ahead, left = seen_from(ego, before.xy)
    away = np.hypot(ahead, left)
    here = before.kind == KIND_PEDESTRIAN
    gone = here & ((away > 130.0) | (ahead < -60.0))
    absent = ~here & (minds.pace > 0)
    assert (gone | absent)[changed].all() and gone[changed].any()
    assert not (changed & (minds.pace == 0)).any()
    for b, i in np.argwhere(changed & gone):
        assert not absent[b].any() and away[b, i] == away[b][gone[b]].max()


def test_people_who_are_not_there_yet_appear(moved):
    one, ego, bodies, minds, _, _ = moved
    gone = bodies.replace(kind=np.zeros_like(bodies.kind))
    rows = builder.build([one])
    zeros = jnp.zeros(len(ego.yaw), jnp.int32)
    arrived = 0
    for seed in range(20):
        keys = jax.random.split(jax.random.key(seed), len(ego.yaw))
        gone, minds = respawn_all(gone, minds, ego, zeros, rows, keys)
        now = (np.asarray(gone.kind) == KIND_PEDESTRIAN).sum()
        assert now >= arrived
        arrived = now
    wanted = (np.asarray(minds.pace) > 0).sum()
    assert arrived > 0.5 * wanted
    assert not (np.asarray(gone.kind)[np.asarray(minds.pace) == 0]).any()


def test_the_first_crowd_stands_on_pavements_near_the_start(bundled):
    graph, rng, start = bundled["village"].walks, np.random.default_rng(3), np.array([0.0, 40.0])
    sizes, paces = [], []
    for _ in range(200):
        one = crowd.draw(graph, 1000, start, 12, rng)
        here = one.node >= 0
        sizes.append(here.sum())
        paces.append(one.pace[one.pace > 0])
        assert not graph.is_kerb[one.node[here] - 1000].any()
        assert np.hypot(*(graph.xyz[one.node[here] - 1000, :2] - start).T).max() < 110.0
        assert (one.target[here] != one.node[here]).all() and (one.target[~here] == -1).all()
        assert (one.pace[here] > 0).all() and abs(one.offset).max() <= 0.45
    paces = np.concatenate(paces)
    assert min(sizes) == 3 and max(sizes) == 12  # a quarter to all
    assert 1.2 < paces.mean() < 1.5 and paces.min() >= 0.9 and paces.max() <= 2.8
    assert 0.02 < (paces > 2.0).mean() < 0.1


def environment(towns, num_pedestrians):
    config = EnvConfig(
        num_agents=2,
        num_pedestrians=num_pedestrians,
        num_scenario_slots=0,
        route_length=80.0,
        raster=RasterConfig(16, 16, pixels_per_metre=0.5, ego_from_bottom_px=6),
    )
    bank = episodes.make_bank(towns, 2 * len(towns), config.population, 0, 80.0)
    return env_module.make_env(bank, config, RewardConfig())


def test_the_environment_has_pedestrians_and_keeps_its_types(bundled):
    env = environment([bundled["grid"]], 5)
    rows = env.config.population.walkers
    assert (np.asarray(env.bank.agents.kind)[:, rows] == KIND_PEDESTRIAN).sum() >= 2
    state = jax.eval_shape(env.reset, jax.random.key(0))
    after = jax.eval_shape(env.step, state, jax.ShapeDtypeStruct((2,), jnp.float32))
    same = jax.tree.map(
        lambda a, b: (a.shape, a.dtype, a.weak_type) == (b.shape, b.dtype, b.weak_type),
        state,
        after,
    )
    assert jax.tree.all(same)


def test_a_town_without_pavements_works(bundled):
    env = environment([town.from_network(road(0, 150, 400))], 5)
    agents = jax.tree.map(lambda x: x[0], env.bank.agents)
    walkers = jax.tree.map(lambda x: x[0], env.bank.walkers)
    walk = jax.jit(lambda env, a, w, ego, key: env._walk(a, w, ego, jnp.int32(0), key))
    ego = make_ego((0.0, 0.0))
    for seed in range(5):
        agents, walkers = walk(env, agents, walkers, ego, jax.random.key(seed))
    rows = env.config.population.walkers
    assert not np.asarray(agents.kind)[rows].any()
    assert all(np.isfinite(np.asarray(x)).all() for x in jax.tree.leaves((agents, walkers)))
