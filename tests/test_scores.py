"""The Driving Score against values worked out by hand."""

from __future__ import annotations

import dataclasses
import io
import json

import pytest
from rich.console import Console

from carljax import scores
from carljax.scores import EvalResult, RouteScore

FINISHED = RouteScore(
    route=0,
    town="a",
    length_km=1.0,
    driven_km=1.02,
    seconds=120.0,
    completion=100.0,
    clean_completion=100.0,
    outside_frac=0.0,
    infractions=(),
)
CRASHED = RouteScore(
    route=1,
    town="b",
    length_km=2.0,
    driven_km=1.0,
    seconds=60.0,
    completion=50.0,
    clean_completion=30.0,
    outside_frac=0.1,
    infractions=("vehicle_collision", "off_road"),
)


def test_a_finished_route_has_the_full_score():
    assert FINISHED.driving_score == 100.0


def test_completion_is_multiplied_by_every_factor():
    assert CRASHED.driving_score == pytest.approx(50 * 0.6 * 0.9)  # vehicle, a tenth outside lanes


@pytest.mark.parametrize(
    ("infractions", "factor"),
    [
        (("pedestrian_collision",), 0.5),
        (("static_collision",), 0.65),
        (("red_light",), 0.7),
        (("stop_sign",), 0.8),
        (("vehicle_collision", "red_light"), 0.42),  # 0.6 x 0.7
        (("red_light", "red_light", "stop_sign"), 0.392),  # 0.7 x 0.7 x 0.8: each time counts
        (("off_road",), 1.0),
        (("blocked",), 1.0),
    ],
)
def test_factors_are_those_of_leaderboard_2(infractions, factor):
    route = dataclasses.replace(FINISHED, infractions=infractions)
    assert route.driving_score == pytest.approx(100 * factor)


def test_a_set_of_routes_has_mean_deviation_and_rates():
    result = EvalResult((FINISHED, CRASHED))
    # Scores 100 and 27: mean 63.5, deviation 36.5. Completion 100 and 50: mean 75, deviation 25.
    assert result.driving_score == pytest.approx((63.5, 36.5))
    assert result.completion == pytest.approx((75.0, 25.0))
    assert result.clean_completion == pytest.approx((65.0, 35.0))  # 100 and 30
    assert result.finished_frac == 0.5
    # 1 km x 100 % + 2 km x 50 % = 2 km with one collision
    assert result.completed_km == pytest.approx(2.0)
    assert result.infractions_per_km["vehicle_collision"] == pytest.approx(0.5)
    assert result.infractions_per_km["red_light"] == 0.0


def test_a_route_that_was_driven_to_its_end_is_finished_whatever_it_cost():
    costly = dataclasses.replace(FINISHED, infractions=("red_light", "red_light"))
    result = EvalResult((costly,))
    assert result.finished_frac == 1.0
    assert result.infractions_per_km["red_light"] == pytest.approx(2.0)


def test_a_route_without_any_progress_counts_a_metre():
    stuck = dataclasses.replace(FINISHED, completion=0.0, infractions=("blocked",))
    assert EvalResult((stuck,)).infractions_per_km["blocked"] == pytest.approx(1000.0)


def test_towns_are_scored_apart():
    parts = EvalResult((FINISHED, CRASHED)).by_town()
    assert {town: part.completion[0] for town, part in parts.items()} == {"a": 100.0, "b": 50.0}


def test_json_holds_summary_and_routes():
    values = json.loads(json.dumps(EvalResult((FINISHED, CRASHED)).to_json()))
    assert values["driving_score_mean"] == pytest.approx(63.5)
    assert values["routes"][1]["infractions"] == ["vehicle_collision", "off_road"]
    assert values["routes"][1]["driving_score"] == pytest.approx(27.0)


def test_the_table_shows_the_means():
    out = io.StringIO()
    scores.show(EvalResult((FINISHED, CRASHED)), Console(file=out, width=120))
    text = out.getvalue()
    assert "63.5 ± 36.5" in text and "75.0 ± 25.0" in text and "vehicle collision" in text
