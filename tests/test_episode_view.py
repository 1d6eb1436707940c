"""The policy's image in pictures of episodes."""

from __future__ import annotations

import types

import numpy as np
import pytest

from carljax.render import episode_view
from carljax.sim.raster_canvas import CHANNELS, RasterConfig
from carljax.sim.scenarios import registry


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


def test_scenarios_are_named_and_those_that_play_are_marked():
    kinds = np.array([registry.KINDS.index(name) for name in ("ControlLoss", "HardBreakRoute")])
    world = types.SimpleNamespace(scenario_kind=kinds)
    slots = types.SimpleNamespace(
        index=np.array([1, -1, 0]), is_playing=np.array([False, False, True])
    )
    names = episode_view.scenario_names(world, slots)
    assert names == ["HardBreakRoute", "> ControlLoss <"]
