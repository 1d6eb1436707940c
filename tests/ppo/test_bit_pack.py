"""Packed images: nothing is lost, and the bytes are as few as the values need."""

from __future__ import annotations

import numpy as np
import pytest

from carljax.ppo import bit_pack
from carljax.sim.observation import KINDS

MASK = (255,)
CASES = {
    "one mask": (MASK,),
    "eight masks": (MASK,) * 8,
    "nine masks": (MASK,) * 9,
    "three values need two bits": (MASK, (7, 8, 255), MASK, (1, 2), (3, 4, 5)),
    "any byte between masks": (MASK, None, MASK, None),
    "only bytes": (None, None),
    "two hundred values": ((*range(1, 201),), MASK),
}
BYTES = dict(zip(CASES, (1, 1, 2, 1, 3, 2, 2), strict=True))
CASES |= {
    kind: tuple(one.levels.get(channel) for channel in one.channels) for kind, one in KINDS.items()
}
BYTES |= {"carla": 5, "roach": 3, "nuplan": 5}


@pytest.mark.parametrize("name", CASES)
def test_round_trip(name):
    levels = CASES[name]
    rng = np.random.default_rng(0)
    values = [np.arange(256) if one is None else np.array([0, *one]) for one in levels]
    image = np.stack([rng.choice(one, (9, 7, 40)) for one in values], axis=-1).astype(np.uint8)
    packed = bit_pack.pack(image, levels)
    assert packed.shape == (9, 7, 40, BYTES[name]) and packed.dtype == np.uint8
    assert bit_pack.num_bytes(levels) == BYTES[name]
    unpacked = bit_pack.unpack(packed, levels)
    assert unpacked.dtype == np.uint8
    np.testing.assert_array_equal(unpacked, image)


def test_eight_masks_are_the_bits_of_a_byte():
    image = np.random.default_rng(1).choice([0, 255], (5, 6, 8)).astype(np.uint8)
    packed = bit_pack.pack(image, (MASK,) * 8)
    np.testing.assert_array_equal(packed, np.packbits(image > 0, axis=-1, bitorder="little"))
