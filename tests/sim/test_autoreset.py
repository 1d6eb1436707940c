"""Next-step autoreset in the real environment, under random actions."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from carljax.reward import carl
from carljax.reward.config import RewardConfig
from carljax.sim import autoreset
from carljax.sim.env import metric_names

NUM_ENVS, NUM_STEPS = 6, 200
ENDS, METRICS = carl.REWARD.ends, metric_names(RewardConfig())


@pytest.fixture(scope="module")
def step():
    """One batch step with restarts."""
    return jax.jit(autoreset.step)


def keys(seed):
    return jax.random.split(jax.random.key(seed), NUM_ENVS)


def strip(state):
    """A state without its key."""
    return state.replace(pipeline_state=state.pipeline_state.replace(key=None))


@pytest.fixture(scope="module")
def rollout(small_env, step):
    """200 states under random, mostly forward, actions, and the keys of the restarts."""
    rng = np.random.default_rng(0)
    # Ended episodes of nothing: the first step begins all of them.
    shapes = jax.eval_shape(small_env.reset, jax.random.key(0))
    ended = jax.tree.map(lambda x: jnp.ones((NUM_ENVS, *x.shape), x.dtype), strip(shapes))
    ended = ended.replace(pipeline_state=ended.pipeline_state.replace(key=keys(0)))
    states = [step(small_env, ended, jnp.zeros((NUM_ENVS, 2)), keys(1000))]
    for t in range(NUM_STEPS):
        steer = rng.uniform(-0.3, 0.3, NUM_ENVS)
        pedal = rng.uniform(-0.5, 1.0, NUM_ENVS)
        action = jnp.asarray(np.stack([steer, pedal], axis=-1), jnp.float32)
        states.append(step(small_env, states[-1], action, keys(t)))
    return states


def fetch(states, get):
    return np.stack([np.asarray(get(state)) for state in states])


def test_random_actions_stay_finite_and_in_bounds(rollout):
    for state in rollout[::20] + rollout[-1:]:
        sim = state.pipeline_state
        for leaf in jax.tree.leaves(strip(state)):
            assert np.isfinite(np.asarray(leaf, float)).all()
        assert state.obs.raster.dtype == jnp.uint8
        assert (np.abs(sim.ego.yaw) <= np.pi + 1e-6).all() and (sim.ego.speed >= 0).all()
        assert set(state.metrics) == set(METRICS)
        for name in ("outside_lanes", "lane", "speed_limit", "ttc", "comfort"):
            if float(state.metrics["episode/length"].min()) > 0:
                factor = np.asarray(state.metrics[f"reward/{name}"])
                assert ((factor >= 0) & (factor <= 1)).all()
    reward = fetch(rollout, lambda s: s.reward)
    # 2 m of 200 m a step at most, and 1 for a collision or a red light
    assert (reward >= -1.001).all() and (reward <= 100 * 2.01 / 200).all()
    progress = fetch(rollout, lambda s: s.pipeline_state.route_idx)
    restarted = fetch(rollout, lambda s: s.pipeline_state.step_count) == 0
    step = np.diff(progress, axis=0)[~restarted[1:]]
    assert ((step >= 0) & (step <= 2)).all()


def test_the_raster_shows_something(rollout):
    images = fetch(rollout[:10], lambda s: s.obs.raster)
    assert (images[..., 0] > 0).mean() > 0.02  # road


def test_an_end_is_shown_and_the_next_step_begins_anew(rollout):
    done = fetch(rollout, lambda s: s.done) > 0
    count = fetch(rollout, lambda s: s.pipeline_state.step_count)
    reward, obs = fetch(rollout, lambda s: s.reward), fetch(rollout, lambda s: s.obs.raster)
    truncation = fetch(rollout, lambda s: s.info["truncation"])
    num_restarts = 0
    for t in range(1, NUM_STEPS + 1):
        for b in range(NUM_ENVS):
            if done[t - 1, b]:
                num_restarts += 1
                assert count[t - 1, b] > 0 and count[t, b] == 0
                assert reward[t, b] == 0 and not done[t, b] and truncation[t, b] == 0
                assert all(float(v[b]) == 0 for v in rollout[t].metrics.values())
                assert not np.array_equal(obs[t, b], obs[t - 1, b])
            else:
                assert count[t, b] == count[t - 1, b] + 1
    assert num_restarts >= NUM_ENVS
    assert not done[0].any()


def test_restarts_are_new(rollout):
    count = fetch(rollout, lambda s: s.pipeline_state.step_count)
    episode = fetch(rollout, lambda s: s.pipeline_state.episode_idx)
    clock = fetch(rollout, lambda s: s.pipeline_state.lights.time)
    fresh = count == 0
    assert len(set(episode[fresh])) > 3
    assert len(set(clock[fresh])) == fresh.sum()


def test_a_restart_is_a_reset(rollout, small_env):
    done = fetch(rollout, lambda s: s.done) > 0
    t, b = np.argwhere(done[:-1])[0]
    # The step from t to t + 1 had the keys of t.
    want = strip(jax.jit(small_env.start)(keys(int(t))[b]))
    got = strip(jax.tree.map(lambda x: x[b], rollout[t + 1]))
    chex.assert_trees_all_close(got.replace(obs=None), want, rtol=1e-6)


def test_a_restart_ignores_the_action_and_a_running_episode_the_key(small_env, rollout, step):
    done = fetch(rollout, lambda s: s.done) > 0
    t = int(np.argwhere(done[:-1])[0][0])
    state = rollout[t]
    actions = [jnp.tile(jnp.asarray(a, jnp.float32), (NUM_ENVS, 1)) for a in ((1, 1), (-1, -1))]
    one, other = (step(small_env, state, action, keys(0)) for action in actions)
    rekeyed = step(small_env, state, actions[0], keys(1))
    for b in range(NUM_ENVS):
        same = [
            np.array_equal(one.pipeline_state.ego.steer[b], x.pipeline_state.ego.steer[b])
            and np.array_equal(one.pipeline_state.lights.time[b], x.pipeline_state.lights.time[b])
            for x in (other, rekeyed)
        ]
        assert same == ([True, False] if done[t, b] else [False, True])


def test_what_an_episode_adds_up_to_holds_at_its_end(rollout):
    done = fetch(rollout, lambda s: s.done) > 0
    reward = fetch(rollout, lambda s: s.reward).astype(float)
    metrics = {name: fetch(rollout, lambda s, n=name: s.metrics[n]) for name in METRICS}
    begins = np.zeros(NUM_ENVS, int)
    num_ends = 0
    for t in range(NUM_STEPS + 1):
        for b in np.flatnonzero(done[t]):
            begin = begins[b]
            assert metrics["episode/length"][t, b] == t - begin
            total = reward[begin + 1 : t + 1, b].sum()
            np.testing.assert_allclose(metrics["episode/return"][t, b], total, atol=1e-4)
            fractions = [metrics[f"episode/{name}_frac"][t, b] for name in ENDS]
            assert max(fractions) == 1 and set(fractions) <= {0.0, 1.0}
            completion = metrics["episode/route_completion"][t, b]
            assert 0 <= completion <= 100
            begins[b] = t + 1
            num_ends += 1
    assert num_ends >= NUM_ENVS


@pytest.mark.parametrize("ended", [(), (2,), (0, 1, 3, 4, 5), range(NUM_ENVS)])
def test_few_at_a_time_or_all_masked_is_the_same(small_env, rollout, ended):
    state = rollout[3].replace(obs=None)
    is_ended = jnp.zeros(NUM_ENVS, bool).at[jnp.array(ended, int)].set(True)
    assert autoreset.AT_ONCE < NUM_ENVS  # so that all at once take more than one round
    few, masked = (
        strip(jax.jit(restart)(small_env, is_ended, state, keys(7)))
        for restart in (autoreset._restart_few, autoreset._restart_masked)
    )
    chex.assert_trees_all_close(few, masked, rtol=1e-6)
    fresh = np.asarray(few.pipeline_state.step_count) == 0
    np.testing.assert_array_equal(fresh, is_ended)
