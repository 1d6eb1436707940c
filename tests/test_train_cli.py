"""The training command: a whole run, an interrupted and continued one, and mistakes in one line."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from helpers import once

from carljax import build, checkpoint, config, machine, metrics_log, run_dir, train
from carljax.ppo import trainer
from carljax.reward.config import RewardConfig
from carljax.sim import towns
from carljax.sim.env import metric_names

DOCS = Path(__file__).resolve().parents[1] / "docs"
NUM_UPDATES = 4
TINY = [
    *("--map", str(towns.path("village"))),
    *("--run.num-devices", "1", "--run.num-routes", "4", "--run.eval-routes", "0"),
    *("--reward.blocked-s", "5", "--env.route-length", "300"),
    *("--env.num-agents", "4", "--env.raster.height", "16", "--env.raster.width", "16"),
    *("--env.raster.ego-from-bottom-px", "4", "--network.hidden-size", "16"),
    *("--network.joint-size", "16", "--ppo.num-envs", "4", "--ppo.num-steps", "4"),
    *("--ppo.gamma", "0.99", "--ppo.num-minibatches", "2", "--ppo.micro-batch-size", "None"),
    *("--ppo.total-samples", str(NUM_UPDATES * 16), "--run.checkpoint-every", "1"),
]


class InterruptedStep:
    """A train step; the user presses Ctrl-C during its n-th call."""

    def __init__(self, step, interrupt_at=None):
        self.step, self.interrupt_at, self.calls = step, interrupt_at, 0

    def __call__(self, env, state):  # noqa: D102
        self.calls += 1
        if self.calls == self.interrupt_at:
            os.kill(os.getpid(), signal.SIGINT)
        return self.step(env, state)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A straight run of four updates, and one interrupted in the second and then continued."""
    folder = tmp_path_factory.mktemp("runs")
    made, make = [], trainer.make_train_step
    interrupts = iter([None, 2, None])

    def spied(*args):
        made.append(InterruptedStep(make(*args), next(interrupts)))
        return made[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainer, "make_train_step", spied)
        patch.setattr(build, "environment", once(build.environment))
        patch.chdir(folder)
        assert train.main([*TINY, "--run.dir", "straight"]) == 0
        assert train.main([*TINY, "--run.dir", "continued"]) == 0
        assert checkpoint.updates(folder / "continued") == [1, 2]
        # What is left is done with images that are drawn again, not stored.
        resumed = ["--resume", "continued", "--run.obs-storage", "rerender"]
        assert train.main([*resumed, "--run.eval-routes", "2"]) == 0
    assert [step.calls for step in made] == [4, 2, 2]
    return folder, made


def test_the_train_step_is_traced_once(runs):
    assert [step.step._cache_size() for step in runs[1]] == [1, 1, 1]


def test_four_updates_are_two_and_two_after_a_restart_bit_for_bit(runs):
    made = build.setup(run_dir.load_config(runs[0] / "straight"))
    like = build.initial_state(made)

    def leaves(name, update):
        state = checkpoint.restore(runs[0] / name, like, update)
        state = state.replace(
            key=jax.random.key_data(state.key),
            env_state=state.env_state.replace(
                pipeline_state=state.env_state.pipeline_state.replace(
                    key=jax.random.key_data(state.env_state.pipeline_state.key)
                )
            ),
        )
        return jax.tree_util.tree_leaves_with_path(jax.device_get(state))

    straight, continued = leaves("straight", NUM_UPDATES), leaves("continued", NUM_UPDATES)
    for (path, left), (_, right) in zip(straight, continued, strict=True):
        np.testing.assert_array_equal(left, right, err_msg=jax.tree_util.keystr(path))
    before = dict(leaves("straight", NUM_UPDATES - 1))
    assert any(np.any(before[path] != leaf) for path, leaf in straight)


def test_the_logs_of_both_runs_agree_but_for_time(runs):
    straight, continued = (metrics_log.read(runs[0] / name) for name in ("straight", "continued"))
    assert [line["update"] for line in continued] == [1, 2, 3, 4]
    assert [line["env_steps"] for line in continued] == [16, 32, 48, 64]
    for left, right in zip(straight, continued, strict=True):
        for name in left:
            assert name.startswith("time/") or left[name] == right[name], name


def test_every_logged_number_is_explained(runs):
    text = (DOCS / "metrics.md").read_text()
    causes = set(re.findall(r"`episode/(\w+)_frac`", text))
    logged = {name for line in metrics_log.read(runs[0] / "straight") for name in line}
    assert set(metric_names(RewardConfig())) <= logged
    for name in logged:
        explained = f"`{name}`" in text or name.removeprefix("reward/") in causes
        assert explained, name


def test_the_run_directory_holds_what_it_should(runs):
    folder = runs[0] / "continued"
    names = {entry.name for entry in folder.iterdir()}
    assert names == {
        *("config.json", "machine.json", "metrics.jsonl", "tensorboard", "checkpoints"),
        "evaluation.json",
    }
    starts = run_dir.read_starts(folder)
    assert len(starts) == 2  # begun and continued
    assert starts[0]["packages"]["jax"] == jax.__version__
    assert starts[0]["maps"] == run_dir.map_digests(run_dir.load_config(folder))
    scores = json.loads((folder / "evaluation.json").read_text())["carljax"]
    assert len(scores["routes"]) == 2
    assert {route["town"] for route in scores["routes"]} == {"village"}


def test_the_saved_configuration_is_the_one_that_ran(runs):
    saved = run_dir.load_config(runs[0] / "straight")
    assert saved.ppo.num_envs == 4
    assert saved.env.raster.height == 16
    assert saved.run.maps == (towns.path("village").resolve(),)
    saved.validate(num_devices=1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--run.dir", "straight"], "straight: holds a run already; continue it with --resume"),
        (["--resume", "nowhere"], "nowhere: holds no run"),
        (["cpu", "--resume", "straight"], "takes no preset"),
        (["--resume", "straight", "--ppo.gamma", "0.9"], "ppo.gamma: is 0.99 in the run"),
        (["--resume", "straight", "--run.seed", "5"], "run.seed: is 0 in the run"),
        (["--ppo.num-envs", "3", "--run.num-devices", "2"], "ppo.num_envs is 3"),
        (["--run.num-devices", "9"], "run.num_devices: 9 devices were asked for, but there are 8"),
        (["--run.keep-checkpoints", "0"], "run.keep_checkpoints: 0 is below"),
        (["--map", "missing.xodr"], "missing.xodr"),
    ],
)
def test_a_mistake_ends_with_one_line_and_status_2(runs, arguments, message, capsys, monkeypatch):
    monkeypatch.chdir(runs[0])
    before = sorted(runs[0].iterdir())
    assert train.main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1
    assert message in error
    assert sorted(runs[0].iterdir()) == before


@pytest.mark.parametrize("arguments", [["cpuu"], ["--ppo.lerning-rate", "1"], ["cpu", "--nope"]])
def test_unknown_words_are_refused_with_status_2(arguments):
    with pytest.raises(SystemExit) as caught:
        train.main(arguments)
    assert caught.value.code == 2


def test_a_run_without_a_checkpoint_begins_anew(tmp_path, monkeypatch):
    monkeypatch.setattr(build, "environment", once(build.environment))
    begun = []

    def begins(made, state, path, console):
        begun.append(int(state.update))
        return state

    monkeypatch.setattr(train.learn, "learn", begins)
    folder = str(tmp_path / "run")
    assert train.main([*TINY, "--run.dir", folder]) == 0
    assert train.main(["--resume", folder]) == 0
    assert begun == [0, 0]


@pytest.mark.skipif(machine.num_cores() < 2, reason="needs two cores")
def test_cores_of_a_cpu_are_devices_where_asked_for(tmp_path):
    unforced = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"} | {"JAX_PLATFORMS": "cpu"}
    for num, status, said in ((2, 0, "2 x cpu"), (1000, 2, "1000 devices were asked for")):
        made = subprocess.run(
            [
                sys.executable,
                "-m",
                "carljax.train",
                *TINY,
                "--dry-run",
                "--run.num-devices",
                f"{num}",
            ],
            env=unforced,
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert made.returncode == status, made.stderr
        assert said in made.stdout + made.stderr


def test_a_map_that_changed_is_not_continued_with(tmp_path):
    town = tmp_path / "town.xodr"
    town.write_text("before")
    values = train.parse(["--map", str(town)]).config
    run_dir.create(tmp_path / "run", values)
    town.write_text("after")
    with pytest.raises(config.ConfigError, match="has changed since the run"):
        run_dir.reopen(tmp_path / "run", values)


def test_a_dry_run_prints_size_and_memory_and_writes_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert train.main([*TINY, "--dry-run"]) == 0
    out = capsys.readouterr().out
    expected = ("parameters", "batch of 16 samples (store)", "activations", "towns       village")
    for word in (*expected, "4 of 16 samples"):
        assert word in out
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["roach", "nuplan"])
def test_other_observations_train_save_and_go_on(kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(build, "environment", once(build.environment))
    tiny = [*TINY, "--env.observation", kind, "--run.dir", "run", "--ppo.total-samples"]
    assert train.main([*tiny, "16"]) == 0
    again = ["--resume", "run", "--ppo.total-samples", "32", "--run.eval-routes", "1"]
    assert train.main(again) == 0
    lines = metrics_log.read(tmp_path / "run")
    assert [line["update"] for line in lines] == [1, 2]
    assert all(np.isfinite(line["rollout/value"]) for line in lines)
    assert (tmp_path / "run" / "evaluation.json").exists()


def test_a_preset_can_be_named_and_changed():
    values = train.parse(["atari", "--ppo.learning-rate", "1e-3", "--run.seed", "7"]).config
    assert (values.ppo.num_envs, values.ppo.learning_rate, values.run.seed) == (8, 1e-3, 7)
