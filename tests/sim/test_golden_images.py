"""A full scene of each kind of image is what somebody has looked at and found right."""

from __future__ import annotations

import golden_scenes
import numpy as np
import pytest


@pytest.mark.parametrize("kind", list(golden_scenes.COLUMNS))
def test_the_scene_is_the_approved_picture(kind, bundled):
    """All but a pixel in a thousand, and in each channel all but one in twenty of those drawn."""
    image = {
        "carla": golden_scenes.carla,
        "roach": golden_scenes.roach,
        "nuplan": lambda: golden_scenes.nuplan(bundled),
    }[kind]()
    height, width, channels = image.shape
    expected = golden_scenes.golden(kind)
    drawn = golden_scenes.sheet(image, golden_scenes.COLUMNS[kind])
    assert drawn.shape == expected.shape
    assert (drawn == expected).mean() > 0.999
    columns = golden_scenes.COLUMNS[kind]
    for channel in range(channels):
        row, column = divmod(channel, columns)
        tile = np.s_[row * height : (row + 1) * height, column * width : (column + 1) * width]
        assert expected[tile].any(), f"channel {channel} shows nothing"
        off = np.count_nonzero(drawn[tile] != expected[tile])
        assert off <= 0.05 * np.count_nonzero(expected[tile]), f"channel {channel}"
