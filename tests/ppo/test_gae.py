"""Advantages over a rollout with restarts, against GAE of each episode alone."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from carljax.ppo.config import PPOConfig
from carljax.ppo.gae import gae
from carljax.ppo.trainer import make_samples
from carljax.ppo.types import Transition

GAMMA, LAMBDA = 0.9, 0.8


def _episode_gae(reward, value, next_value):
    """Textbook GAE of one episode of float64 lists; next_value is what its last step leads to."""
    values = [*value, next_value]
    advantage, later = [], 0.0
    for t in reversed(range(len(reward))):
        later = reward[t] + GAMMA * values[t + 1] - values[t] + GAMMA * LAMBDA * later
        advantage.insert(0, later)
    return advantage


def _oracle(reward, value, last_value, ends):
    """Cuts one environment's rollout into episodes. ends: {step: "terminated" | "truncated"}."""
    values = [*value, last_value]
    advantage = np.zeros(len(reward))
    start = 0
    for t in range(len(reward)):
        if t - 1 in ends:  # the restart step: no decision, no advantage
            start = t + 1
            continue
        if t in ends or t == len(reward) - 1:
            # The observation after the step is the episode's own last one, before the restart.
            next_value = 0.0 if ends.get(t) == "terminated" else values[t + 1]
            advantage[start : t + 1] = _episode_gae(
                reward[start : t + 1], value[start : t + 1], next_value
            )
    return advantage


CASES = {
    "neither": {},
    "terminated": {3: "terminated"},
    "truncated": {3: "truncated"},
    "two episodes": {2: "truncated", 6: "terminated"},
    "restart in the first row": {-1: "truncated"},
    "restart in the last row": {8: "terminated"},
    "terminated by the last step": {9: "terminated"},
    "truncated by the last step": {9: "truncated"},
    "an episode of one step": {3: "truncated", 5: "terminated"},
}


def _rollout(case):
    num_steps = 10
    rng = np.random.default_rng(list(CASES).index(case))
    ends = CASES[case]
    reward, value = rng.normal(size=(2, num_steps))
    weight = np.ones(num_steps)
    for t in ends:
        if t + 1 < num_steps:
            weight[t + 1] = 0.0
            reward[t + 1] = 0.0
    done = np.array([float(t in ends) for t in range(num_steps)])
    truncation = np.array([float(ends.get(t) == "truncated") for t in range(num_steps)])
    return reward, value, rng.normal(), done, truncation, weight


@pytest.mark.parametrize("transform", [lambda f: f, jax.jit], ids=["eager", "jit"])
def test_gae_is_that_of_each_episode_alone(transform):
    columns = [_rollout(case) for case in CASES]
    reward, value, last_value, done, truncation, weight = (
        np.stack(c, axis=-1).astype(np.float32) for c in zip(*columns, strict=True)
    )
    run = transform(lambda *args: gae(*args, GAMMA, LAMBDA))
    actual = run(reward, value, last_value, done - truncation, weight)
    for i, case in enumerate(CASES):
        r, v, last, *_ = columns[i]
        expected = _oracle(r, v, last, CASES[case])
        np.testing.assert_allclose(actual[:, i], expected, atol=2e-6, err_msg=case)


def test_hand_worked():
    # r = 1, 2; V = 0.5, 1, last 2; gamma 0.9, lambda 0.8, truncated by the second step:
    # delta_1 = 2 + 0.9 * 2 - 1 = 2.8;  delta_0 = 1 + 0.9 * 1 - 0.5 = 1.4
    # A_1 = 2.8;  A_0 = 1.4 + 0.72 * 2.8 = 3.416. Terminated instead: delta_1 = 1, A_0 = 2.12.
    column = lambda *x: jnp.float32(x)[:, None]  # noqa: E731
    reward, value, ones = column(1, 2), column(0.5, 1), column(1, 1)
    truncated = gae(reward, value, jnp.float32([2]), column(0, 0), ones, GAMMA, LAMBDA)
    np.testing.assert_allclose(truncated[:, 0], [3.416, 2.8], rtol=1e-6)
    terminated = gae(reward, value, jnp.float32([2]), column(0, 1), ones, GAMMA, LAMBDA)
    np.testing.assert_allclose(terminated[:, 0], [2.12, 1.0], rtol=1e-6)


@pytest.mark.parametrize(
    ("done", "truncation", "bootstrap", "last"),
    [
        (1.0, 0.0, True, 0.0),
        (1.0, 1.0, True, 2.0),
        (0.0, 0.0, True, 2.0),
        (1.0, 1.0, False, 0.0),
        (0.0, 0.0, False, 2.0),
    ],
    ids=[
        "terminated",
        "truncated",
        "neither",
        "truncated, the code's way",
        "neither, the code's way",
    ],
)
def test_what_follows_the_last_step_is_worth(done, truncation, bootstrap, last):
    one = jnp.ones((1, 1), jnp.float32)
    batch = Transition(
        obs=None,
        action=jnp.full((1, 1, 2), 0.5, jnp.float32),
        log_prob=0 * one,
        value=one,
        reward=3 * one,
        done=done * one,
        truncation=truncation * one,
        weight=one,
    )
    config = PPOConfig(gamma=0.5, bootstrap_truncated=bootstrap)
    samples = make_samples(batch, jnp.float32([2.0]), config)
    # Return = reward 3 + 0.5 * the value of what follows; advantage = return - value 1.
    np.testing.assert_allclose(samples.target, [3.0 + 0.5 * last])
    np.testing.assert_allclose(samples.advantage, [2.0 + 0.5 * last])
