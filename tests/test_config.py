"""Configurations come back from JSON as they were, and mistakes are named with their place."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Literal

import pytest

from carljax import config, presets
from carljax.config import ConfigError, RunConfig, TrainConfig


@dataclasses.dataclass(frozen=True)
class Inner:
    """One of every kind of field."""

    rate: float = 0.5
    kind: Literal["a", "b"] = "a"
    sizes: tuple[int, int] = (1, 2)
    files: tuple[Path, ...] = ()
    limit: float | None = None
    is_on: bool = True


@dataclasses.dataclass(frozen=True)
class Outer:
    """A part within a whole."""

    inner: Inner = dataclasses.field(default_factory=Inner)
    count: int = 3


@pytest.mark.parametrize("name", sorted(presets.PRESETS))
def test_a_preset_comes_back_from_its_file_as_it_was(tmp_path, name):
    values = dataclasses.replace(
        presets.PRESETS[name].config,
        run=RunConfig(dir=Path("runs/a"), maps=(Path("x.xodr"), Path("y.xodr"))),
    )
    config.save(values, tmp_path / "config.json")
    assert config.load(tmp_path / "config.json") == values


def test_every_kind_of_field_is_read():
    read = config.from_json(
        Outer,
        {
            "inner": {
                "rate": 1,
                "kind": "b",
                "sizes": [3, 4],
                "files": ["x", "y"],
                "limit": 2,
                "is_on": False,
            }
        },
    )
    assert read == Outer(Inner(1.0, "b", (3, 4), (Path("x"), Path("y")), 2.0, False), 3)
    assert type(read.inner.rate) is float
    assert config.from_json(Outer, config.to_json(read)) == read


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"inner": {"rat": 1.0}}, "inner.rat: no such field; near: rate"),
        ({"zzz": 1}, "zzz: no such field; near: inner, count"),
        ({"count": 1.5}, "count: 1.5 is float, not int"),
        ({"count": True}, "count: True is bool, not int"),
        ({"count": None}, "count: None is null, not int"),
        ({"inner": {"rate": "fast"}}, "inner.rate: 'fast' is text, not float"),
        ({"inner": {"kind": "c"}}, "inner.kind: 'c' is none of 'a', 'b'"),
        ({"inner": {"sizes": [1]}}, "inner.sizes: has 1 values, not 2"),
        ({"inner": {"sizes": 1}}, "inner.sizes: 1 is int, not a list"),
        ({"inner": {"files": ["x", 2]}}, "inner.files[1]: 2 is int, not Path"),
        ({"inner": 4}, "inner: 4 is int, not an object"),
        ([], "top: [] is a list, not an object"),
    ],
)
def test_a_mistake_is_named_with_its_field(values, message):
    with pytest.raises(ConfigError) as caught:
        config.from_json(Outer, values)
    assert str(caught.value) == message


def test_a_mistake_in_a_file_is_named_with_the_file(tmp_path):
    path = tmp_path / "config.json"
    path.write_text(json.dumps({"ppo": {"lerning_rate": 1e-4}}))
    with pytest.raises(ConfigError) as caught:
        config.load(path)
    assert str(caught.value).startswith(f"{path}: ppo.lerning_rate: no such field; near: learning_")


def test_a_file_that_is_no_json_is_named_with_the_line(tmp_path):
    path = tmp_path / "config.json"
    path.write_text('{\n"ppo": }\n')
    with pytest.raises(ConfigError, match=r"config\.json:2: not JSON"):
        config.load(path)
    with pytest.raises(ConfigError, match="can't be read"):
        config.load(tmp_path / "missing.json")


def test_sizes_that_do_not_go_together_are_refused_with_both_numbers():
    values = dataclasses.replace(
        TrainConfig(), ppo=dataclasses.replace(TrainConfig().ppo, num_envs=6)
    )
    with pytest.raises(ConfigError, match=r"ppo\.num_envs.* 6.* 4"):
        values.validate(num_devices=4)


@pytest.mark.parametrize("field", ["num_routes", "checkpoint_every", "keep_checkpoints"])
def test_counts_of_nothing_are_refused(field):
    with pytest.raises(ConfigError, match=f"run.{field}: 0 is below"):
        dataclasses.replace(RunConfig(), **{field: 0}).validate()


def test_the_seed_of_the_held_out_routes_is_refused():
    with pytest.raises(ConfigError, match=r"run\.seed: .* held-out"):
        RunConfig(seed=config.HELD_OUT_SEED).validate()


# CaRL paper, table of all PPO hyperparameters: its rows, and its columns in order. "Steps per
# epoch" are minibatches; "off-policy" are all gradient steps but the first.
ROWS = (
    *("samples", "learning rate", "schedule", "environments", "steps", "batch", "minibatch"),
    *("steps per epoch", "epochs", "off-policy", "hints", "norm adv", "clip vloss", "entropy"),
    *("vf", "gamma", "lambda", "clip", "grad norm"),
)
CARL = (0.01, 0.5, 0.99, 0.95, 0.1, 0.5)
M = 1_000_000
TABLE = {
    "roach": (
        *(10 * M, 1e-5, "KL patience", 6, 2048, 12288, 256),
        *(48, 20, 959, True, False, False, 0.01, 0.5, 0.99, 0.9, 0.2, 0.5),
    ),
    "atari": (
        *(10 * M, 2.5e-4, "linear", 8, 128, 1024, 256),
        *(4, 4, 15, False, True, True, *CARL),
    ),
    "carl-carla": (
        *(300 * M, 2.5e-4, "linear", 128, 512, 65536, 16384),
        *(4, 3, 11, False, True, True, *CARL),
    ),
    "carl-nuplan": (
        *(500 * M, 2.5e-4, "linear", 512, 32, 16384, 4096),
        *(4, 4, 15, False, True, True, *CARL),
    ),
    "carl-nuplan-1b": (
        *(1000 * M, 2.5e-4, "linear", 1024, 32, 32768, 8192),
        *(4, 4, 15, False, True, True, *CARL),
    ),
}


def _schedule(ppo):
    if ppo.kl_patience is not None:
        assert not ppo.anneal_lr
        return "KL patience"
    return {"linear": "linear", "late": "Python trainer"}[ppo.lr_schedule] if ppo.anneal_lr else ""


@pytest.mark.parametrize("name", TABLE)
def test_a_column_of_the_paper_has_the_papers_values(name):
    ppo = presets.PRESETS[name].config.ppo
    actual = (
        *(ppo.total_samples, ppo.learning_rate, _schedule(ppo), ppo.num_envs, ppo.num_steps),
        *(ppo.batch_size, ppo.minibatch_size, ppo.num_minibatches, ppo.update_epochs),
        *(ppo.num_minibatches * ppo.update_epochs - 1, ppo.hint_coef > 0, ppo.norm_adv),
        *(ppo.clip_vloss is not None, ppo.ent_coef, ppo.vf_coef, ppo.gamma, ppo.gae_lambda),
        *(ppo.clip_coef, ppo.max_grad_norm),
    )
    assert dict(zip(ROWS, actual, strict=True)) == dict(zip(ROWS, TABLE[name], strict=True))


def test_every_preset_but_ours_is_a_column_of_the_paper():
    assert set(presets.PRESETS) == {*TABLE, "cpu"}


# What the paper's table leaves open, from the authors' and Roach's code: value clip, Adam's
# epsilon, KL patience and target, weight of the hints, half of the squared error, entropy over the
# actions, scope of the normalisation, value of a truncated end.
OPEN = dict.fromkeys(TABLE, (0.1, 1e-5, None, 0.015, 0.0, True, "sum", "all", True))
OPEN["roach"] = (None, 1e-5, 8, 0.015, 0.05, False, "mean", "all", True)


@pytest.mark.parametrize("name", TABLE)
def test_what_the_table_leaves_open_is_as_in_the_code(name):
    ppo = presets.PRESETS[name].config.ppo
    names = ("clip_vloss", "adam_eps", "kl_patience", "target_kl", "hint_coef", "vloss_half")
    names += ("entropy_reduction", "norm_adv_scope", "bootstrap_truncated")
    assert tuple(getattr(ppo, field) for field in names) == OPEN[name]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        # encoder, LayerNorm, initialisation, least alpha and beta, action when scored
        ("carl-carla", ("carl", True, "xavier", 1.0, "mean")),
        ("atari", ("carl", True, "xavier", 1.0, "mean")),
        ("carl-nuplan", ("carl", True, "torch", 1.0, "mean")),
        ("carl-nuplan-1b", ("carl", True, "torch", 1.0, "mean")),
        ("roach", ("roach", False, "xavier", 0.0, "mode")),
    ],
)
def test_the_network_of_a_preset(name, expected):
    values = presets.PRESETS[name].config
    network = values.network
    assert expected == (
        *(network.encoder, network.layer_norm, network.conv_init, network.beta_min),
        values.run.eval_action,
    )
    assert (network.hidden_size, network.joint_size) == (256, 512)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("carl-carla", (256, 256, 2.0, 100)),  # 78 m ahead, 50 m behind
        ("carl-nuplan", (256, 256, 2.0, 100)),
        ("roach", (192, 192, 5.0, 40)),  # 30.4 m ahead, 8 m behind
    ],
)
def test_the_image_of_a_preset(name, expected):
    raster = presets.PRESETS[name].config.env.raster
    actual = raster.height, raster.width, raster.pixels_per_metre, raster.ego_from_bottom_px
    assert actual == expected


def test_updates_of_the_papers_runs():
    """Whole ones, rounded up.

    10 M / 12,288 = 813.8, 10 M / 1,024 = 9765.6, 300 M / 65,536 = 4577.6, 500 M / 16,384 = 30517.6,
    1 B / 32,768 likewise.
    """
    updates = [presets.PRESETS[name].config.ppo.num_updates for name in TABLE]
    assert updates == [814, 9766, 4578, 30518, 30518]


@pytest.mark.parametrize("name", sorted(presets.PRESETS))
def test_presets_are_valid_on_one_device(name):
    presets.PRESETS[name].config.validate(num_devices=1)


@pytest.mark.parametrize("num_devices", [2, 4, 8])
@pytest.mark.parametrize("name", ["atari", "carl-carla", "carl-nuplan", "carl-nuplan-1b"])
def test_the_papers_presets_are_valid_on_several_devices(name, num_devices):
    presets.PRESETS[name].config.validate(num_devices)


def test_without_an_accelerator_the_small_preset_is_the_default():
    assert presets.default_name() == "cpu"
