"""The whole train step in the toy environment: learns, traces once, resumes, shares out."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy_env
from jax.sharding import PartitionSpec

from carljax.ppo import trainer, update
from carljax.ppo.config import NetworkConfig, PPOConfig
from carljax.ppo.networks import ActorCritic
from carljax.ppo.types import Minibatch

NETWORK = ActorCritic(
    NetworkConfig(
        encoder="patch", hidden_size=32, joint_size=32, patch_size=4, patch_features=(8, 16)
    )
)
CONFIG = PPOConfig(
    total_samples=20 * 16 * 32,
    num_envs=16,
    num_steps=32,
    # One minibatch: a device's own shuffle doesn't matter, and 1 and 4 devices may be compared.
    num_minibatches=1,
    update_epochs=8,
    micro_batch_size=64,
    learning_rate=4e-3,
    clip_coef=0.2,
    clip_vloss=None,
)
# For programs that run but twice: machine code that is made fast, not good.
HASTY = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}

COMPILATIONS = []


def _listen(event, seconds, **_):
    if "backend_compile" in event:
        COMPILATIONS.append(event)


jax.monitoring.register_event_duration_secs_listener(_listen)


class Run:
    """A compiled train step and what it needs."""

    def __init__(self, num_devices, compiler_options=None):
        self.mesh = trainer.make_mesh(num_devices)
        self.env = trainer.replicate(toy_env.make(), self.mesh)
        self.first = trainer.init(jax.random.key(0), self.env, NETWORK, CONFIG, self.mesh)
        chex.clear_trace_counter()  # it can't tell the train steps of several runs apart
        with pytest.MonkeyPatch.context() as patch:
            traced = chex.assert_max_traces(trainer._local_step, n=1)
            patch.setattr(trainer, "_local_step", traced)
            if compiler_options is not None:
                patch.setattr(trainer, "compiler_options", lambda platform: compiler_options)
            self.train_step = trainer.make_train_step(NETWORK, CONFIG, self.mesh)
        later, _ = self.updates(self.copy(self.first), 1)
        before = len(COMPILATIONS)
        self.updates(later, 1)
        self.compiled_again = len(COMPILATIONS) - before

    def start(self):
        """Returns a copy of the first training state, for the train step to consume."""
        return self.copy(self.first)

    def copy(self, train_state):
        """Copies a training state through the host, as a checkpoint does."""
        return jax.device_put(_host(train_state), trainer.shardings(self.mesh))

    def updates(self, train_state, num):
        """Runs updates, each traced at most once; returns the state and the metrics of each."""
        history = []
        for _ in range(num):
            train_state, metrics = self.train_step(self.env, train_state)
            history.append(jax.tree.map(float, metrics))
        return train_state, history


@functools.cache
def _run(num_devices):
    return Run(num_devices, HASTY if num_devices in (2, 8) else None)


@pytest.fixture(scope="module")
def one_device():
    return _run(1)


@pytest.fixture(scope="module")
def four_devices():
    return _run(4)


@pytest.fixture(scope="module", params=[2, 4, 8])
def several_devices(request):
    return _run(request.param)


def _is_key(x):
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def _host(tree):
    """Copies to NumPy; keys stay keys, on one device."""

    def copy(x):
        if _is_key(x):
            return jax.random.wrap_key_data(np.array(jax.random.key_data(x)))
        return np.array(x)

    return jax.tree.map(copy, tree)


def _data(tree):
    """Copies to NumPy, keys as their data."""
    return jax.tree.map(lambda x: np.array(jax.random.key_data(x) if _is_key(x) else x), tree)


def test_learns_to_keep_the_dot_in_the_middle(one_device):
    train_state, history = one_device.updates(one_device.start(), 20)
    # Actions drawn at random leave the image in the middle of most episodes.
    assert history[0]["toy/distance"] > 0.35
    assert history[-1]["toy/distance"] < 0.2
    assert history[-1]["rollout/reward"] > 0.75
    assert history[-1]["episode/length"] == 32.0
    assert all(np.isfinite(value) for metrics in history for value in metrics.values())
    assert int(train_state.update) == 20
    np.testing.assert_allclose(history[5]["ppo/learning_rate"], 4e-3 * (1 - 5 / 20), rtol=1e-6)


def test_metrics_are_scalars_of_these_names(one_device):
    _, metrics = one_device.train_step(one_device.env, one_device.start())
    assert set(metrics) == {
        "episode/length",
        "episode/num",
        "ppo/approx_kl",
        "ppo/clip_frac",
        "ppo/entropy",
        "ppo/explained_variance",
        "ppo/grad_norm",
        "ppo/learning_rate",
        "ppo/policy_loss",
        "ppo/value_loss",
        "rollout/reward",
        "rollout/value",
        "toy/distance",
    }
    for metric in metrics.values():
        assert metric.shape == ()
        assert metric.dtype == jnp.float32


def test_every_number_of_the_learner_is_explained_with_what_is_healthy():
    """Those that come with an option too: each has a row that says what it is, and a second one."""
    config = dataclasses.replace(CONFIG, kl_patience=8, hint_coef=0.05, micro_batch_size=None)
    samples = jax.eval_shape(_samples_with_everything)
    keys, rate = jax.random.key(0), jnp.float32(0.0)
    optimizer = update.make_optimizer(config)

    def learn(samples):
        params = NETWORK.init(keys, samples.obs)
        return update.update(params, optimizer.init(params), samples, keys, rate, NETWORK, config)[
            2
        ]

    spec = PartitionSpec()
    names = jax.eval_shape(
        jax.shard_map(
            learn, mesh=trainer.make_mesh(1), in_specs=spec, out_specs=spec, check_vma=False
        ),
        samples,
    )
    text = (Path(__file__).resolve().parents[2] / "docs" / "metrics.md").read_text()
    for name in (*names, "explained_variance", "learning_rate"):
        assert text.count(f"\n| `ppo/{name}` |") == 2, name


def _samples_with_everything(num=4):
    env = toy_env.make()
    obs = jax.eval_shape(lambda: env.observe(env.start(jax.random.key(0))).obs)
    zeros = jnp.zeros(num, jnp.float32)
    pair = jnp.ones((num, 2), jnp.float32)
    return Minibatch(
        obs=jax.tree.map(lambda x: jnp.zeros((num, *x.shape), x.dtype), obs),
        action=0.5 * pair,
        log_prob=zeros,
        value=zeros,
        advantage=zeros,
        target=zeros,
        weight=zeros,
        policy=(pair, pair),
        hint=jnp.zeros(num, jnp.int8),
    )


def test_resumed_run_is_the_same_bit_for_bit(one_device):
    through, history = one_device.updates(one_device.start(), 4)
    half, _ = one_device.updates(one_device.start(), 2)
    resumed, later = one_device.updates(one_device.copy(half), 2)
    chex.assert_trees_all_equal(_data(through), _data(resumed))
    assert history[2:] == later


def test_runs_with_other_keys_differ(one_device):
    other = one_device.copy(one_device.first.replace(key=jax.random.key(7)))
    (_, first), (_, second) = (
        one_device.updates(state, 1) for state in (one_device.start(), other)
    )
    assert first[0]["rollout/reward"] != second[0]["rollout/reward"]


def test_several_devices_do_what_one_does(one_device, several_devices):
    chex.assert_trees_all_equal(_data(one_device.first), _data(several_devices.first))
    states, metrics = zip(
        *[run.updates(run.start(), 2) for run in (one_device, several_devices)], strict=True
    )
    one, several = map(_data, states)
    chex.assert_trees_all_close(
        one.env_state.pipeline_state, several.env_state.pipeline_state, atol=1e-3
    )
    for before, after in zip(*metrics, strict=True):
        for name, value in before.items():
            np.testing.assert_allclose(value, after[name], rtol=2e-3, atol=1e-4, err_msg=name)
    chex.assert_trees_all_close(one.params, several.params, atol=1e-3)
    moved = jax.tree.map(
        lambda a, b: np.max(np.abs(a - b)), one.params, _data(one_device.first.params)
    )
    assert max(jax.tree.leaves(moved)) > 0.02


def test_compiled_once(one_device, four_devices):
    """A first state placed otherwise than the later ones would compile the program twice."""
    assert COMPILATIONS  # the event is still called so
    assert one_device.compiled_again == four_devices.compiled_again == 0


def test_state_is_where_the_mesh_wants_it(four_devices):
    later, _ = four_devices.updates(four_devices.start(), 1)
    for train_state in (four_devices.first, later):
        assert all(x.is_fully_replicated for x in jax.tree.leaves(train_state.params))
        for leaf in jax.tree.leaves(train_state.env_state):
            assert len(leaf.sharding.device_set) == 4
            assert leaf.addressable_shards[0].data.shape[0] == CONFIG.num_envs // 4


@pytest.mark.parametrize(
    ("change", "num_devices", "message"),
    [
        (dict(num_envs=6), 4, "ppo.num_envs is 6, which devices = 4 does not divide"),
        (dict(num_minibatches=7), 1, "is 512, which ppo.num_minibatches = 7 does not divide"),
        (dict(num_minibatches=8), 1, "is 64, which ppo.micro_batch_size = 48 does not divide"),
        (dict(num_steps=0), 1, "ppo.num_steps must be at least 1, not 0"),
    ],
    ids=["devices", "minibatches", "micro-batches", "zero"],
)
def test_sizes_that_do_not_divide_are_named(change, num_devices, message):
    config = dataclasses.replace(CONFIG, micro_batch_size=48, **change)
    with pytest.raises(ValueError, match=message):
        trainer.make_train_step(NETWORK, config, trainer.make_mesh(num_devices))


def test_derived_sizes():
    config = PPOConfig()  # source: CaRL paper, 300 M samples of 128 x 512: 4577.6 updates
    assert (config.batch_size, config.minibatch_size, config.num_updates) == (65536, 16384, 4578)


def test_more_devices_than_there_are():
    with pytest.raises(ValueError, match="99 devices were asked for, but there are 8"):
        trainer.make_mesh(99)


def test_compiler_options_are_for_cpus_that_know_them():
    assert trainer.compiler_options("cuda") is None
    assert not trainer._is_known((("xla_there_is_no_such_option", ""),))
