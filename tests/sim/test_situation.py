"""What the ego's surroundings are, against polygons and polylines of Shapely in a bundled town."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from shapely.geometry import LineString, Point

from carljax.reward import reward
from carljax.reward.config import RewardConfig
from carljax.sim import geometry, lights, route, situation
from carljax.sim.env import metric_names
from carljax.sim.road_map import LAYER_PARKING, LAYER_ROAD, PIXELS_PER_METRE, picture
from carljax.sim.types import KIND_VEHICLE

SIZE = (4.892, 1.836)


@jax.jit
def look(env, episode, idx, ego, agents):
    stretch, first = route.window(env.bank.routes, episode, idx)
    clock = lights.clock(jnp.float32(0.0), 0)
    return situation.situation(
        ego, jnp.float32(SIZE), agents, env.bank.road_map, stretch, first, idx - first, clock
    )


@pytest.fixture(scope="module")
def places(small_env, reset):
    """Places beside routes: (episode, route index, ego, agents, situation)."""
    rng, found = np.random.default_rng(5), []
    sim = reset(0).pipeline_state
    routes = small_env.bank.routes
    for _ in range(60):
        episode = int(rng.integers(0, 6))
        idx = int(rng.integers(2, int(routes.num_points[episode]) - 60))
        yaw = float(routes.yaw[episode, idx])
        offset = jnp.float32([rng.uniform(0, 0.9), rng.uniform(-4, 4)])
        here = routes.xy[episode, idx]
        ego = sim.ego.replace(
            xy=geometry.from_frame(offset, here, jnp.float32(yaw)),
            yaw=jnp.float32(yaw + rng.normal() * 0.2),
        )
        num = sim.agents.kind.shape[0]
        ahead = np.asarray(routes.xy[episode, idx + rng.integers(-5, 45, num)])
        agents = sim.agents.replace(
            xy=jnp.float32(ahead + rng.normal(size=(num, 2)) * 1.5),
            kind=jnp.full(num, KIND_VEHICLE),
        )
        seen = look(small_env, jnp.int32(episode), jnp.int32(idx), ego, agents)
        found.append((episode, idx, ego, agents, jax.tree.map(np.asarray, seen)))
    return found


def line_of(env, episode, begin, end):
    return LineString(np.asarray(env.bank.routes.xy[episode, begin:end], float))


def test_offset_from_the_route_is_that_of_its_polyline(small_env, places):
    for episode, idx, ego, _, seen in places:
        line = line_of(small_env, episode, idx, idx + 6)
        xy = np.asarray(ego.xy, float)
        np.testing.assert_allclose(abs(seen.route_lateral), line.distance(Point(xy)), atol=0.15)
        nearest = np.asarray(line.interpolate(line.project(Point(xy))).coords[0])
        left = [-np.sin(seen.route_yaw), np.cos(seen.route_yaw)]
        if abs(seen.route_lateral) > 0.3:
            assert np.sign((xy - nearest) @ left) == np.sign(seen.route_lateral)
        yaws = np.asarray(small_env.bank.routes.yaw[episode, idx : idx + 6])
        assert np.abs(np.angle(np.exp(1j * (yaws - seen.route_yaw)))).min() < 1e-6


def test_gaps_along_the_route_are_those_of_its_polyline(small_env, places):
    num_on = num_off = 0
    for episode, idx, ego, agents, seen in places:
        line = line_of(small_env, episode, max(idx - 8, 0), idx + 41)
        begin = line.project(Point(np.asarray(ego.xy, float)))
        for xy, gap in zip(np.asarray(agents.xy, float), seen.others.route_gap, strict=True):
            beside, along = line.distance(Point(xy)), line.project(Point(xy))
            want = along - begin
            is_on = beside < 2 and want > 0 and along < line.length - 0.5
            if abs(beside - 2) < 0.2 or abs(want) < 1 or along > line.length - 3:
                continue  # at an edge
            if is_on:
                num_on += 1
                np.testing.assert_allclose(gap, want, atol=0.3)
            else:
                num_off += 1
                assert gap == np.inf
    assert num_on > 100 and num_off > 20


def test_corners_and_others_are_looked_up_in_the_town_s_picture(small_env, places):
    road_map = small_env.bank.road_map
    layers = [picture(road_map, town, road_map.layers) for town in range(2)]
    origin = np.asarray(road_map.origin, float)
    seen_off = 0
    for episode, _, ego, agents, seen in places:
        town = int(small_env.bank.routes.town[episode])

        def bits(xy, town=town):
            column, row = np.round((xy - origin[town]) * PIXELS_PER_METRE).astype(int)
            return layers[town][row, column]

        c, s = np.cos(float(ego.yaw)), np.sin(float(ego.yaw))
        for k, (x, y) in enumerate([(1, 1), (-1, 1), (-1, -1), (1, -1)]):
            local = np.array([x * SIZE[0], y * SIZE[1]]) / 2
            corner = np.asarray(ego.xy, float) + [
                c * local[0] - s * local[1],
                s * local[0] + c * local[1],
            ]
            off = not bits(corner) & (LAYER_ROAD | LAYER_PARKING)
            seen_off += off
            assert bool(seen.corner_off_road[k]) is off
        want = [bool(bits(xy) & (1 | 2 | 32)) for xy in np.asarray(agents.xy, float)]
        assert list(seen.others.on_road) == want
    assert 20 < seen_off < 200


@pytest.mark.parametrize("name", reward.REWARDS)
def test_reset_and_step_log_the_same_of_every_reward(small_env, name):
    config = RewardConfig(name=name)
    env = small_env.replace(reward_config=config)
    first = jax.eval_shape(env.reset, jax.random.key(0))
    second = jax.eval_shape(env.step, first, jax.ShapeDtypeStruct((2,), jnp.float32))
    assert set(first.metrics) == set(second.metrics) == set(metric_names(config))
    assert jax.tree.structure(first) == jax.tree.structure(second)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        assert (a.shape, a.dtype, a.weak_type) == (b.shape, b.dtype, b.weak_type)
    assert dataclasses.is_dataclass(first.pipeline_state.reward_state)
