"""nuPlan's image: by hand, against a dense float64 drawing of the file's lanes, and in a batch."""

from __future__ import annotations

import dataclasses
import functools
import math

import chex
import jax
import jax.numpy as jnp
import kinds_oracle
import numpy as np
import pytest
from crossing_world import agents_of

from carljax.reward.config import RewardConfig
from carljax.sim import episodes, observation, raster_nuplan, road_blocks, route
from carljax.sim.env import EnvConfig, make_env
from carljax.sim.population import Population
from carljax.sim.raster_canvas import RasterConfig
from carljax.sim.raster_nuplan import CHANNELS, NuplanOptions
from carljax.sim.types import KIND_PEDESTRIAN, KIND_STATIC, KIND_VEHICLE, STOP_LIGHT

SMALL = RasterConfig(height=112, width=96, pixels_per_metre=1.5, ego_from_bottom_px=40)
DRIVABLE, ROUTE, BORDERS, LIGHTS, STOPS, LIMITS, CARS, WALKERS, EGO = range(9)
CAR = {"length": 4.0, "width": 2.0, "kind": KIND_VEHICLE}


def environment(bundled):
    """The grid and the village with two routes each."""
    there = [bundled["grid"], bundled["village"]]
    bank = episodes.make_bank(there, 4, Population(2, 0, 0), 5, route_length=400.0)
    config = EnvConfig(
        num_agents=2, num_pedestrians=0, num_scenario_slots=0, observation="nuplan", raster=SMALL
    )
    return make_env(bank, config, RewardConfig())


@pytest.fixture(scope="module")
def env(bundled):
    return environment(bundled)


@functools.partial(jax.jit, static_argnames=("config", "options"))
def _render(env, sim, agents, config, options):
    stretch, _ = route.window(env.bank.routes, sim.episode_idx, sim.route_idx)
    size = jnp.array([4.892, 1.836])
    return raster_nuplan.render(
        sim.ego, size, agents, env.bank.road_map, env.nuplan, stretch, sim.episode_idx, sim.lights,
        options, config,
    )  # fmt: skip


def draw(env, sim, agents=None, config=SMALL, options=NuplanOptions()):  # noqa: B008
    """The image as int."""
    agents = agents_of() if agents is None else agents
    image = _render(env, sim, agents, config, options)
    assert image.shape == (config.height, config.width, 9) and image.dtype == jnp.uint8
    return np.asarray(image).astype(int)


def place(env, episode, idx, turn=0.0, time=3.0, **ego):
    """The state of an ego on its route, turned a little."""
    state = jax.jit(env.start_episode)(jnp.int32(episode), jax.random.key(0))
    sim, routes = state.pipeline_state, env.bank.routes
    ego = sim.ego.replace(
        xy=routes.xy[episode, idx],
        yaw=routes.yaw[episode, idx] + turn,
        **{name: jnp.float32(value) for name, value in ego.items()},
    )
    lights = sim.lights.replace(time=jnp.float32(time))
    return sim.replace(ego=ego, route_idx=jnp.int32(idx), lights=lights)


def at(sim, ahead, left, **user):
    """A road user so far ahead and to the left of the ego, facing as it does unless said."""
    x, y, yaw = float(sim.ego.xy[0]), float(sim.ego.xy[1]), float(sim.ego.yaw)
    cos, sin = math.cos(yaw), math.sin(yaw)
    user = {"yaw": yaw, "z": float(sim.ego.z)} | user
    return user | {"x": x + cos * ahead - sin * left, "y": y + sin * ahead + cos * left}


def before_light(env, episode):
    """A route index some metres before a light."""
    routes = env.bank.routes
    lights = np.flatnonzero(np.asarray(routes.stop_kind[episode]) == STOP_LIGHT)
    return int(routes.stop_idx[episode, lights[0]]) - 8


def test_boxes_and_their_bytes(env):
    sim = place(env, 0, 60, speed=10.0)
    users = [
        at(sim, 20.2, 0.2, **CAR, speed=15.0),
        at(sim, 10.2, -5.2, kind=KIND_PEDESTRIAN, length=2.0, width=2.0, speed=1.0),
        at(sim, 10.2, 5.2, kind=KIND_STATIC, length=2.0, width=2.0),
        at(sim, 200.0, 0.0, **CAR),
        at(sim, 0.0, 33.0, length=8.0, width=2.0, kind=KIND_VEHICLE, yaw=float(sim.ego.yaw) + 1.57),
    ]
    image = draw(env, sim, agents_of(*users), raster_nuplan.RASTER)
    # int(127.5 * 15 / 30 + 127.5) = 191, int(127.5 / 4 + 127.5) = 159, at rest 127.
    cars = image[..., CARS]
    rows, columns = np.nonzero(cars == 191)
    # Rows 156 - 2 (20.2 +- 2) = 111.6 ... 119.6, columns 128 - 2 (0.2 +- 1) = 125.6 ... 129.6.
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (112, 119, 126, 129)
    assert np.count_nonzero(cars == 127) > 0  # across, its middle in the image
    rows, columns = np.nonzero(image[..., WALKERS] == 159)
    # To the right: columns 128 + 2 (5.2 +- 1) = 136.4 ... 140.4.
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (134, 137, 136, 139)
    rows, columns = np.nonzero(image[..., WALKERS] == 127)
    assert (columns.min(), columns.max()) == (116, 119)
    # The ego, 4.892 x 1.836 m around row 156 and column 128, int(127.5 / 3 + 127.5) = 170.
    rows, columns = np.nonzero(image[..., EGO])
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (151, 160, 126, 129)
    assert set(image[rows, columns, EGO]) == {170} and len(rows) == 10 * 4


def test_whoever_is_centred_outside_the_image_is_left_out(env):
    sim = place(env, 0, 60)
    for left, seen in ((31.9, True), (32.1, False)):
        user = at(sim, 5.0, left, **CAR | {"yaw": float(sim.ego.yaw) + 1.57})
        assert draw(env, sim, agents_of(user))[..., CARS].any() == seen


@pytest.mark.parametrize(("speed", "most", "value"), [(0, 30, 127), (15, 30, 191), (99, 30, 255)])
def test_bytes_of_speeds(speed, most, value):
    assert int(raster_nuplan.speed_value(jnp.float32(speed), most)) == value


def test_speed_lines_reach_a_second_ahead_of_the_front(env):
    sim = place(env, 0, 60, speed=5.0)
    car = agents_of(at(sim, 20.2, 5.2, **CAR, speed=10.0))
    image = draw(env, sim, car, raster_nuplan.RASTER, NuplanOptions(speed_line=True))
    # From the middle (20.2) to 2 + 10 m on: row 156 - 2 * 32.2 = 91.6, in column 128 - 10.4.
    rows, columns = np.nonzero(image[..., CARS])
    assert rows.min() == 91 and set(columns[rows < 110]) == {117}
    # The ego's: row 156 - 2 (2.446 + 5) = 141.1.
    assert np.flatnonzero(image[..., EGO].any(axis=1)).min() in (141, 142)


def test_stop_lines_only_where_asked_for(env):
    sim = place(env, 0, before_light(env, 0))
    assert not draw(env, sim)[..., STOPS].any()
    image = draw(env, sim, options=NuplanOptions(stop_lines=True))
    rows = np.flatnonzero(image[:, 46:50, STOPS].any(axis=1))
    # 8 m ahead, a metre thick: row 72 - 1.5 * 8 = 60.
    assert {59, 60} & set(rows) and (image[..., STOPS] > 0).sum() < 400


def on_route_of(env, town, first_lane, episode):
    """Whether a lane of the file is in the route's road blocks, told by roads and directions."""
    lanes, table, routes = town.network.lanes, town.lanes, env.bank.routes

    def road(i):
        return lanes[i].road_id, lanes[i].lane_id > 0

    def block(i):
        if lanes[i].junction is None:
            return road(i)
        return lanes[i].junction, road(lanes[i].predecessors[0]), road(lanes[i].successors[0])

    passed = set()
    for k in range(int(routes.num_points[episode])):
        row = int(routes.lane[episode, k]) - first_lane
        raws = table.members[row]
        s = float(routes.lane_s[episode, k])
        passed.add(block([r for r in raws if table.raw_start[r] <= s + 1e-3][-1]))
    return lambda i: block(i) in passed


def light_of(env, town, first_lane, time):
    """What the light of a lane in a junction shows: its own, or the one of the lane before it."""
    lanes, table, world = town.network.lanes, town.lanes, env.bank.road_map

    def state(i):
        for raw in (i, *lanes[i].predecessors):
            light = int(world.lane_light[int(table.raw_lane[raw]) + first_lane])
            if light >= 0:
                since = (time - float(world.light_start[light])) % float(world.light_cycle[light])
                return 0 if since < 10 else 1 if since < 13 else 2
        return None

    return state


@pytest.mark.parametrize(
    ("episode", "turn", "time"),
    [(0, 0.02, 3.0), (0, 0.3, 11.0), (2, -0.4, 21.0), (1, 0.2, 5.0)],
    ids=["grid, nearly straight", "grid, turned", "grid, other route", "village"],
)
def test_towns_match_the_oracle(env, bundled, episode, turn, time):
    town = bundled[("grid", "village")[episode % 2]]
    first = int(np.argmax(np.asarray(env.bank.road_map.lane_town) == episode % 2))
    idx = before_light(env, episode) if episode % 2 == 0 else 60
    sim = place(env, episode, idx, turn, time, speed=7.0)
    rng = np.random.default_rng(episode)
    users = [
        at(
            sim, rng.uniform(-25, 45), rng.uniform(-30, 30), yaw=rng.uniform(-3, 3),
            length=rng.uniform(2, 6), width=rng.uniform(1, 2.4), kind=int(kind),
            speed=rng.uniform(0, 5),
        )
        for kind in rng.choice([KIND_VEHICLE, KIND_PEDESTRIAN, KIND_STATIC], 12)
    ]  # fmt: skip
    agents = agents_of(*users, slots=12)
    image = draw(env, sim, agents)
    expected = kinds_oracle.nuplan(
        sim.ego, (4.892, 1.836), agents, town, env.bank.road_map.origin[episode % 2],
        on_route_of(env, town, first, episode), light_of(env, town, first, time), SMALL,
    )  # fmt: skip
    same = (image == expected).all(axis=-1).mean()
    assert same > 0.99, (
        same,
        dict(zip(CHANNELS, (image != expected).sum(axis=(0, 1)), strict=True)),
    )
    for channel, name in enumerate(CHANNELS):
        ours, theirs = image[..., channel], expected[..., channel]
        both = np.count_nonzero((ours == theirs) & (theirs > 0))
        either = np.count_nonzero(ours | theirs)
        assert both >= 0.9 * either - 3, (name, both, either)
    assert np.count_nonzero(expected.any(axis=(0, 1))) >= (8 if episode % 2 == 0 else 7)


def test_the_route_is_of_whole_roads(env, bundled):
    # The route's channel holds the route's own points, and in a road of two lanes one way both.
    for episode in range(4):
        sim = place(env, episode, 80)
        image = draw(env, sim)
        xy = np.asarray(env.bank.routes.xy[episode, 80:100])
        offset = (xy - np.asarray(sim.ego.xy)) @ np.array(
            [
                [np.cos(sim.ego.yaw), -np.sin(sim.ego.yaw)],
                [np.sin(sim.ego.yaw), np.cos(sim.ego.yaw)],
            ]
        )
        row = np.floor(72 - 1.5 * offset[:, 0]).astype(int)
        column = np.floor(48 - 1.5 * offset[:, 1]).astype(int)
        assert (image[row, column, ROUTE] == 255).mean() > 0.9
        assert not (image[..., ROUTE] & ~image[..., DRIVABLE]).any()


def test_lanes_of_one_direction_are_one_block_and_ways_through_a_junction_others(bundled):
    town = bundled["highway"]
    block = road_blocks.of_points(town.network, town.lanes)
    by_key = {}
    for row, chain in enumerate(town.lanes.members):
        for raw in chain:
            lane = town.network.lanes[raw]
            if lane.junction is None and len(chain) == 1:
                found = set(block[town.lanes.points(row)])
                assert len(found) == 1
                by_key.setdefault((lane.road_id, lane.lane_id > 0), set()).update(found)
    assert by_key and all(len(found) == 1 for found in by_key.values())
    assert len({min(found) for found in by_key.values()}) == len(by_key)
    # Somewhere two lanes side by side share a block.
    assert any(len(lanes) > 1 for lanes in _rows_by_block(town, block).values())


def _rows_by_block(town, block):
    rows = {}
    for row in range(len(town.lanes.length)):
        rows.setdefault(int(block[town.lanes.points(row)][0]), []).append(row)
    return rows


def test_a_coarse_image_keeps_lines(env):
    config = RasterConfig(32, 32, 0.25, 8)
    image = draw(env, place(env, 0, 60, turn=0.05), config=config)
    assert (image[:24, 14:18, BORDERS] > 0).any(axis=1).mean() > 0.8
    assert (image[:24, 14:18, LIMITS] > 0).any(axis=1).mean() > 0.8


def test_a_batch_is_its_scenes_one_by_one_with_one_trace(env):
    @jax.jit
    @chex.assert_max_traces(n=1)
    def batch(env, sims):
        return jax.vmap(lambda sim: observation.observe(env, sim).raster)(sims)

    for idx in (50, 70):
        sims = [place(env, episode, idx, 0.1 * episode) for episode in range(3)]
        images = batch(env, jax.tree.map(lambda *x: jnp.stack(x), *sims))
        for sim, image in zip(sims, images, strict=True):
            alone = jax.jit(observation.observe)(env, sim).raster
            assert (np.asarray(alone) != np.asarray(image)).any(axis=-1).mean() < 0.002


def test_other_kinds_have_no_atlas(env):
    other = dataclasses.replace(env.config, observation="carla")
    assert make_env(env.bank, other, RewardConfig()).nuplan is None
