"""The benchmarks against OpenCV and PyTorch: both sides do the same. Nothing is timed here."""

from __future__ import annotations

import importlib
import sys

import bev_carljax
import bev_opencv
import bev_scene
import jax
import jax.numpy as jnp
import learner_torch
import numpy as np
import pytest

from carljax.sim.types import KIND_PEDESTRIAN, KIND_STATIC, KIND_VEHICLE


@pytest.mark.parametrize(("module", "package"), [("bev_opencv", "cv2"), ("learner_torch", "torch")])
def test_what_is_not_installed_is_named(monkeypatch, capsys, module, package):
    script = importlib.import_module(module)
    find_spec = script.importlib.util.find_spec
    monkeypatch.setattr(
        script.importlib.util,
        "find_spec",
        lambda name: None if name == package else find_spec(name),
    )
    monkeypatch.setattr(sys, "argv", [module])
    assert script.main() == 2
    assert "pip install -e '.[bench]'" in capsys.readouterr().err


def test_at_least_one_scene_is_asked_for(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["bev_opencv", "--scenes", "0"])
    assert bev_opencv.main() == 2
    assert capsys.readouterr().err == "error: --scenes 0: is below the least, 1\n"


def test_devices_have_to_divide_the_scenes(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["bev_opencv", "--devices", "3"])
    assert bev_opencv.main() == 2
    assert capsys.readouterr().err == "error: --devices 3: 8 scenes don't divide so\n"


def test_devices_share_the_scenes():
    scenes = bev_carljax.stack([bev_scene.make(seed) for seed in range(2)])
    given = bev_carljax.road_map(bev_scene.roads()), scenes, jnp.float32(0.01)
    images = [
        np.asarray(jax.jit(frames)(*placed))
        for frames, placed in (bev_carljax.shared(1, jax.devices()[:num], *given) for num in (1, 2))
    ]
    np.testing.assert_array_equal(*images)
    assert images[0].any()


def test_the_sizes_of_a_learner_have_to_divide(monkeypatch, capsys):
    monkeypatch.setattr(learner_torch.importlib.util, "find_spec", lambda name: name)
    monkeypatch.setattr(sys, "argv", ["learner_torch", "--samples", "1000"])
    assert learner_torch.main() == 2
    assert "a batch of 1000 does not divide into parts of 1024" in capsys.readouterr().err


def test_the_scene_has_what_it_says():
    scene = bev_scene.make(0)
    kinds = np.asarray(bev_carljax.stack([scene]).agents.kind[0])
    assert [int((kinds == k).sum()) for k in (KIND_VEHICLE, KIND_PEDESTRIAN, KIND_STATIC)] == [
        60,
        50,
        10,
    ]
    assert 3 * len(bev_scene.roads()) == 30
    near = np.abs(scene.users.xy - scene.ego_xy).max(axis=1)
    assert near.max() < 64.0
    again = bev_scene.make(0)
    np.testing.assert_array_equal(scene.users.xy, again.users.xy)


def test_equality_counts_pixels_by_all_their_channels():
    images = np.zeros((1, 2, 2, 10), np.uint8)
    images[0, 0, 0, 3] = 200
    planes = np.zeros((10, 2, 2), np.uint8)
    assert bev_opencv.equality(images, [planes])["equal_pixels"] == 0.75
    planes[3, 0, 0] = 200
    planes[4, 1, 1] = 1
    found = bev_opencv.equality(images, [planes])
    assert found["equal_pixels"] == 0.75
    assert found["equal_where_drawn"] == {"vehicles": 1.0, "pedestrians": 0.0}


@pytest.mark.slow
def test_opencv_draws_what_we_draw():
    pytest.importorskip("cv2", reason="OpenCV is an extra: pip install -e '.[bench]'")
    import bev_cv2

    roads, scenes = bev_scene.roads(), [bev_scene.make(7), bev_scene.make(8)]
    turn = jnp.float32(0.01)
    given = bev_carljax.road_map(roads), bev_carljax.stack(scenes), turn
    images = np.asarray(jax.jit(bev_carljax.frames, static_argnums=3)(*given, 2))
    renderer = bev_cv2.Renderer(roads)
    planes = [renderer.draw(scene, 0.02).copy() for scene in scenes]
    found = bev_opencv.equality(images, planes)
    assert found["equal_pixels"] >= bev_opencv.LEAST_EQUAL
    assert len(found["equal_where_drawn"]) == 10
    assert min(found["equal_where_drawn"].values()) > 0.8


@pytest.mark.slow
def test_pytorchs_learner_does_what_ours_does():
    pytest.importorskip("torch", reason="PyTorch is an extra: pip install -e '.[bench]'")
    import torch_agreement
    from learner_cases import CASES

    found = torch_agreement.agree(CASES["cpu"])
    assert found["agrees"], found
    assert found["gradients_differ"] > 0.0  # they are computed apart
