"""The PPO loss against float64 NumPy and SciPy, written apart."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from carljax.ppo import hints
from carljax.ppo.config import PPOConfig
from carljax.ppo.loss import loss, surrogate, value_error
from carljax.ppo.types import Minibatch

NUM = 64


class OutputsAsParams:
    """A network whose parameters are its outputs."""

    def apply(self, params, obs):
        """Returns alpha, beta and value."""
        return params


def _minibatch():
    rng = np.random.default_rng(0)
    weight = (rng.uniform(size=NUM) < 0.8).astype(np.float64)
    outputs = (
        rng.uniform(1.0, 4.0, (NUM, 2)),
        rng.uniform(1.0, 4.0, (NUM, 2)),
        rng.normal(size=NUM),
    )
    action = rng.uniform(0.02, 0.98, (NUM, 2))
    log_prob = np.sum(stats.beta.logpdf(action, *outputs[:2]), -1) + 0.2 * rng.normal(size=NUM)
    columns = dict(
        action=action,
        log_prob=log_prob,
        value=outputs[2] + 0.3 * rng.normal(size=NUM),
        advantage=rng.normal(size=NUM),
        target=rng.normal(size=NUM),
        weight=weight / weight.sum(),
    )
    return outputs, columns


def _oracle(outputs, columns, config):
    alpha, beta, value = outputs
    batch = {k: v[columns["weight"] > 0] for k, v in columns.items()}
    alpha, beta, value = (x[columns["weight"] > 0] for x in (alpha, beta, value))
    log_ratio = stats.beta.logpdf(batch["action"], alpha, beta).sum(-1) - batch["log_prob"]
    ratio, low, high = np.exp(log_ratio), 1.0 - config.clip_coef, 1.0 + config.clip_coef
    gain = np.minimum(
        batch["advantage"] * ratio, batch["advantage"] * np.minimum(np.maximum(ratio, low), high)
    )
    squared = (value - batch["target"]) ** 2
    if config.clip_vloss is not None:
        change = np.clip(value - batch["value"], -config.clip_vloss, config.clip_vloss)
        squared = np.maximum(squared, (batch["value"] + change - batch["target"]) ** 2)
    entropy = np.vectorize(lambda a, b: stats.beta(a, b).entropy())(alpha, beta).sum(-1).mean()
    parts = {
        "policy_loss": -gain.mean(),
        "value_loss": (0.5 if config.vloss_half else 1.0) * squared.mean(),
        "entropy": entropy,
        "approx_kl": np.mean(ratio - 1.0 - log_ratio),
        "clip_frac": np.mean((ratio < low) | (ratio > high)),
    }
    bonus = entropy / {"sum": 1, "mean": 2}[config.entropy_reduction]
    total = parts["policy_loss"] - config.ent_coef * bonus + config.vf_coef * parts["value_loss"]
    return total, parts


VARIANTS = {
    "value clipped": dict(clip_vloss=0.1),
    "value not clipped": dict(clip_vloss=None),
    "Roach's": dict(clip_vloss=None, vloss_half=False, entropy_reduction="mean"),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_loss_and_metrics_equal_the_oracle(variant):
    config = PPOConfig(clip_coef=0.15, ent_coef=0.03, vf_coef=0.7, **VARIANTS[variant])
    outputs, columns = _minibatch()
    expected, expected_parts = _oracle(outputs, columns, config)
    minibatch = Minibatch(obs=None, **jax.tree.map(jnp.float32, columns))
    params = jax.tree.map(jnp.float32, outputs)
    actual, parts = jax.jit(lambda p: loss(p, OutputsAsParams(), minibatch, config))(params)
    np.testing.assert_allclose(actual, expected, rtol=2e-5)
    assert parts.keys() == expected_parts.keys()
    assert 0.0 < expected_parts["clip_frac"] < 1.0
    for name, part in expected_parts.items():
        np.testing.assert_allclose(parts[name], part, rtol=1e-4, atol=1e-6, err_msg=name)


def test_kl_is_that_of_the_old_policy_to_the_new_one():
    """Mean over both actions and over the samples that count, each integrated by SciPy."""
    outputs, columns = _minibatch()
    rng = np.random.default_rng(5)
    old = [x + rng.uniform(-0.4, 0.4, x.shape) for x in outputs[:2]]

    def integral(*parameters):
        def integrand(x):
            p, q = stats.beta(*parameters[:2]), stats.beta(*parameters[2:])
            return p.pdf(x) * (p.logpdf(x) - q.logpdf(x))

        return integrate.quad(integrand, 0.0, 1.0, epsabs=1e-7)[0]

    rows = np.flatnonzero(columns["weight"])[:6]
    columns["weight"] = np.where(np.isin(np.arange(NUM), rows), 1.0 / 6.0, 0.0)
    expected = np.mean(np.vectorize(integral)(*[x[rows] for x in (*old, *outputs[:2])]))
    policy = tuple(jnp.float32(x) for x in old)
    minibatch = Minibatch(obs=None, policy=policy, **jax.tree.map(jnp.float32, columns))
    params = jax.tree.map(jnp.float32, outputs)
    total, parts = loss(params, OutputsAsParams(), minibatch, PPOConfig())
    np.testing.assert_allclose(parts["kl"], expected, rtol=1e-3)
    without, _ = loss(params, OutputsAsParams(), minibatch.replace(policy=None), PPOConfig())
    assert total == without  # it is measured, not minimised


def test_hints_add_their_own_loss():
    """Samples with the hint to stop: KL(Beta(a, b) || Beta(1, 1.5)) / 2 of the second action.

    Here a = b = 2: with log B(1, 1.5) = log(2 / 3), log B(2, 2) = log(1 / 6), psi(2) = 1 - gamma
    and psi(4) = 11 / 6 - gamma it is log 4 + (1 + 0.5) (1 - gamma) - 1.5 (11 / 6 - gamma)
    = log 4 - 1.25.
    """
    outputs, columns = _minibatch()
    outputs = (np.full((NUM, 2), 2.0), np.full((NUM, 2), 2.0), outputs[2])
    plain = Minibatch(obs=None, **jax.tree.map(jnp.float32, columns))
    is_hinted = np.arange(NUM) % 3 == 0
    hinted = plain.replace(hint=jnp.asarray(np.where(is_hinted, hints.STOP, hints.NONE), jnp.int8))
    params, config = jax.tree.map(jnp.float32, outputs), PPOConfig(hint_coef=0.05)
    (total, parts), (without, _) = (
        loss(params, OutputsAsParams(), minibatch, config) for minibatch in (hinted, plain)
    )
    expected = np.sum(columns["weight"][is_hinted]) * (np.log(4.0) - 1.25) / 2.0
    np.testing.assert_allclose(parts["hint_loss"], expected, rtol=1e-4)
    np.testing.assert_allclose(total - without, 0.05 * expected, rtol=1e-2, atol=1e-7)


@pytest.mark.parametrize("variant", VARIANTS)
def test_gradient_equals_finite_differences_of_the_oracle(variant):
    config = PPOConfig(clip_coef=0.15, ent_coef=0.03, vf_coef=0.7, **VARIANTS[variant])
    outputs, columns = _minibatch()
    minibatch = Minibatch(obs=None, **jax.tree.map(jnp.float32, columns))
    grads = jax.jit(jax.grad(lambda p: loss(p, OutputsAsParams(), minibatch, config)[0]))(
        jax.tree.map(jnp.float32, outputs)
    )
    step = 1e-6
    for i, row in [(0, 3), (0, 11), (1, 3), (1, 40), (2, 3), (2, 17), (2, 40)]:
        index = (row, 1)[: outputs[i].ndim]
        sides = []
        for sign in (1.0, -1.0):
            moved = [x.copy() for x in outputs]
            moved[i][index] += sign * step
            sides.append(_oracle(moved, columns, config)[0])
        expected = (sides[0] - sides[1]) / (2.0 * step)
        np.testing.assert_allclose(grads[i][index], expected, rtol=1e-3, atol=1e-6)
    masked = columns["weight"] == 0.0
    assert masked.any()
    for grad in grads:
        np.testing.assert_array_equal(grad[masked], 0.0)


@pytest.mark.parametrize(
    ("ratio", "advantage", "expected"),
    [
        (1.05, 2.0, -2.1),  # within the range: -A r
        (1.5, 2.0, -2.2),  # too far up: -2 * 1.1
        (0.5, 2.0, -1.0),  # may come back: -2 * 0.5
        (0.5, -2.0, 1.8),  # too far down: 2 * 0.9
        (1.5, -2.0, 3.0),  # may come back: 2 * 1.5
    ],
)
def test_surrogate(ratio, advantage, expected):
    actual = surrogate(jnp.float32(ratio), jnp.float32(advantage), 0.1)
    np.testing.assert_allclose(actual, expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("value", "clip", "expected"),
    [
        (1.5, None, 0.125),  # (1.5 - 2)^2 / 2
        (1.5, 0.1, 0.405),  # moved from 1 to at most 1.1: (1.1 - 2)^2 / 2
        (0.5, 0.1, 1.125),  # moved away: (0.5 - 2)^2 / 2 is the larger
    ],
)
def test_value_error(value, clip, expected):
    old, target = jnp.float32(1.0), jnp.float32(2.0)
    np.testing.assert_allclose(
        value_error(jnp.float32(value), old, target, clip), expected, rtol=1e-6
    )
