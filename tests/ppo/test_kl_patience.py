"""KL patience: where an update ends, when the rate falls, and that devices and restarts agree."""

from __future__ import annotations

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy_env

from carljax.ppo import kl_patience, trainer
from carljax.ppo.config import NetworkConfig, PPOConfig
from carljax.ppo.networks import ActorCritic

NETWORK = ActorCritic(
    NetworkConfig(encoder="patch", hidden_size=8, joint_size=8, patch_features=(4, 8))
)
CONFIG = PPOConfig(
    total_samples=1_000_000,
    num_envs=8,
    num_steps=16,
    # One minibatch, so that 1 and 4 devices may be compared; the first epoch's KL is 0 then.
    num_minibatches=1,
    update_epochs=6,
    learning_rate=2e-3,
    anneal_lr=False,
    kl_patience=3,
    target_kl=3e-4,
)


def _count(exceeded, patience):
    """What the rule says, in Python: factor and count after each update."""
    scale, count, history = 1.0, 0, []
    for is_above in exceeded:
        count += is_above
        if count == patience:
            scale, count = scale / 2, 0
        history.append((scale, count))
    return history


def test_every_third_stop_halves_the_rate_whatever_lies_between():
    exceeded = [True, False, True, False, False, True, True, False, True, True, False]
    memory, history = kl_patience.start(), []
    for is_above in exceeded:
        memory = kl_patience.advance(memory, jnp.bool_(is_above), 3)
        history.append((float(memory.rate_scale), int(memory.num_stops)))
    assert history == _count(exceeded, 3)
    assert history[-1] == (0.25, 0)


@pytest.mark.parametrize(
    ("kl", "number"),
    [
        ([0.01, 0.02, 0.03, 0.0], 2),  # the second is above 0.015
        ([0.02, 0.0, 0.0, 0.0], 1),
        ([0.015, 0.015, 0.015, 0.016], 4),  # at the target is not above it
        ([0.0, 0.0, 0.0, 0.0], 4),
        ([0.0, np.nan, 0.0, 0.0], 4),  # not a number is not above either
    ],
)
def test_epochs_end_with_the_first_above_the_target(kl, number):
    """Each epoch has two steps whose mean is the given KL; the learner counts the epochs."""
    steps = jnp.float32(kl)[:, None] + jnp.float32([-0.001, 0.001])

    def epoch(learner, key):
        return learner + 1, {"kl": steps[learner], "loss": steps[learner] * 10.0}

    def run():
        keys = jax.random.split(jax.random.key(0), 4)
        return kl_patience.run_epochs(epoch, jnp.int32(0), keys, 0.015)

    learner, metrics = jax.jit(run)()
    assert int(learner) == metrics["epochs"] == number
    np.testing.assert_allclose(metrics["kl"], kl[number - 1], rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(metrics["loss"], 10.0 * np.mean(kl[:number]), rtol=1e-4, atol=1e-8)


@functools.cache
def _step(config, num_devices):
    mesh = trainer.make_mesh(num_devices)
    chex.clear_trace_counter()  # it counts by the function's name
    with pytest.MonkeyPatch.context() as patch:
        traced = chex.assert_max_traces(trainer._local_step, n=1)
        patch.setattr(trainer, "_local_step", traced)
        return trainer.make_train_step(NETWORK, config, mesh), mesh


def _updates(num, config=CONFIG, num_devices=1, state=None):
    """Runs updates; returns the state on the host and the metrics of each."""
    train_step, mesh = _step(config, num_devices)
    env = trainer.replicate(toy_env.make(), mesh)
    if state is None:
        state = trainer.init(jax.random.key(0), env, NETWORK, config, mesh)
    else:
        state = state.replace(key=jax.random.wrap_key_data(state.key))
        state = jax.device_put(state, trainer.shardings(mesh))
    history = []
    for _ in range(num):
        state, metrics = train_step(env, state)
        history.append(jax.tree.map(float, metrics))
    return jax.device_get(state.replace(key=jax.random.key_data(state.key))), history


@pytest.fixture(scope="module")
def straight():
    """Twelve updates on one device."""
    return _updates(12)


def test_the_trainer_keeps_to_the_rule(straight):
    state, history = straight
    exceeded = [metrics["ppo/kl"] > CONFIG.target_kl for metrics in history]
    expected = _count(exceeded, CONFIG.kl_patience)
    assert 3 < sum(exceeded) < 12  # both happen
    rates = [metrics["ppo/learning_rate"] for metrics in history]
    scales = [1.0] + [scale for scale, _ in expected[:-1]]
    np.testing.assert_allclose(rates, 2e-3 * np.array(scales), rtol=1e-6)
    assert (float(state.patience.rate_scale), int(state.patience.num_stops)) == expected[-1]
    epochs = [metrics["ppo/epochs"] for metrics in history]
    # An update that goes on to its last epoch may exceed there; one that ends early has to.
    for number, is_above in zip(epochs, exceeded, strict=True):
        assert is_above if number < CONFIG.update_epochs else number == CONFIG.update_epochs
    assert 1 < min(epochs) < CONFIG.update_epochs


def test_resumed_run_is_the_same_bit_for_bit(straight):
    half, first = _updates(5)
    assert int(half.patience.num_stops) + (1.0 - float(half.patience.rate_scale)) > 0
    resumed, second = _updates(7, state=half)
    chex.assert_trees_all_equal(resumed, straight[0])
    assert first + second == straight[1]


def test_four_devices_do_what_one_does(straight):
    state, history = _updates(4, num_devices=4)
    for one, four in zip(straight[1], history, strict=False):
        assert one["ppo/epochs"] == four["ppo/epochs"]
        assert one["ppo/learning_rate"] == four["ppo/learning_rate"]
        np.testing.assert_allclose(one["ppo/kl"], four["ppo/kl"], rtol=1e-2, atol=1e-6)
    one_state, _ = _updates(4)
    assert one_state.patience == state.patience
    chex.assert_trees_all_close(one_state.params, state.params, atol=1e-4)


@pytest.mark.parametrize(
    ("target_kl", "same_as"),
    [(1e9, dict(kl_patience=None)), (-1.0, dict(kl_patience=None, update_epochs=1))],
    ids=["never above", "always above"],
)
def test_it_only_shortens_updates(target_kl, same_as):
    """Up to the first epoch's end nothing differs from an update without KL patience."""
    config = dataclasses.replace(CONFIG, target_kl=target_kl, num_minibatches=4)
    state, history = _updates(1, config)
    plain, plain_history = _updates(1, dataclasses.replace(config, **same_as))
    chex.assert_trees_all_close(state.params, plain.params, atol=1e-6)
    for name, value in plain_history[0].items():
        np.testing.assert_allclose(history[0][name], value, rtol=1e-4, atol=1e-6, err_msg=name)
    assert plain.patience is None
    assert set(history[0]) - set(plain_history[0]) == {"ppo/kl", "ppo/epochs"}


def test_a_patience_of_nothing_is_refused():
    with pytest.raises(ValueError, match=r"ppo\.kl_patience must be at least 1, not 0"):
        dataclasses.replace(CONFIG, kl_patience=0).validate()
