"""The Beta policy: independent Beta(alpha, beta) per action dimension, on (0, 1).

Source: Chou et al., Improving stochastic policy gradients with the Beta distribution (2017).
Sums over the last axis, the action dimensions (`kl` leaves them apart). The environment's action is
2 x - 1; densities are those of x, without a Jacobian.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.scipy.special import betaln, digamma

EDGE = 1e-7  # source: CaRL's trainer clamps samples to [1e-7, 1 - 1e-7]
_NUM_PROPOSALS = 3  # each is refused in at most 5 % of the cases, so the loop below seldom runs


def sample(key: jax.Array, alpha: jax.Array, beta: jax.Array) -> jax.Array:
    """Draws exact samples, as G(alpha) / (G(alpha) + G(beta)) of two Gamma variables.

    Args:
      key: PRNG key.
      alpha: (..., A) float32, positive.
      beta: (..., A) float32, positive.

    Returns:
      (..., A) float32 in [1e-7, 1 - 1e-7].
    """
    log_gamma = _log_gamma_sample(key, jnp.stack([alpha, beta]))
    return jnp.clip(jax.nn.sigmoid(log_gamma[0] - log_gamma[1]), EDGE, 1.0 - EDGE)


def log_prob(x: jax.Array, alpha: jax.Array, beta: jax.Array) -> jax.Array:
    """Returns log p(x), summed over the action dimensions.

    Args:
      x: (..., A) float32 in [0, 1]; clipped to [1e-7, 1 - 1e-7].
      alpha: (..., A) float32.
      beta: (..., A) float32.

    Returns:
      (...) float32.
    """
    x = jnp.clip(x, EDGE, 1.0 - EDGE)
    terms = (alpha - 1.0) * jnp.log(x) + (beta - 1.0) * jnp.log1p(-x) - betaln(alpha, beta)
    return jnp.sum(terms, axis=-1)


def entropy(alpha: jax.Array, beta: jax.Array) -> jax.Array:
    """Returns the differential entropy, summed over the action dimensions.

    Args:
      alpha: (..., A) float32.
      beta: (..., A) float32.

    Returns:
      (...) float32.
    """
    terms = (
        betaln(alpha, beta)
        - (alpha - 1.0) * digamma(alpha)
        - (beta - 1.0) * digamma(beta)
        + (alpha + beta - 2.0) * digamma(alpha + beta)
    )
    return jnp.sum(terms, axis=-1)


def kl(
    alpha: jax.Array, beta: jax.Array, other_alpha: jax.Array, other_beta: jax.Array
) -> jax.Array:
    """Returns KL(Beta(alpha, beta) || Beta(other_alpha, other_beta)) of each action dimension.

    log B(a', b') - log B(a, b) + (a - a') psi(a) + (b - b') psi(b) + (a' - a + b' - b) psi(a + b).

    Args:
      alpha: (..., A) float32.
      beta: (..., A) float32.
      other_alpha: (..., A) float32.
      other_beta: (..., A) float32.

    Returns:
      (..., A) float32, not summed.
    """
    return (
        betaln(other_alpha, other_beta)
        - betaln(alpha, beta)
        + (alpha - other_alpha) * digamma(alpha)
        + (beta - other_beta) * digamma(beta)
        + (other_alpha - alpha + other_beta - beta) * digamma(alpha + beta)
    )


def mean(alpha: jax.Array, beta: jax.Array) -> jax.Array:
    """Returns (..., A) the mean, CaRL's deterministic action."""
    return alpha / (alpha + beta)


def mode(alpha: jax.Array, beta: jax.Array) -> jax.Array:
    """Returns (..., A) the mode, Roach's deterministic action.

    With one parameter at most 1 the density is highest at an end; with both it has no single mode
    and the mean stands in.
    """
    inside = (alpha - 1.0) / jnp.maximum(alpha + beta - 2.0, 1e-6)
    at_end = jnp.where(alpha > 1.0, jnp.float32(1.0), jnp.float32(0.0))
    one_small = jnp.where((alpha <= 1.0) & (beta <= 1.0), mean(alpha, beta), at_end)
    return jnp.where((alpha > 1.0) & (beta > 1.0), inside, one_small)


def to_command(x: jax.Array) -> jax.Array:
    """Maps a Beta sample to the environment's action in [-1, 1]."""
    return 2.0 * x - 1.0


def _log_gamma_sample(key: jax.Array, shape: jax.Array) -> jax.Array:
    """Draws log G for G ~ Gamma(shape, 1) by rejection.

    `jax.random.gamma` loops over elements and is about 18 times slower than a normal on a CPU; here
    all elements go together. Source: Marsaglia and Tsang, A simple method for generating gamma
    variables (2000); below 1 the boost G(a) = G(a + 1) U^(1/a), in logarithms for tiny a.
    """
    key_boost, key_loop = jax.random.split(key)
    d = jnp.where(shape < 1.0, shape + 1.0, shape) - 1.0 / 3.0

    def refused(carry: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        return ~jnp.all(carry[1])

    def propose(
        carry: tuple[jax.Array, jax.Array, jax.Array],
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        log_v, accepted, key = carry
        key, key_block = jax.random.split(key)
        new_log_v, new_accepted = _propose(key_block, d)
        return jnp.where(accepted, log_v, new_log_v), accepted | new_accepted, key

    start = (jnp.zeros_like(d), jnp.zeros(d.shape, bool), key_loop)
    log_v, _, _ = jax.lax.while_loop(refused, propose, start)
    log_uniform = jnp.log(_uniform(key_boost, shape.shape))
    boost = jnp.where(shape < 1.0, log_uniform / shape, jnp.float32(0.0))
    return jnp.log(d) + log_v + boost


def _propose(key: jax.Array, d: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the first accepted of a few proposals of log v (G = d v), and if there is one."""
    # One draw for the normal and the uniform variable halves the time to compile.
    uniform = _uniform(key, (2, _NUM_PROPOSALS, *d.shape))
    z = jnp.sqrt(2.0) * jax.lax.erf_inv(2.0 * uniform[0] - 1.0)
    root = 1.0 + z / jnp.sqrt(9.0 * d)
    log_v = 3.0 * jnp.log(jnp.maximum(root, 1e-30))
    bound = 0.5 * z * z + d - d * root**3 + d * log_v
    accepted = (root > 0.0) & (jnp.log(uniform[1]) < bound)
    first = jnp.argmax(accepted, axis=0)
    return jnp.take_along_axis(log_v, first[None], axis=0)[0], jnp.any(accepted, axis=0)


def _uniform(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Draws from the middles of 2^23 equal parts of (0, 1): never an end, and symmetric."""
    return jax.random.uniform(key, shape) * (1.0 - 2.0**-23) + 2.0**-24
