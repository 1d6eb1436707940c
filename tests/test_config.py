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


def test_the_papers_preset_has_the_papers_values():
    # CaRL paper, table of PPO hyperparameters, column CaRL (CARLA)
    ppo = presets.PRESETS["carl-carla"].config.ppo
    assert ppo.batch_size == 65536
    assert ppo.minibatch_size == 16384
    assert ppo.num_updates == 4578  # 300e6 / 65536 = 4577.6
    assert ppo.num_minibatches * ppo.update_epochs - 1 == 11  # steps off-policy
    assert (ppo.learning_rate, ppo.clip_coef, ppo.ent_coef, ppo.vf_coef) == (2.5e-4, 0.1, 0.01, 0.5)
    assert (ppo.gamma, ppo.gae_lambda, ppo.max_grad_norm) == (0.99, 0.95, 0.5)


def test_the_atari_preset_has_the_papers_values():
    # CaRL paper, table of PPO hyperparameters, column Atari
    ppo = presets.PRESETS["atari"].config.ppo
    assert (ppo.num_envs, ppo.num_steps, ppo.batch_size, ppo.minibatch_size) == (8, 128, 1024, 256)
    assert ppo.num_minibatches * ppo.update_epochs - 1 == 15  # steps off-policy
    assert (ppo.total_samples, ppo.learning_rate) == (10_000_000, 2.5e-4)


@pytest.mark.parametrize("name", sorted(presets.PRESETS))
def test_presets_are_valid_on_one_device(name):
    presets.PRESETS[name].config.validate(num_devices=1)


def test_without_an_accelerator_the_small_preset_is_the_default():
    assert presets.default_name() == "cpu"
