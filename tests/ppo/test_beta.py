"""The Beta policy against SciPy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, special, stats

from carljax.ppo import beta

PAIRS = [(1.0, 1.0), (1.0, 3.0), (2.5, 1.2), (7.0, 7.0), (40.0, 2.0), (300.0, 500.0)]
ROACH_PAIRS = [(0.3, 0.7), (0.05, 2.0), (0.01, 0.01)]
ENDS = [0.0, 1e-7, 1e-3, 0.3, 0.5, 0.999, 1.0 - 1e-7, 1.0]


def _arrays(alpha: float, beta_: float) -> tuple[jax.Array, jax.Array]:
    return jnp.float32([alpha, beta_]), jnp.float32([beta_, alpha])


def test_samples_follow_the_beta_distribution():
    """Kolmogorov-Smirnov, 20,000 samples each; below 1e-4 one in ten thousand seeds would fall."""
    alpha, beta_ = np.float32(PAIRS + ROACH_PAIRS[:2]).T
    num = 20_000
    keys = jax.random.split(jax.random.key(0), num)
    draw = jax.jit(jax.vmap(lambda key: beta.sample(key, alpha, beta_)))
    samples = np.asarray(draw(keys), np.float64)
    assert samples.shape == (num, len(alpha))
    for i, (a, b) in enumerate(zip(alpha, beta_, strict=True)):
        # Samples are clipped at 1e-7, so the comparison leaves out what lies beyond.
        inside = samples[(samples[:, i] > 2e-7) & (samples[:, i] < 1 - 2e-7), i]
        low, high = stats.beta.cdf([2e-7, 1 - 2e-7], a, b)

        def cdf(x, a=a, b=b, low=low, high=high):
            return (stats.beta.cdf(x, a, b) - low) / (high - low)

        assert stats.kstest(inside, cdf).pvalue > 1e-4, (a, b)
        assert len(inside) / num == pytest.approx(high - low, abs=0.015)


def test_samples_are_independent_of_each_other():
    samples = jax.vmap(lambda key: beta.sample(key, *_arrays(2.0, 3.0)))(
        jax.random.split(jax.random.key(1), 20_000)
    )
    # One standard deviation of a correlation of independent samples is 1 / sqrt(20,000) = 0.007.
    assert abs(np.corrcoef(np.asarray(samples).T)[0, 1]) < 0.03


def test_every_proposal_refused_is_drawn_again(monkeypatch):
    """With one proposal each, hundreds of elements need the loop; all must still be Gamma."""
    monkeypatch.setattr(beta, "_NUM_PROPOSALS", 1)
    ones = jnp.ones((20_000, 1), jnp.float32)
    samples = np.asarray(beta.sample(jax.random.key(2), ones, 2.0 * ones), np.float64)
    assert stats.kstest(samples[:, 0], stats.beta(1.0, 2.0).cdf).pvalue > 1e-4


@pytest.mark.parametrize("pair", PAIRS + ROACH_PAIRS, ids=str)
def test_log_prob_is_scipys_also_at_the_ends(pair):
    alpha, beta_ = _arrays(*pair)
    for x in ENDS:
        clipped = float(np.clip(np.float32(x), np.float32(1e-7), np.float32(1.0 - 1e-7)))
        expected = np.sum(stats.beta.logpdf(clipped, np.float64(alpha), np.float64(beta_)))
        actual = beta.log_prob(jnp.full((2,), x, jnp.float32), alpha, beta_)
        assert np.isfinite(actual)
        np.testing.assert_allclose(
            actual, expected, rtol=1e-4, atol=2e-3 if max(pair) > 100 else 2e-5
        )


@pytest.mark.parametrize("pair", PAIRS + ROACH_PAIRS[:2], ids=str)
def test_entropy_is_scipys_summed_over_dimensions(pair):
    alpha, beta_ = _arrays(*pair)
    expected = 2.0 * stats.beta.entropy(*np.float64(np.float32(pair)))
    np.testing.assert_allclose(
        beta.entropy(alpha, beta_), expected, rtol=1e-4, atol=2e-2 if max(pair) > 100 else 1e-4
    )


KL_PAIRS = [
    ((1.0, 1.0), (1.0, 1.0)),
    ((1.0, 3.0), (3.0, 1.0)),
    ((2.5, 1.2), (2.4, 1.3)),
    ((7.0, 7.0), (2.5, 1.0)),
    ((40.0, 2.0), (38.0, 2.5)),
    ((1.3, 0.7), (1.0, 1.5)),
    ((300.0, 500.0), (290.0, 510.0)),
]


@pytest.mark.parametrize(("pair", "other"), KL_PAIRS, ids=str)
def test_kl_is_the_integral_of_p_log_p_over_q(pair, other):
    """SciPy's quadrature of SciPy's densities, in the variable t = logit x, where all is smooth."""
    a, b, c, d = np.float64(np.float32([*pair, *other]))

    def integrand(t):
        x = special.expit(t)
        log_p, log_q = stats.beta.logpdf(x, a, b), stats.beta.logpdf(x, c, d)
        return np.exp(log_p) * (log_p - log_q) * x * (1.0 - x)

    middle = special.logit(a / (a + b))
    expected = sum(
        integrate.quad(integrand, *ends, epsabs=1e-10, limit=200)[0]
        for ends in [(middle - 30.0, middle), (middle, middle + 30.0)]
    )
    actual = beta.kl(*(jnp.float32([x]) for x in (a, b, c, d)))
    assert actual.shape == (1,)
    tolerance = 5e-4 if max(pair) > 100 else 2e-5  # terms of size 500 cancel
    np.testing.assert_allclose(actual, [expected], rtol=1e-4, atol=tolerance)


def test_gradients_of_kl():
    """With respect to p: (a - c) psi'(a) - (a + b - c - d) psi'(a + b); to q: psi differences."""
    a, b, c, d = 2.5, 1.25, 3.0, 2.0
    args = [jnp.float32([x]) for x in (a, b, c, d)]
    grad = jax.grad(lambda *args: beta.kl(*args)[0], argnums=(0, 2))(*args)
    trigamma = special.polygamma(1, [a, a + b])
    expected = (a - c) * trigamma[0] - (a + b - c - d) * trigamma[1]
    np.testing.assert_allclose(grad[0], [expected], rtol=1e-4)
    psi = special.digamma([c, c + d, a, a + b])
    np.testing.assert_allclose(grad[1], [psi[0] - psi[1] - psi[2] + psi[3]], rtol=1e-4)


def test_gradients_of_log_prob_and_entropy():
    """The first is log x - psi(a) + psi(a + b); the second has trigammas."""
    a, b, x = 2.5, 1.25, 0.3
    args = jnp.float32([a]), jnp.float32([b])
    grad = jax.grad(lambda a_, b_: beta.log_prob(jnp.float32([x]), a_, b_))(*args)
    expected = np.log(x) - special.digamma(a) + special.digamma(a + b)
    np.testing.assert_allclose(grad, [expected], rtol=1e-5)
    grad = jax.grad(beta.entropy)(*args)
    expected = (a + b - 2.0) * special.polygamma(1, a + b) - (a - 1.0) * special.polygamma(1, a)
    np.testing.assert_allclose(grad, [expected], rtol=1e-4)


@pytest.mark.parametrize(
    ("pair", "expected"),
    [
        ((3.0, 2.0), 2.0 / 3.0),  # (3 - 1) / (3 + 2 - 2)
        ((2.0, 0.5), 1.0),  # rises towards 1
        ((1.0, 2.0), 0.0),  # falls from 0
        ((0.5, 0.25), 2.0 / 3.0),  # highest at both ends: the mean, 0.5 / 0.75
    ],
    ids=["inside", "at one", "at zero", "two peaks"],
)
def test_mode(pair, expected):
    np.testing.assert_allclose(
        beta.mode(jnp.float32(pair[0]), jnp.float32(pair[1])), expected, rtol=1e-6
    )


def test_mean_and_command():
    np.testing.assert_allclose(beta.mean(jnp.float32(3.0), jnp.float32(1.0)), 0.75)
    np.testing.assert_allclose(beta.to_command(jnp.float32([0.0, 0.75, 1.0])), [-1.0, 0.5, 1.0])
