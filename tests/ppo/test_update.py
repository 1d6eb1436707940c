"""The update: pieces add up, devices agree, Adam's step, and the compiled form on a CPU."""

from __future__ import annotations

import dataclasses
import functools

import fill
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec

from carljax.ppo import trainer, update
from carljax.ppo.config import NetworkConfig, PPOConfig
from carljax.ppo.networks import ActorCritic
from carljax.ppo.types import Minibatch
from carljax.sim.types import Observation

NUM = 32
REPLICATED = PartitionSpec()
NETWORK = ActorCritic(
    NetworkConfig(encoder="patch", hidden_size=8, joint_size=8, patch_features=(4, 4))
)


def _samples(num=NUM, size=16):
    rng = np.random.default_rng(0)

    def normal(*shape):
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    # The devices' shares differ in mean, spread and number of valid samples.
    drift = jnp.linspace(-2.0, 3.0, num, dtype=jnp.float32)
    weight = rng.uniform(size=num) < np.linspace(0.3, 1.0, num)
    return Minibatch(
        obs=Observation(
            raster=jnp.asarray(rng.integers(0, 256, (num, size, size, 3)), jnp.uint8),
            scalars=normal(num, 8),
            value_scalars=normal(num, 10),
        ),
        action=jnp.asarray(rng.uniform(0.1, 0.9, (num, 2)), jnp.float32),
        log_prob=0.3 * normal(num),
        value=normal(num),
        advantage=normal(num) * (2.0 + drift) + drift,
        target=normal(num) + drift,
        weight=jnp.asarray(weight, jnp.float32),
    )


def _samples_with_policy():
    samples = _samples()
    alpha, beta, _ = NETWORK.apply(_params(), samples.obs)
    return samples.replace(policy=(alpha, beta))


@functools.cache
def _params(network=NETWORK, size=16):
    obs = jax.tree.map(lambda x: x[:1], _samples(4, size).obs)
    return fill.params(network, obs)


def _on_devices(function, num_devices, out_specs=REPLICATED):
    """Shares samples out over devices; everything else is on all of them."""
    return jax.jit(
        jax.shard_map(
            function,
            mesh=trainer.make_mesh(num_devices),
            in_specs=PartitionSpec(update.AXIS),
            out_specs=out_specs,
            check_vma=False,
        )
    )


@functools.cache
def _gradient(config, num_devices):
    params = _params()

    def run(samples):
        rows = jnp.arange(samples.weight.shape[0])[::-1]
        return update.minibatch_gradient(params, samples, rows, NETWORK, config)

    return _on_devices(run, num_devices)(_samples())


@pytest.mark.parametrize(
    ("num_devices", "micro_batch_size"),
    [(4, None), (4, 2)],
    ids=["4 devices", "4 devices, micro-batches"],
)
def test_gradient_and_metrics_are_those_of_the_whole_minibatch(num_devices, micro_batch_size):
    whole = _gradient(PPOConfig(), 1)
    parts = _gradient(PPOConfig(micro_batch_size=micro_batch_size), num_devices)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), whole, parts)
    assert max(float(jnp.max(jnp.abs(x))) for x in jax.tree.leaves(whole[0])) > 1e-2


@pytest.mark.parametrize("num_devices", [1, 4])
def test_normalised_advantages(num_devices):
    samples = _samples()
    run = _on_devices(
        lambda s: update.normalise(s.advantage, s.weight),
        num_devices,
        out_specs=PartitionSpec(update.AXIS),
    )
    advantage = np.float64(samples.advantage)
    valid = advantage[np.asarray(samples.weight) > 0]
    expected = (advantage - valid.mean()) / (valid.std(ddof=1) + 1e-8)
    np.testing.assert_allclose(run(samples), expected, atol=1e-5)


def test_advantages_normalised_on_each_device_by_itself():
    """The four shares one after the other; on one device that is the whole minibatch."""
    samples = _samples()
    spec = PartitionSpec(update.AXIS)

    def run(samples):
        return update.normalise(samples.advantage, samples.weight, update.no_sum)

    shares = np.split(np.float64(samples.advantage), 4)
    valid = np.split(np.asarray(samples.weight) > 0, 4)
    expected = [
        (x - x[v].mean()) / (x[v].std(ddof=1) + 1e-8) for x, v in zip(shares, valid, strict=True)
    ]
    on_four = np.asarray(_on_devices(run, 4, out_specs=spec)(samples))
    np.testing.assert_allclose(on_four, np.concatenate(expected), rtol=1e-4, atol=1e-5)
    on_one = _on_devices(run, 1, out_specs=spec)(samples)
    together = _on_devices(lambda s: update.normalise(s.advantage, s.weight), 4, out_specs=spec)
    np.testing.assert_allclose(on_one, together(samples), atol=1e-5)
    assert np.max(np.abs(on_four - on_one)) > 0.1


def test_the_scope_of_normalisation_reaches_the_gradient():
    alone, whole = PPOConfig(norm_adv_scope="device"), PPOConfig()
    four, one = (float(_gradient(alone, num)[1]["policy_loss"]) for num in (4, 1))
    np.testing.assert_allclose(one, _gradient(whole, 1)[1]["policy_loss"], rtol=1e-5)
    assert abs(four - one) > 1e-3


@pytest.mark.parametrize("num_devices", [1, 4])
def test_late_advantages_are_those_of_the_whole_batch(num_devices):
    samples = _samples()
    config = PPOConfig(norm_adv_scope="late")
    spec = PartitionSpec(update.AXIS)
    later = _on_devices(lambda s: update.later_advantage(s, config), num_devices, out_specs=spec)
    advantage = np.float64(samples.advantage)
    valid = advantage[np.asarray(samples.weight) > 0]
    expected = (advantage - valid.mean()) / valid.std(ddof=1)
    np.testing.assert_allclose(later(samples), expected, atol=1e-5)


@pytest.mark.parametrize("kl_patience", [None, 8])
def test_late_normalisation_leaves_the_first_epoch_alone(kl_patience):
    """At a rate of 0 every epoch has the same gradient, but for its advantages."""

    def policy_loss(epochs, **changes):
        config = PPOConfig(
            update_epochs=epochs, num_minibatches=1, kl_patience=kl_patience, target_kl=1e9
        )
        config = dataclasses.replace(config, **changes)
        return float(_update(config, rate=0.0)(_samples_with_policy())[2]["policy_loss"])

    raw, late = policy_loss(1, norm_adv=False), policy_loss(1)
    assert abs(raw - late) > 1e-2
    late_only = dict(norm_adv_scope="late")
    np.testing.assert_allclose(policy_loss(1, **late_only), raw, rtol=1e-5)
    np.testing.assert_allclose(policy_loss(3, **late_only), (raw + 2 * late) / 3, rtol=1e-5)
    np.testing.assert_allclose(policy_loss(3, norm_adv=False, **late_only), raw, rtol=1e-5)


@pytest.mark.parametrize("num_devices", [1, 4])
def test_explained_variance(num_devices):
    samples = _samples()
    samples = samples.replace(value=0.7 * samples.target + 0.2 * samples.value)
    valid = np.asarray(samples.weight) > 0
    target, value = np.float64(samples.target)[valid], np.float64(samples.value)[valid]
    expected = 1.0 - np.var(target - value) / np.var(target)
    assert 0.5 < expected < 0.99
    actual = _on_devices(update.explained_variance, num_devices)(samples)
    np.testing.assert_allclose(actual, expected, rtol=1e-4)


def test_a_batch_of_restarts_changes_nothing_but_stays_finite():
    samples = _samples().replace(weight=jnp.zeros((NUM,), jnp.float32))
    params = _params()

    def run(samples):
        return update.minibatch_gradient(params, samples, jnp.arange(NUM), NETWORK, PPOConfig())[0]

    for grad in jax.tree.leaves(_on_devices(run, 1)(samples)):
        np.testing.assert_array_equal(grad, 0.0)


def _update(config, network=NETWORK, size=16, rate=0.01):
    params = _params(network, size)
    opt_state = update.make_optimizer(config).init(params)

    def run(samples):
        return update.update(
            params, opt_state, samples, jax.random.key(3), jnp.float32(rate), network, config
        )

    return _on_devices(run, 1)


def test_one_step_is_clipped_adam():
    """First step of Adam: both moments are bias-corrected to g and g^2, so -lr g / (|g| + eps)."""
    config = PPOConfig(update_epochs=1, num_minibatches=1, max_grad_norm=0.05)
    grads, _ = _gradient(PPOConfig(), 1)
    flat = np.concatenate([np.float64(g).ravel() for g in jax.tree.leaves(grads)])
    norm = np.sqrt(np.sum(flat**2))
    assert norm > 0.1  # clipping does something
    params, _, metrics = _update(config)(_samples())
    np.testing.assert_allclose(metrics["grad_norm"], norm, rtol=1e-4)

    def check(before, after, grad):
        clipped = np.float64(grad) * 0.05 / norm
        expected = np.float64(before) - 0.01 * clipped / (np.abs(clipped) + 1e-5)
        np.testing.assert_allclose(after, expected, atol=2e-5)

    jax.tree.map(check, _params(), params, grads)


def test_each_epoch_takes_every_sample_once_in_a_new_order(monkeypatch):
    config = PPOConfig(update_epochs=2, num_minibatches=4)
    taken = []

    def record(params, samples, rows, network, config, recall):
        jax.debug.callback(lambda rows: taken.append(rows.tolist()), rows, ordered=True)
        return jax.tree.map(jnp.zeros_like, params), {"loss": jnp.float32(0.0)}

    monkeypatch.setattr(update, "minibatch_gradient", record)
    jax.block_until_ready(_update(config)(_samples()))
    jax.effects_barrier()
    assert [len(rows) for rows in taken] == [NUM // 4] * 8
    epochs = [sum(taken[:4], []), sum(taken[4:], [])]
    assert sorted(epochs[0]) == sorted(epochs[1]) == list(range(NUM))
    assert epochs[0] != epochs[1] != list(range(NUM))


def test_learning_rate_falls_linearly_to_zero():
    config = PPOConfig(total_samples=1000, num_envs=10, num_steps=10, learning_rate=1e-3)
    rates = [float(update.learning_rate(jnp.int32(u), config)) for u in (0, 5, 9, 10, 11)]
    np.testing.assert_allclose(rates, [1e-3, 5e-4, 1e-4, 0.0, 0.0], atol=1e-9)
    # lr (1 - (u - 1) / N): 1.1 lr at first, 2 / N of it in the last update, number 9
    late = dataclasses.replace(config, lr_schedule="late")
    rates = [float(update.learning_rate(jnp.int32(u), late)) for u in (0, 1, 6, 9, 11)]
    np.testing.assert_allclose(rates, [1.1e-3, 1e-3, 5e-4, 2e-4, 0.0], atol=1e-9)
    constant = PPOConfig(anneal_lr=False, learning_rate=1e-3)
    assert update.learning_rate(jnp.int32(5), constant) == np.float32(1e-3)


def test_compiled_update_has_no_slow_convolution():
    """In a loop `f01b_i01o` is 22 to 75 times slower; `__ynn_fusion` runs on one thread."""
    network = ActorCritic(
        NetworkConfig(encoder="roach", layer_norm=False, hidden_size=8, joint_size=8)
    )
    config = PPOConfig(update_epochs=2, num_minibatches=2, micro_batch_size=8)
    lowered = _update(config, network, 32).lower(_samples(size=32))
    text = lowered.compile(compiler_options=trainer.compiler_options("cpu")).as_text()
    assert "convolution(" in text
    assert "f01b_i01o" not in text
    assert "__ynn_fusion" not in text


def test_a_plain_convolution_in_a_loop_is_the_slow_one():
    """Guards the guard above: if XLA gives the slow form another name, this fails."""
    x, w = jnp.ones((3, 4, 16, 16, 3), jnp.float32), jnp.ones((3, 3, 3, 4), jnp.float32)

    def total(w):
        def step(carry, x):
            dimensions = ("NHWC", "HWIO", "NHWC")
            out = jax.lax.conv_general_dilated(x, w, (2, 2), "VALID", dimension_numbers=dimensions)
            return carry + jnp.sum(out**2), None

        return jax.lax.scan(step, jnp.float32(0.0), x)[0]

    compiled = jax.jit(jax.grad(total)).lower(w).compile()
    assert "f01b_i01o" in compiled.as_text()
