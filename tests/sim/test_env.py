"""The environment: shapes, traces, batches, and whole episodes of scripted drivers."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scripted_driver import FOLLOW, FOLLOW_BLINDLY, FULL_THROTTLE, STAND, drive_on, episodes, fetch

from carljax.reward import carl
from carljax.reward.config import RewardConfig
from carljax.sim import town as towns_module
from carljax.sim.env import metric_names

NUM = 6  # episodes of the small environment
CAUSES, ENDS = carl.CAUSES, carl.REWARD.ends
METRICS = metric_names(RewardConfig())


def drive(env, script, speed=5.0, seed=0):
    """Episodes on all episodes: (6, T, ...)."""
    keys = jax.random.split(jax.random.key(seed), NUM)
    return episodes(env, jnp.arange(NUM), keys, jnp.int32(script), jnp.float32(speed))


def ends(path):
    """Step of each episode's end (the number of steps driven), T where it goes on."""
    done = path.done > 0
    return np.where(done.any(axis=1), done.argmax(axis=1), path.done.shape[1])


def causes(path):
    """Of each episode, the set of names that end it."""
    last = np.minimum(ends(path), path.done.shape[1] - 1)
    return [
        {name for name in ENDS if path.metrics[f"reward/{name}"][b, t] > 0}
        for b, t in enumerate(last)
    ]


# Shapes, traces and batches


@pytest.fixture(scope="module")
def step():
    """One compiled step; a second trace is an error."""
    return jax.jit(chex.assert_max_traces(lambda env, state, a: env.step(state, a), n=1))


def test_reset_and_step_give_the_same_structure(small_env):
    key, action = jax.random.key(0), jax.ShapeDtypeStruct((2,), jnp.float32)
    first = jax.eval_shape(small_env.reset, key)
    second = jax.eval_shape(small_env.step, first, action)
    assert jax.tree.structure(first) == jax.tree.structure(second)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        assert (a.shape, a.dtype, a.weak_type) == (b.shape, b.dtype, b.weak_type)
        assert not a.weak_type
    assert set(first.metrics) == set(METRICS) and set(first.info) == {"truncation"}
    assert first.obs.raster.shape == (32, 32, 10) and first.obs.raster.dtype == jnp.uint8
    assert first.obs.scalars.shape == (8,) and first.obs.value_scalars.shape == (10,)
    assert small_env.action_size == 2


def test_a_state_fed_back_is_not_traced_again(small_env, reset, step):
    state = reset(0)
    for k in range(3):
        state = step(small_env, state, jnp.asarray([0.1 * k, 0.5], jnp.float32))
    assert int(state.pipeline_state.step_count) == 3


def test_a_batch_is_the_loop(small_env, reset, step):
    states = [reset(seed) for seed in range(NUM)]
    stack = jax.jit(lambda states: jax.tree.map(lambda *x: jnp.stack(x), *states))
    batch = stack([state.replace(obs=None) for state in states])
    path = fetch(drive_on(small_env, batch, jnp.int32(FULL_THROTTLE), jnp.float32(0.0))[1])
    for b in (0, 3):
        state = states[b]
        for t in range(8):
            state = step(small_env, state, jnp.asarray([0.0, 1.0], jnp.float32))
            want = jax.tree.map(lambda x, b=b, t=t: x[b, t], path)
            chex.assert_trees_all_close(fetch(state), want, rtol=1e-5, atol=1e-5)


def test_reset_draws_a_scenario_and_stands_at_its_start(small_env, reset):
    seen = set()
    for seed in range(12):
        sim = reset(seed).pipeline_state
        k = int(sim.episode_idx)
        seen.add(k)
        np.testing.assert_array_equal(sim.ego.xy, small_env.bank.routes.xy[k, 0])
        np.testing.assert_array_equal(sim.ego.yaw, small_env.bank.routes.yaw[k, 0])
        np.testing.assert_array_equal(sim.agents.xy, small_env.bank.agents.xy[k])
        assert sim.ego.speed == 0 and sim.step_count == 0 and sim.route_idx == 0
        assert 0 <= sim.lights.time < 600
    assert len(seen) > 2


def test_the_same_key_gives_the_same_episode(small_env, reset):
    assert int(reset(3).pipeline_state.episode_idx) == int(reset(3).pipeline_state.episode_idx)
    one, again, other = (drive(small_env, FULL_THROTTLE, seed=s) for s in (0, 0, 1))
    chex.assert_trees_all_equal(one, again)
    clock = [path.pipeline_state.lights.time[:, 0] for path in (one, other)]
    assert not np.array_equal(*clock)


# Episodes


@pytest.fixture(scope="module")
def reckless(small_env):
    """Full throttle straight on, in traffic, from several seeds."""
    return [drive(small_env, FULL_THROTTLE, seed=seed) for seed in range(3)]


def test_full_throttle_straight_on_ends_soon(reckless):
    found = set().union(*(c for path in reckless for c in causes(path)))
    assert "off_road" in found or "route_deviation" in found
    assert found <= set(CAUSES)
    for path in reckless:
        assert (ends(path) < 400).all() and (path.info["truncation"] == 0).all()
        for names in causes(path):
            assert names  # no end without a cause


def test_rewards_are_their_terms(reckless):
    # Progress times all soft factors, and 1 less exactly where a collision or a red light ends it.
    num_penalties = 0
    for path in reckless:
        m = {k: v.astype(float) for k, v in path.metrics.items()}
        soft = np.prod([m[f"reward/{name}"] for name in carl.SOFT_FACTORS], axis=0)
        penalised = (m["reward/collision"] > 0) | (m["reward/red_light"] > 0)
        want = m["reward/progress"] * soft - 1.0 * penalised
        first = ends(path)
        for b in range(NUM):
            upto = slice(0, first[b] + 1)
            np.testing.assert_allclose(path.reward[b, upto], want[b, upto], atol=1e-5)
            num_penalties += penalised[b, upto].sum()
            # what an episode adds up to
            total = path.reward[b, upto].astype(float).sum()
            last = {k: v[b, first[b]] for k, v in m.items()}
            np.testing.assert_allclose(last["episode/return"], total, atol=1e-3)
            assert last["episode/length"] == first[b] + 1
            speed = path.pipeline_state.ego.speed[b, upto].astype(float)
            np.testing.assert_allclose(last["episode/km"], speed.sum() * 1e-4, rtol=1e-4)
            for name in ENDS:
                assert last[f"episode/{name}_frac"] == last[f"reward/{name}"]
    assert num_penalties > 0


def test_a_car_in_the_way_is_hit_and_costs_one(empty_env):
    # One car of 4 m, 12 m ahead of the ego on its own lane, that crawls at 1 m/s.
    bank = empty_env.bank
    here = [bank.routes.lane[:, 0], bank.routes.lane_s[:, 0] + 12.0]
    slow = {"kind": 1, "lane_s": here[1], "speed": 1.0, "desired_speed_frac": 0.0, "length": 4.0}
    fields = {name: getattr(bank.agents, name).at[:, 0].set(x) for name, x in slow.items()}
    agents = bank.agents.replace(**fields, lanes=bank.agents.lanes.at[:, 0, 0].set(here[0]))
    path = drive(empty_env.replace(bank=bank.replace(agents=agents)), FOLLOW_BLINDLY, speed=8.0)
    last = ends(path)
    num_hits = 0
    for b, names in enumerate(causes(path)):
        if "collision" not in names:
            continue
        num_hits += 1
        m = {k: float(v[b, last[b]]) for k, v in path.metrics.items()}
        soft = np.prod([m[f"reward/{name}"] for name in carl.SOFT_FACTORS])
        want = m["reward/progress"] * soft - 1.0
        np.testing.assert_allclose(path.reward[b, last[b]], want, atol=1e-6)
        assert m["reward/penalty"] == 1 and m["episode/collision_frac"] == 1
        assert path.info["truncation"][b, last[b]] == 0
        # 8 m to the car's rear at a mean of a few m/s
        assert 10 < last[b] < 60
    assert num_hits >= NUM - 2  # where the lane is long enough for the car


def test_standing_for_90_s_is_blocked(empty_env):
    # 90 s are 900 steps; more than that is the step after.
    path = drive(empty_env, STAND)
    assert causes(path) == [{"blocked"}] * NUM
    assert (ends(path) + 1 == 901).all()
    assert (path.reward == 0).all()
    np.testing.assert_allclose(path.pipeline_state.reward_state.stopped_s[:, 899], 90, atol=0.01)


def test_traffic_never_runs_into_an_ego_that_stands(small_env):
    for seed in range(2):
        path = drive(small_env, STAND, seed=seed)
        assert causes(path) == [{"blocked"}] * NUM


@pytest.fixture(scope="module")
def careful(empty_env):
    """The simple driver on empty roads."""
    return drive(empty_env, FOLLOW)


def test_a_simple_driver_finishes_its_routes(careful):
    assert causes(careful) == [{"finished"}] * NUM
    last = ends(careful)
    at_end = {k: v[np.arange(NUM), last] for k, v in careful.metrics.items()}
    assert (at_end["episode/route_completion"] == 100).all()
    assert (careful.info["truncation"][np.arange(NUM), last] == 0).all()
    # 200 m at 5 m/s and some red lights
    assert (last * 0.1 > 40).all() and (last * 0.1 < 125).all()
    np.testing.assert_allclose(at_end["episode/km"], 0.2, rtol=0.03)


def test_progress_adds_up_to_the_route(careful, empty_env):
    last = ends(careful)
    routes = empty_env.bank.routes
    for b in range(NUM):
        progress = careful.metrics["reward/progress"][b, : last[b] + 1].astype(float)
        assert (progress >= 0).all() and progress.max() < 2.0  # at most 2 points of 200 a step
        # It ends at the point before the last, 1 m early.
        done = int(routes.num_points[b]) - 2
        want = 100 * float(routes.s[b, done]) / float(routes.length[b])
        np.testing.assert_allclose(progress.sum(), want, atol=0.01)
        total = careful.metrics["episode/return"][b, last[b]]
        assert 60 < total <= want + 1e-3  # close to the lane's middle, within the limit


def test_running_a_red_light_ends_the_episode(empty_env):
    # Without an eye for lights and signs, from several seeds: some meet a red light.
    found = []
    for seed in range(2):
        path = drive(empty_env, FOLLOW_BLINDLY, seed=seed)
        last = ends(path)
        for b, names in enumerate(causes(path)):
            found += sorted(names)
            if names == {"red_light"}:
                m = {k: v[b, last[b]] for k, v in path.metrics.items()}
                soft = np.prod([m[f"reward/{name}"] for name in carl.SOFT_FACTORS])
                paid = path.reward[b, last[b]]
                np.testing.assert_allclose(paid, m["reward/progress"] * soft - 1, atol=1e-5)
    assert {"red_light", "stop_sign"} <= set(found) <= {"red_light", "stop_sign", "finished"}


def test_the_time_limit_truncates(empty_env):
    # 5 s are 50 steps; more than that is the step after.
    config = dataclasses.replace(empty_env.reward_config, time_limit_s=5.0)
    path = drive(empty_env.replace(reward_config=config), FOLLOW)
    assert causes(path) == [{"timeout"}] * NUM
    assert (ends(path) + 1 == 51).all()
    last = path.info["truncation"][:, 50]
    assert (last == 1).all() and (path.info["truncation"][:, 49] == 0).all()


def test_a_failure_at_the_time_limit_is_a_failure(empty_env):
    config = dataclasses.replace(empty_env.reward_config, time_limit_s=5.0, blocked_s=5.0)
    path = drive(empty_env.replace(reward_config=config), STAND)
    assert causes(path) == [{"timeout", "blocked"}] * NUM
    assert (path.done[:, 50] == 1).all() and (path.info["truncation"] == 0).all()


def test_the_clock_of_the_lights_goes_on(careful):
    time = careful.pipeline_state.lights.time[:, :200].astype(float)
    np.testing.assert_allclose(np.diff(time, axis=1), 0.1, atol=1e-3)
    assert len(set(np.round(time[:, 0], 3))) == NUM


def test_a_town_without_lanes_is_refused(bundled):
    network = bundled["grid"].network
    none = tuple(lane for lane in network.lanes if lane.kind != "driving")
    with pytest.raises(ValueError, match="grid: no driving lane"):
        towns_module.from_network(dataclasses.replace(network, lanes=none))
