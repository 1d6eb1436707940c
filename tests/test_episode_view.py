"""The policy's image in pictures of episodes."""

from __future__ import annotations

import numpy as np
import pytest

from carljax.render import episode_view
from carljax.sim.raster_canvas import CHANNELS, RasterConfig


@pytest.mark.parametrize(
    ("height", "width", "shown"),
    [
        (64, 40, (200, 320)),  # 320 / 64 = 5 times as large
        (64, 64, (320, 320)),
        (640, 320, (160, 320)),  # halved
    ],
)
def test_the_policys_image_fills_the_panel_without_distortion(height, width, shown):
    config = RasterConfig(height=height, width=width, ego_from_bottom_px=height // 4)
    raster = np.zeros((height, width, len(CHANNELS)), np.uint8)
    assert episode_view.policy_view(raster, config).size == shown
