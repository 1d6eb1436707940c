"""Images of few values in few bits: most channels of a bird's-eye view are masks.

A channel whose values are known gets as many bits as tell them apart, side by side with others in a
byte; any other channel keeps its byte. Nothing is lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

# The values other than 0 that a channel takes; None where it may take any.
Levels = tuple[int, ...] | None


class _Place(NamedTuple):
    """Where a channel lies in a packed pixel."""

    byte: int
    shift: int
    levels: Levels


def num_bytes(levels: Sequence[Levels]) -> int:
    """Returns K, the bytes of a packed pixel."""
    return 1 + max(place.byte for place in _places(levels))


def pack(image: jax.Array, levels: Sequence[Levels]) -> jax.Array:
    """Packs an image.

    Args:
      image: (..., C) uint8, of no other values than 0 and the levels.
      levels: of each channel.

    Returns:
      (..., K) uint8.
    """
    packed = [jnp.zeros(image.shape[:-1], jnp.uint8)] * num_bytes(levels)
    for channel, (byte, shift, values) in enumerate(_places(levels)):
        code = image[..., channel]
        if values is not None:
            matches = [(code == value) * jnp.uint8(n) for n, value in enumerate(values, start=1)]
            code = sum(matches, jnp.zeros_like(code))
        packed[byte] = packed[byte] | code << shift
    return jnp.stack(packed, axis=-1)


def unpack(packed: jax.Array, levels: Sequence[Levels]) -> jax.Array:
    """Returns the (..., C) uint8 image that `pack` has made (..., K) bytes of."""
    channels = []
    for byte, shift, values in _places(levels):
        value = packed[..., byte]
        if values is not None:
            code = value >> shift & (1 << _num_bits(values)) - 1
            matches = [(code == n) * jnp.uint8(v) for n, v in enumerate(values, start=1)]
            value = sum(matches, jnp.zeros_like(code))
        channels.append(value)
    return jnp.stack(channels, axis=-1)


def _num_bits(values: tuple[int, ...]) -> int:
    return len(values).bit_length()


def _places(levels: Sequence[Levels]) -> list[_Place]:
    """Gives each channel the next byte of its own, or the next free bits of a shared one."""
    places = []
    shared, used, num = -1, 8, 0  # the byte that is being filled, its bits in use, bytes so far
    for values in levels:
        if values is None:
            places.append(_Place(num, 0, None))
            num += 1
            continue
        if used + _num_bits(values) > 8:
            shared, used, num = num, 0, num + 1
        places.append(_Place(shared, used, values))
        used += _num_bits(values)
    return places
