"""Parameters for tests without compiling a random number generator for each of them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np


def params(network, obs, seed=0):
    """Fills a network's parameters with normal numbers of deviation 1 / sqrt(inputs)."""
    rng = np.random.default_rng(seed)

    def fill(x):
        fan_in = max(int(np.prod(x.shape[:-1])), 16)
        return jnp.asarray(rng.normal(size=x.shape) / np.sqrt(fan_in), jnp.float32)

    return jax.tree.map(fill, jax.eval_shape(network.init, jax.random.key(0), obs))
