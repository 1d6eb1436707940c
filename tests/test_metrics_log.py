"""The JSONL log survives cuts and resumes, and TensorBoard gets the same numbers."""

from __future__ import annotations

import json
import math

import pytest

from carljax import metrics_log
from carljax.metrics_log import MetricsLog, WindowMean


def write_updates(run_dir, numbers, start_update=0):
    with MetricsLog(run_dir, start_update) as log:
        for update in numbers:
            log.write(update, update * 10, {"ppo/loss": update / 2})


def test_a_line_holds_update_steps_and_metrics(tmp_path):
    write_updates(tmp_path, [1, 2])
    assert metrics_log.read(tmp_path) == [
        {"update": 1, "env_steps": 10, "ppo/loss": 0.5},
        {"update": 2, "env_steps": 20, "ppo/loss": 1.0},
    ]


def test_numbers_that_are_not_finite_are_null_so_that_every_line_is_json(tmp_path):
    with MetricsLog(tmp_path) as log:
        log.write(1, 10, {"episode/return": math.nan, "ppo/loss": math.inf})
    text = (tmp_path / metrics_log.FILE).read_text()
    assert "NaN" not in text and "Infinity" not in text
    assert json.loads(text)["episode/return"] is None


def test_a_resumed_run_goes_on_behind_its_checkpoint(tmp_path):
    # Updates 3 and 4 were logged but came after the last checkpoint, at 2: they will be made again.
    write_updates(tmp_path, [1, 2, 3, 4])
    write_updates(tmp_path, [3, 4, 5], start_update=2)
    assert [line["update"] for line in metrics_log.read(tmp_path)] == [1, 2, 3, 4, 5]


def test_a_line_that_was_cut_off_is_dropped(tmp_path):
    write_updates(tmp_path, [1, 2])
    path = tmp_path / metrics_log.FILE
    path.write_text(path.read_text()[:-5])
    assert [line["update"] for line in metrics_log.read(tmp_path)] == [1]
    write_updates(tmp_path, [2], start_update=1)
    assert [line["update"] for line in metrics_log.read(tmp_path)] == [1, 2]


def test_there_is_nothing_to_read_where_there_is_no_run(tmp_path):
    assert metrics_log.read(tmp_path) == []


def test_tensorboard_gets_an_event_file(tmp_path):
    write_updates(tmp_path, [1])
    (events,) = (tmp_path / metrics_log.TENSORBOARD_FOLDER).iterdir()
    assert b"ppo/loss" in events.read_bytes()


def test_window_mean_uses_the_last_values_and_skips_missing_ones():
    window = WindowMean(2, [1.0, None])
    assert window.mean == 1.0
    for value in (2.0, math.nan, 4.0):
        window.add(value)
    assert window.mean == pytest.approx(3.0)  # (2 + 4) / 2
    assert math.isnan(WindowMean(2).mean)
