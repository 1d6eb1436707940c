"""Work on a few samples at a time, so that what lies between stays in a CPU core's cache."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

CACHE_BYTES = 1 << 20  # what a core's cache has room for


def size_of(num: int, bytes_each: int) -> int:
    """Chooses how many samples are worked on at once.

    Args:
      num: of all samples.
      bytes_each: of a sample's largest array.

    Returns:
      The largest power of two that divides `num` and whose samples have at most `CACHE_BYTES`, or
      1.
    """
    most = max(1, CACHE_BYTES // bytes_each)
    return math.gcd(num, 1 << most.bit_length() - 1)


def map_over(function: Callable[..., Any], size: int, *batch: jax.Array) -> Any:
    """Maps samples to as many.

    Args:
      function: from (size, ...) arrays to a pytree of such.
      size: a divisor of N.
      *batch: (N, ...) arrays.

    Returns:
      What function(*batch) does, made of pieces.
    """
    made = jax.lax.map(lambda i: function(*_piece(i, size, batch)), _indices(size, batch))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), made)


def sum_over(function: Callable[..., Any], size: int, *batch: jax.Array) -> Any:
    """Adds up over the pieces.

    Args:
      function: from (size, ...) arrays to a pytree of arrays.
      size: a divisor of N.
      *batch: (N, ...) arrays.

    Returns:
      The sum of function(*piece).
    """

    def add(total: Any, i: jax.Array) -> tuple[Any, None]:
        return jax.tree.map(jnp.add, total, function(*_piece(i, size, batch))), None

    like = jax.eval_shape(lambda: function(*_piece(0, size, batch)))
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
    return jax.lax.scan(add, zeros, _indices(size, batch))[0]


def _indices(size: int, batch: tuple[jax.Array, ...]) -> jax.Array:
    return jnp.arange(batch[0].shape[0] // size)


def _piece(i: int | jax.Array, size: int, batch: tuple[jax.Array, ...]) -> list[jax.Array]:
    # A slice, since XLA:CPU copies an array of (N, 1, ...) pieces before its loop.
    return [jax.lax.dynamic_slice_in_dim(x, i * size, size) for x in batch]
