"""Rollouts in the toy environment: records, restarts, independence of the batch, metrics."""

from __future__ import annotations

import fill
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy_env

from carljax.ppo import beta
from carljax.ppo.config import NetworkConfig
from carljax.ppo.networks import ActorCritic
from carljax.ppo.rollout import mean_metrics, rollout

NUM_ENVS, NUM_STEPS = 6, 60
NETWORK = ActorCritic(
    NetworkConfig(encoder="patch", hidden_size=8, joint_size=8, patch_features=(4, 4))
)


@jax.jit
def _run(env, params, env_state, keys):
    return rollout(env, NETWORK, params, env_state, keys, NUM_STEPS)


@pytest.fixture(scope="module")
def recorded():
    env = toy_env.ToyEnv(starts=jnp.linspace(-0.8, 0.8, 9, dtype=jnp.float32), limit=9)
    env_state = jax.vmap(lambda key: env.observe(env.start(key)))(
        jax.random.split(jax.random.key(0), NUM_ENVS)
    )
    params = fill.params(NETWORK, env_state.obs)
    keys = jax.random.split(jax.random.key(2), NUM_ENVS)
    return env, params, env_state, keys, _run(env, params, env_state, keys)


def test_records_what_the_policy_did(recorded):
    _, params, _, _, (env_state, batch, last_value, _) = recorded
    assert batch.obs.raster.dtype == jnp.uint8
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch)
    alpha, beta_, value = NETWORK.apply(params, flat.obs)
    np.testing.assert_allclose(flat.value, value, atol=1e-5)
    np.testing.assert_allclose(flat.log_prob, beta.log_prob(flat.action, alpha, beta_), atol=1e-4)
    _, _, expected = NETWORK.apply(params, env_state.obs)
    np.testing.assert_allclose(last_value, expected, atol=1e-5)


def test_dynamics_restarts_and_ends(recorded):
    """Replays the recorded actions in float64 NumPy, one environment after the other."""
    env, _, first, _, (_, batch, _, _) = recorded
    starts = np.float64(env.starts)
    time = np.asarray(batch.obs.value_scalars[..., 0]) * env.limit
    seen = {"terminated": 0, "truncated": 0}
    for i in range(NUM_ENVS):
        x, t, ended = float(first.pipeline_state.x[i]), 0, False
        for step in range(NUM_STEPS):
            assert (
                round(float(time[step, i])) == t
            )  # the final observation is shown before a restart
            assert batch.weight[step, i] == float(not ended)
            if ended:
                assert batch.reward[step, i] == batch.done[step, i] == 0.0
                columns = np.flatnonzero(batch.obs.raster[step + 1, i, 0, :, 0])
                seen_x = np.linspace(-1.0, 1.0, toy_env.SIZE)[columns].mean()
                x, t, ended = starts[np.argmin(np.abs(starts - seen_x))], 0, False
                continue
            x, t = x + 0.25 * (2.0 * float(batch.action[step, i, 0]) - 1.0), t + 1
            out, late = abs(x) > 1.0, t >= env.limit
            np.testing.assert_allclose(batch.reward[step, i], 1.0 - abs(x), atol=1e-4)
            assert batch.done[step, i] == float(out or late)
            assert batch.truncation[step, i] == float(late and not out)
            seen["terminated"] += out and not late
            seen["truncated"] += late and not out
            ended = out or late
            if ended and step + 1 == NUM_STEPS - 1:
                break  # nothing after the restart is recorded to tell where it began
    assert seen["terminated"] > 2
    assert seen["truncated"] > 2


def test_an_environment_does_not_depend_on_its_batch(recorded):
    env, params, env_state, keys, (_, batch, _, _) = recorded
    half = jax.tree.map(lambda x: x[3:], env_state)
    _, alone, _, _ = _run(env, params, half, keys[3:])
    np.testing.assert_allclose(alone.action, batch.action[:, 3:], atol=1e-5)
    np.testing.assert_array_equal(alone.done, batch.done[:, 3:])


def test_metrics_are_means_over_steps_and_over_ended_episodes(recorded):
    _, _, _, _, (_, batch, _, sums) = recorded
    weight, done = np.asarray(batch.weight), np.asarray(batch.done)
    means = mean_metrics(sums, jnp.sum(batch.weight), jnp.sum(batch.done))
    assert means["episode/num"] == done.sum() > 0
    # The toy's reward is 1 - distance.
    distance = (1.0 - np.asarray(batch.reward))[weight > 0]
    np.testing.assert_allclose(means["toy/distance"], distance.mean(), rtol=1e-4)
    lengths = []
    for i in range(NUM_ENVS):
        length = 0
        for step in range(NUM_STEPS):
            length = length + 1 if weight[step, i] else 0
            if done[step, i]:
                lengths.append(length)
    np.testing.assert_allclose(means["episode/length"], np.mean(lengths), rtol=1e-5)


def test_no_ended_episode_gives_zero():
    means = mean_metrics({"episode/length": jnp.float32(0.0)}, jnp.float32(5.0), jnp.float32(0.0))
    assert means == {"episode/length": 0.0, "episode/num": 0.0}
