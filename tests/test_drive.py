"""What a network's policy makes of its Beta distribution."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from carljax import drive
from carljax.drive import NetworkPolicy
from carljax.sim.types import State

NUM = 4000


class OutputsAsParams:
    """A network whose parameters are its outputs."""

    def apply(self, params, obs):
        """Returns alpha, beta and value."""
        return params


def _policy(action, alpha, beta, num):
    alpha, beta = (jnp.broadcast_to(jnp.float32(x), (num, 2)) for x in (alpha, beta))
    return NetworkPolicy((alpha, beta, jnp.zeros(num)), OutputsAsParams(), action)


def _states(num):
    zeros = jnp.zeros(num)
    return State(pipeline_state=None, obs=None, reward=zeros, done=zeros, metrics={}, info={})


@pytest.mark.parametrize(
    ("action", "expected"),
    [
        # 2 x 3 / (3 + 1) - 1, 2 x 2 / (2 + 6) - 1
        ("mean", [0.5, -0.5]),
        # at the upper end where only alpha is above 1; 2 x (2 - 1) / (2 + 6 - 2) - 1
        ("mode", [1.0, -2.0 / 3.0]),
    ],
)
def test_statistics_need_no_key_and_no_memory(action, expected):
    policy = _policy(action, [3.0, 2.0], [1.0, 6.0], num=1)
    memory = policy.init(None, jax.random.key(0))
    assert memory == ()
    command, memory = policy.act(None, _states(1), memory)
    np.testing.assert_allclose(command, [expected], atol=1e-6)
    assert memory == ()


def test_the_mean_is_the_default():
    assert NetworkPolicy(None, OutputsAsParams()).action == "mean"


def test_samples_follow_the_policy_and_are_new_at_each_step_and_on_each_route():
    policy = _policy("sample", [3.0, 2.0], [1.5, 6.0], NUM)
    keys = jax.random.split(jax.random.key(3), NUM)
    act = jax.jit(lambda memory: policy.act(None, _states(NUM), memory))
    first, memory = act(jax.vmap(lambda key: policy.init(None, key))(keys))
    second, _ = act(memory)
    for command in (first, second):
        for i, (a, b) in enumerate([(3.0, 1.5), (2.0, 6.0)]):
            x = (np.float64(command[:, i]) + 1.0) / 2.0
            assert stats.kstest(x, stats.beta(a, b).cdf).pvalue > 1e-3
    # One standard deviation of a correlation of independent samples is 1 / sqrt(4000) = 0.016.
    columns = np.concatenate([first, second], axis=1)
    np.testing.assert_allclose(np.corrcoef(columns.T), np.eye(4), atol=0.065)


def test_a_routes_samples_are_its_keys_alone():
    """The same routes in another order: each draws what it drew before."""
    keys = jax.random.split(jax.random.key(3), 6)
    order = jnp.array([4, 0, 2])
    six, three = (_policy("sample", 2.0, 3.0, num).params for num in (6, 3))
    all_six, _ = drive.act_by_chance(OutputsAsParams(), six, None, keys)
    three, _ = drive.act_by_chance(OutputsAsParams(), three, None, keys[order])
    np.testing.assert_array_equal(all_six[order], three)
    assert len(np.unique(all_six)) == 12
