"""JAX's own random numbers, written out so that a compiler can fuse them.

On a CPU, JAX lowers its generator to a loop of a few operations over a few numbers. A step of the
simulator draws in forty places, for which starting these operations, some thousand of them, takes
longer than what they compute: a tenth of a step. Keys from here draw the same numbers, bit for bit,
as part of what uses them.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.random import define_prng_impl

# source: Salmon et al., Parallel Random Numbers: As Easy as 1, 2, 3 (2011): Threefry-2x32-20
_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = np.uint32(0x1BD11BDA)
_ROUNDS = 5  # of four rotations each
_JAX_IMPL = "threefry2x32"


def written_out(key: jax.Array) -> jax.Array:
    """The same key or keys, whose draws are written out.

    Args:
      key: of any shape; one of another generator than JAX's default stays as it is.
    """
    if str(jax.random.key_impl(key)) != _JAX_IMPL:
        return key
    return jax.random.wrap_key_data(jax.random.key_data(key), impl=_WRITTEN_OUT)


def like(key: jax.Array, other: jax.Array) -> jax.Array:
    """The same key or keys, as a key of the kind of another."""
    return jax.random.wrap_key_data(jax.random.key_data(key), impl=jax.random.key_impl(other))


def _hash(key: jax.Array, high: jax.Array, low: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Encrypts pairs of words with a (2,) key."""
    schedule = (key[0], key[1], key[0] ^ key[1] ^ _PARITY)
    high, low = high + schedule[0], low + schedule[1]
    for i in range(_ROUNDS):
        for places in _ROTATIONS[i % 2]:
            high = high + low
            low = high ^ ((low << np.uint32(places)) | (low >> np.uint32(32 - places)))
        high = high + schedule[(i + 1) % 3]
        low = low + schedule[(i + 2) % 3] + np.uint32(i + 1)
    return high, low


def _numbered(key: jax.Array, shape: tuple[int, ...]) -> tuple[jax.Array, jax.Array]:
    """Encrypts 0, 1, 2 and so on."""
    count = jax.lax.iota(np.uint32, math.prod(shape)).reshape(shape)
    return _hash(key, jnp.zeros(shape, np.uint32), count)


def _seed(seed: jax.Array) -> jax.Array:
    return jax.random.key_data(jax.random.key(seed, impl=_JAX_IMPL))


def _split(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    return jnp.stack(_numbered(key, shape), axis=-1)


def _fold_in(key: jax.Array, data: jax.Array | int) -> jax.Array:
    return jnp.stack(_hash(key, jnp.uint32(0), jnp.asarray(data, np.uint32)))


def _random_bits(key: jax.Array, bit_width: int, shape: tuple[int, ...]) -> jax.Array:
    high, low = _numbered(key, shape)
    if bit_width == 64:
        return (high.astype(np.uint64) << np.uint64(32)) | low.astype(np.uint64)
    return (high ^ low).astype(f"uint{bit_width}")


_WRITTEN_OUT = define_prng_impl(
    key_shape=(2,),
    seed=_seed,
    split=_split,
    random_bits=_random_bits,
    fold_in=_fold_in,
    name="threefry2x32_written_out",
    tag="3fw",
)
