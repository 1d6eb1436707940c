"""The experiments command: a whole table, one that is cut off and goes on, and mistakes."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import signal
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import once
from rich.console import Console

from carljax import (
    ablations,
    build,
    checkpoint,
    courses,
    experiment_report,
    experiments,
    learn,
    metrics_log,
    presets,
    seeds,
    time_budget,
    timing,
)
from carljax.config import RunConfig
from carljax.ppo import trainer
from carljax.ppo.config import NetworkConfig, PPOConfig
from carljax.sim import towns
from carljax.sim.env import EnvConfig
from carljax.sim.raster_canvas import RasterConfig

NUM_UPDATES = 2
SPEED = "time/env_steps_per_s"
TINY = dataclasses.replace(
    presets.CPU,
    env=EnvConfig(
        num_agents=4,
        num_pedestrians=1,
        num_scenario_slots=1,
        route_length=300.0,
        raster=RasterConfig(16, 16, pixels_per_metre=0.5, ego_from_bottom_px=4),
    ),
    network=NetworkConfig(encoder="patch", hidden_size=16, joint_size=16),
    ppo=PPOConfig(num_envs=4, num_steps=4, num_minibatches=2),
    run=RunConfig(num_devices=1, num_routes=4, maps=(towns.path("village"),), checkpoint_every=1),
)
ARGS = ["epochs", "--seeds", "2", "--samples", str(NUM_UPDATES * 16), "--preset", "tiny"]


class Interrupted:
    """A train step; the user presses Ctrl-C during the n-th call of all."""

    def __init__(self, step, calls, interrupt_at):
        self.step, self.calls, self.interrupt_at = step, calls, interrupt_at

    def __call__(self, env, state):  # noqa: D102
        self.calls.append(state.update.shape[0])
        if len(self.calls) == self.interrupt_at:
            os.kill(os.getpid(), signal.SIGINT)
        return self.step(env, state)


@pytest.fixture(scope="module")
def experiment(tmp_path_factory):
    """A table in one go, and one whose second cell is cut off after its first update."""
    folder = tmp_path_factory.mktemp("experiments")
    make, calls, scored = trainer.make_seeds_step, [], []
    interrupt_at = 4 + 3  # four updates of the first experiment; 2 + 1 of the other

    def spied(*args):
        return Interrupted(make(*args), calls, interrupt_at)

    def two_routes(config):
        scored.append(config)
        return courses.held_out(config, build.load_towns(config.run.maps), 2)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainer, "make_seeds_step", spied)
        patch.setattr(build, "environment", once(build.environment))
        patch.setattr(courses, "carljax_36", two_routes)
        patch.setitem(presets.PRESETS, "tiny", presets.Preset("small", TINY))
        patch.setenv("COLUMNS", "200")
        # As if every update took a second.
        patch.setattr(learn, "speed", lambda _, samples, __: {SPEED: float(samples)})
        straight, cut = folder / "straight", folder / "cut"
        assert experiments.main([*ARGS, "--dir", str(straight)]) == 0
        assert len(calls) == 4
        assert experiments.main([*ARGS, "--dir", str(cut)]) == 0
        assert len(calls) == 7 and not (cut / "table.md").exists()
        kept = {path: path.stat().st_mtime_ns for path in (cut / "4-epochs").rglob("*")}
        num_scored = len(scored)
        assert experiments.main([*ARGS, "--dir", str(cut)]) == 0
        assert len(calls) == 8 and len(scored) == num_scored + 1
        assert {path: path.stat().st_mtime_ns for path in (cut / "4-epochs").rglob("*")} == kept
        assert set(calls) == {2}  # seeds side by side
        assert experiments.main([*ARGS, "--dir", str(cut)]) == 0
        assert len(calls) == 8
        yield straight, cut


def test_the_table_has_a_row_for_each_cell(experiment):
    text = (experiment[0] / "table.md").read_text()
    rows = [line.split("|") for line in text.splitlines() if line.startswith("| ")]
    assert [row[1].strip() for row in rows[2:]] == ["4 epochs", "3 epochs"]
    numbers = json.loads((experiment[0] / "results.json").read_text())["rows"]
    for row, shown in zip(numbers, rows[2:], strict=True):
        assert row["num_samples"] == NUM_UPDATES * 16 and shown[3].strip() == "32"
        each = [run["RC"] for run in row["each"]]
        assert len(each) == 2
        assert row["RC"]["mean"] == pytest.approx(np.mean(each))
        assert row["RC"]["std"] == pytest.approx(np.std(each, ddof=1))
        assert shown[5].strip() == f"{np.mean(each):.1f} ± {np.std(each, ddof=1):.1f}"


def test_a_run_logs_its_own_samples_and_not_those_of_all(experiment):
    for seed in (0, 1):
        lines = metrics_log.read(experiment[0] / "3-epochs" / f"seed-{seed}")
        assert [line["env_steps"] for line in lines] == [16, 32]
        assert [line[SPEED] for line in lines] == [16.0, 16.0]


@pytest.mark.parametrize(("num_seeds", "shown"), [(2, "31.2 ± 4.0"), (1, "31.2 ")])
def test_a_terminal_of_80_columns_shows_cells_and_scores(monkeypatch, num_seeds, shown):
    """With a deviation only where there are several seeds."""
    spread = {name: (31.25, 4.04) for name in experiment_report.COLUMNS}
    label = "Roach, minibatch 1024"
    monkeypatch.setattr(experiment_report, "table", lambda rows: [(label, spread)])
    console = Console(width=80, record=True, file=io.StringIO())
    row = experiment_report.Row(label, "mean", 10_000_000, (Path("a"),) * num_seeds)
    experiment_report.show([row], "A title", console)
    text = console.export_text()
    assert label in text and "10,000,000" in text and text.count(shown) == 3
    assert "…" not in text and ("±" in text) is (num_seeds > 1)


def test_there_is_a_plot(experiment):
    assert (experiment[0] / "plot.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_what_was_cut_off_and_goes_on_ends_as_if_nothing_had_happened(experiment):
    straight, cut = experiment
    assert (straight / "table.md").read_text() == (cut / "table.md").read_text()
    assert not list(cut.rglob(f"{seeds.TOGETHER}*"))


def test_each_seed_is_the_run_that_it_would_be_alone(experiment, tmp_path):
    straight, _ = experiment
    cell = ablations.ABLATIONS["epochs"].cells[1]
    shared = dataclasses.replace(TINY, run=dataclasses.replace(TINY.run, routes_seed=0))
    config = ablations.configure(cell, shared, NUM_UPDATES * 16)
    config = dataclasses.replace(config, run=dataclasses.replace(config.run, seed=1))
    made = build.setup(config)
    state = build.initial_state(made)
    found = checkpoint.restore(straight / "3-epochs" / "seed-1", like=state)
    step = trainer.make_train_step(made.network, config.ppo, made.mesh)
    for _ in range(NUM_UPDATES):
        state, _ = step(made.env, state)
    for a, b in zip(jax.tree.leaves(state.params), jax.tree.leaves(found.params), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-5)
    other = checkpoint.restore(straight / "3-epochs" / "seed-0", like=state)
    pairs = zip(jax.tree.leaves(other.params), jax.tree.leaves(found.params), strict=True)
    assert any(np.abs(np.asarray(a) - np.asarray(b)).max() > 0.01 for a, b in pairs)


def test_other_values_in_the_same_folder_are_refused(experiment, capsys):
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(presets.PRESETS, "tiny", presets.Preset("small", TINY))
        args = [*ARGS[:3], "--samples", "64", "--preset", "tiny", "--dir", str(experiment[0])]
        assert experiments.main(args) == 2
    error = capsys.readouterr().err
    assert "experiment.json: was begun with other values of samples" in error


@pytest.mark.parametrize(
    ("args", "reason"),
    [
        (["--seeds", "0"], "--seeds 0: is below the least allowed, 1"),
        (["--samples", "0"], "--samples 0: is below"),
        (["--minutes", "0"], "--minutes 0.0: is not a number above 0"),
        (["--minutes", "nan"], "--minutes nan: is not a number above 0"),
        (["--minutes", "1", "--samples", "5"], "--minutes and --samples exclude each other"),
        (["--preset", "cpuu"], "--preset cpuu: is none of cpu, "),
        (["--first-seed", "-1"], "--first-seed -1: is not from 0"),
        (["cpu-preset", "--preset", "atari"], "--preset atari: cpu-preset is about the preset cpu"),
    ],
)
def test_mistakes_are_said_in_one_line(args, reason, capsys, tmp_path):
    name = [] if args[0] == "cpu-preset" else ["epochs"]
    assert experiments.main([*name, *args, "--dir", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and reason in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_groups_go_on_with_whom_they_began(tmp_path):
    assert seeds.groups([0, 1, 2, 3, 4], 2, tmp_path) == [(0, 1), (2, 3), (4,)]
    (tmp_path / f"{seeds.TOGETHER}1-2").mkdir()
    assert seeds.groups([2, 3], 4, tmp_path) == [(1, 2), (3,)]
    assert seeds.groups([3, 4], 4, tmp_path) == [(3, 4)]


def test_minutes_are_turned_into_samples_once(tmp_path, monkeypatch, capsys):
    """Each cell at its own speed; what was measured is kept for when the command goes on."""
    measured, trained = [], []

    def speeds(configs):
        measured.extend(config.ppo.update_epochs for config in configs)
        return [{4: 10.0, 3: 20.0}[config.ppo.update_epochs] for config in configs]

    def interrupted(cell, config, *_):
        trained.append((cell.name, config.ppo.total_samples))
        return cell.name == "4 epochs"

    monkeypatch.setitem(presets.PRESETS, "tiny", presets.Preset("small", TINY))
    monkeypatch.setattr(time_budget, "samples_per_second", speeds)
    monkeypatch.setattr(experiments, "_train", interrupted)
    args = ["epochs", "--preset", "tiny", "--dir", str(tmp_path), "--minutes"]
    for _ in range(2):
        assert experiments.main([*args, "0.5"]) == 0
    assert measured == [4, 3]
    assert trained == 2 * [("4 epochs", 300), ("3 epochs", 600)]
    assert experiments.main([*args, "1.5"]) == 2
    assert "was begun with other values of minutes" in capsys.readouterr().err
    assert measured == [4, 3]


def _taking(monkeypatch, *updates):
    """The clock of trainings whose updates take so many seconds, in the order of the calls."""
    ends = np.cumsum(updates)
    readings = iter(np.stack([ends - updates, ends], axis=1).ravel())
    clock = types.SimpleNamespace(perf_counter=lambda: float(next(readings)))
    made = types.SimpleNamespace(network=None, mesh=None, env=None, storage=None)
    monkeypatch.setattr(timing, "time", clock)
    monkeypatch.setattr(build, "setup", lambda config: made)
    monkeypatch.setattr(build, "initial_state", lambda made: jnp.zeros(()))
    step = lambda env, state: (state + 1, {})  # noqa: E731
    monkeypatch.setattr(trainer, "make_train_step", lambda *_: step)
    return readings


def test_the_speed_is_that_of_the_median_update(monkeypatch):
    """The first, which compiles, and the second do not count."""
    readings = _taking(monkeypatch, 50.0, 9.0, 1.0, 2.0, 7.0, 4.0, 6.0, 5.0, 3.0)
    assert time_budget.samples_per_second([TINY]) == [TINY.ppo.batch_size / 4.0]
    assert next(readings, None) is None


def test_a_machine_that_slows_down_slows_nobody_against_the_others(monkeypatch):
    """The second takes twice the first's time; the third is timed when all take three times it."""
    warm_up, second, third = [50.0, 9.0], 7 * [1.0, 2.0], 7 * [3.0, 1.5]
    readings = _taking(monkeypatch, *warm_up, *warm_up, *second, *warm_up, *third)
    batch = TINY.ppo.batch_size
    # The first one's median over both times is 2 s.
    expected = [batch / 2.0, batch / 4.0, batch / 1.0]
    np.testing.assert_allclose(time_budget.samples_per_second(3 * [TINY]), expected)
    assert next(readings, None) is None


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("{", "can't be read: "),
        ("[]", "is no experiment's plan"),
        ('{"name": "epochs", "first_seed": 0, "minutes": 1.0, "samples": 5}', "'4 epochs'"),
        (
            '{"name": "epochs", "first_seed": 0, "minutes": 1.0, '
            '"samples": {"4 epochs": 9, "3 epochs": "9"}}',
            "samples: has no whole number above 0 for '3 epochs'",
        ),
    ],
)
def test_a_damaged_plan_is_said_in_one_line(text, reason, tmp_path, capsys):
    (tmp_path / "experiment.json").write_text(text)
    assert experiments.main(["epochs", "--minutes", "1", "--dir", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert "experiment.json: " in error and reason in error and error.count("\n") == 1
    assert (tmp_path / "experiment.json").read_text() == text
