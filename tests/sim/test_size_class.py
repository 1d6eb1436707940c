"""Lengths are rounded to few, a padded world is the same world, towns of a class look alike."""

from __future__ import annotations

import dataclasses
import functools
import os

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from carljax.reward.config import RewardConfig
from carljax.sim import (
    bank_padding,
    episodes,
    observation,
    road_map_builder,
    road_map_padding,
    town,
)
from carljax.sim.env import EnvConfig, make_env
from carljax.sim.raster_canvas import RasterConfig
from carljax.sim.road_map import RoadMap, nearest_lane
from carljax.sim.size_class import SizeClass

# Two sums in a row may be rounded once or twice, as the compiler likes; as users compile it, it
# likes the same in both worlds. See tests/conftest.py.
_IS_CHEAP = "optimization_level=0" in os.environ["XLA_FLAGS"]
NUM_STEPS = 60
RASTER = RasterConfig(height=48, width=48, pixels_per_metre=1.0, ego_from_bottom_px=12)
CONFIG = EnvConfig(
    num_agents=8,
    num_pedestrians=4,
    num_scenario_slots=2,
    route_length=300.0,
    raster=RASTER,
)


@pytest.mark.parametrize(
    ("lengths", "length", "rounded"),
    [
        (SizeClass(1), 0, 1),
        (SizeClass(1), 1, 1),
        (SizeClass(1), 3, 4),
        (SizeClass(1), 4, 4),
        (SizeClass(16), 5, 16),
        (SizeClass(16), 17, 32),
        (SizeClass(1, steps=4), 7, 7),  # 4, 5, 6, 7, 8, then in steps of 2, ...
        (SizeClass(1, steps=4), 8, 8),
        (SizeClass(1, steps=4), 9, 10),
        (SizeClass(1, steps=4), 17, 20),
        (SizeClass(24, steps=4), 25, 28),
        (SizeClass(1, steps=4), 4096, 4096),
        (SizeClass(1 << 21, steps=4), 4_104_259, 4_194_304),
    ],
)
def test_lengths_by_hand(lengths, length, rounded):
    assert lengths.round_up(length) == rounded


@pytest.mark.parametrize("steps", [1, 2, 4])
def test_little_is_padding_and_a_class_is_its_own(steps):
    lengths = SizeClass(8, steps)
    found = [lengths.round_up(length) for length in range(3000)]
    assert found == sorted(found)
    assert all(lengths.round_up(length) == length for length in found)
    for length, rounded in enumerate(found[9:], 9):
        assert length <= rounded <= length * (1 + 1 / steps)
    # 8, then in so many steps to 16, ..., 2048 and as far as 2,999 needs.
    assert len(set(found)) == 1 + 8 * steps + {1: 1, 2: 1, 4: 2}[steps]


@pytest.fixture(scope="module")
def pair(bundled):
    """The same nine episodes in two towns, exact and padded."""
    there = [bundled["village"], bundled["grid"]]
    bank = episodes.make_bank(there, 9, CONFIG.population, 3, CONFIG.route_length, 100.0)
    return bank.replace(road_map=road_map_builder.build(there)), bank_padding.pad(bank)


def shapes(tree):
    """Shape and type of every array by its name."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): (x.shape, x.dtype) for path, x in leaves}


def test_every_axis_is_of_its_class_and_what_is_there_stays(pair):
    exact, padded = pair
    assert int(padded.num_episodes) == int(exact.num_episodes) == 9
    assert padded.routes.s.shape == (10, 320) and exact.routes.s.shape == (9, 308)
    assert exact.scenarios.kind.shape == (9, 3) and padded.scenarios.kind.shape == (10, 16)
    assert exact.road_map.layers.shape == (2_504_860,)  # 2 Mi, 2.5 Mi, 3 Mi, ...
    assert padded.road_map.layers.shape == (5 << 19,)
    assert padded.road_map.lane_meeting.shape == (512, 2, 16)
    paths = jax.tree_util.tree_leaves_with_path(exact)
    for (path, old), new in zip(paths, jax.tree.leaves(padded), strict=True):
        part = np.asarray(new)[tuple(slice(0, size) for size in old.shape)]
        np.testing.assert_array_equal(part, old, err_msg=jax.tree_util.keystr(path))


def test_nothing_belongs_to_a_padded_row(pair):
    old, new = (bank.road_map for bank in pair)
    rows = {"lane": len(old.lane_length), "point": len(old.point_yaw), "walk": len(old.walk_xyz)}
    assert (np.asarray(new.lane_town)[rows["lane"] :] == -1).all()
    assert (np.asarray(new.picture_size)[len(old.origin) :] == 0).all()
    named = {
        "lane": ("lane_successors", "point_lane", "junction_arms", "spawn_lane"),
        "point": ("lane_start", "nearest_point", "point_left", "point_right", "point_oncoming"),
        "walk": ("walk_neighbours", "spawn_walk"),
    }
    for table, names in named.items():
        for name in names:
            assert np.asarray(getattr(new, name)).max() < rows[table], name


def test_every_table_has_a_class():
    fields = {*RoadMap.__dataclass_fields__}
    for name in fields:
        assert sum(name.startswith(prefix) for prefix in road_map_padding.ROWS) == 1, name
    assert fields > {*road_map_padding.COLUMNS, *road_map_padding.UNUSED}


@jax.jit
def drive(env, actions):
    """Every second episode for some steps: the states at the end, and all rewards."""

    def one(episode, actions):
        first = env.start_episode(episode, jax.random.fold_in(jax.random.key(0), episode))
        return jax.lax.scan(
            lambda state, action: ((after := env.advance(state, action)), after.reward),
            first,
            actions,
        )

    return jax.vmap(one)(jnp.arange(0, 9, 2), actions)


@pytest.fixture(scope="module")
def driven(pair):
    """What becomes of both worlds by the same actions."""
    noise = np.random.default_rng(0).uniform(-0.3, 0.3, (5, NUM_STEPS, 2)) + [0.0, 0.5]
    actions = jnp.asarray(noise, jnp.float32)
    return [drive(make_env(bank, CONFIG, RewardConfig()), actions) for bank in pair]


@pytest.mark.slow
def test_a_padded_world_is_driven_bit_for_bit_as_it_was(driven):
    exact, padded = (
        (state.replace(pipeline_state=state.pipeline_state.replace(key=None)), rewards)
        for state, rewards in driven
    )
    assert np.asarray(exact[0].pipeline_state.ego.speed).min() > 1.0
    assert np.asarray(exact[0].pipeline_state.scenarios.index).max() >= 0
    if _IS_CHEAP:
        sims = (state.pipeline_state for state, _ in (exact, padded))
        chex.assert_trees_all_close(*sims, rtol=1e-5)
        # The lane's factor is 1 less nearly as much, so its error is that of numbers near 1.
        chex.assert_trees_all_close(exact, padded, rtol=1e-5, atol=3e-6)
    else:
        jax.tree.map(np.testing.assert_array_equal, exact, padded)


@functools.partial(jax.jit, static_argnames="kind")
def look(env, sims, kind):
    """The images of a kind of observation."""
    see = observation.KINDS[kind]

    def one(sim):
        return see.observe(env, sim.replace(past=see.begin(env, sim))).raster

    return jax.vmap(one)(sims)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "channels"), [("carla", 5), ("roach", 4), ("nuplan", 5)])
def test_a_padded_world_is_seen_bit_for_bit_as_it_was(pair, driven, kind, channels):
    config = dataclasses.replace(CONFIG, observation=kind)
    exact, padded = (
        look(make_env(bank, config, RewardConfig()), state.pipeline_state, kind)
        for bank, (state, _) in zip(pair, driven, strict=True)
    )
    assert exact.any(axis=(0, 1, 2)).sum() >= channels
    np.testing.assert_array_equal(exact, padded)


def test_episodes_are_drawn_from_those_that_there_are(pair):
    start = jax.jit(
        lambda env, keys: jax.vmap(lambda key: env.start(key).pipeline_state.episode_idx)(keys)
    )
    keys = jax.random.split(jax.random.key(1), 500)
    exact, padded = (start(make_env(bank, CONFIG, RewardConfig()), keys) for bank in pair)
    np.testing.assert_array_equal(exact, padded)
    assert set(padded.tolist()) == set(range(9))


def env_in(there, kind="carla", num=9, seed=3):
    """An environment in one town as a training has it, with few and short routes."""
    config = dataclasses.replace(CONFIG, observation=kind)
    bank = episodes.make_bank([there], num, config.population, seed, CONFIG.route_length, 100.0)
    return make_env(bank_padding.pad(bank), config, RewardConfig())


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        ("carla", ("village", "grid", "highway", "suburb")),
        # Kinds of pixels are counted besides: the grid and the suburb have more.
        ("nuplan", ("village", "highway")),
    ],
)
def test_another_town_seed_or_number_of_routes_is_no_other_program(bundled, kind, names):
    traced = []

    @jax.jit
    def program(env):
        traced.append(kind)
        return nearest_lane(env.bank.road_map, jnp.int32(0), env.bank.routes.xy[0, 0])

    for name in names:
        program(env_in(bundled[name], kind))
    program(env_in(bundled[names[0]], kind, num=10, seed=4))
    assert len(traced) == 1
    program(env_in(bundled[names[0]], kind, num=11))  # 12 in its class
    assert len(traced) == 2


def test_carla_s_smaller_towns_are_of_the_same_class(bundled, shared_data):
    ours = shapes(env_in(bundled["grid"]).bank)
    for name in ("Town01", "Town02"):
        theirs = town.load(shared_data / "maps" / f"{name}.xodr")
        assert shapes(env_in(theirs).bank) == ours
