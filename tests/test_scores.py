"""The Driving Score against values worked out by hand."""

from __future__ import annotations

import dataclasses
import io
import json

import pytest
from rich.console import Console

from carljax import score_table
from carljax.scores import EvalResult, Event, RouteScore

FINISHED = RouteScore(
    index=0,
    route_id="7",
    repetition=0,
    town="a",
    length_km=1.0,
    driven_km=1.02,
    seconds=120.0,
    completion=100.0,
    clean_completion=100.0,
    outside_km=0.0,
    num_scenarios=8,
    num_triggered=6,
    speed_percent=(100.0, 130.0, 100.0, 250.0),
    events=(),
)


def events(*names):
    return tuple(Event(name, (1.0, 2.0, 0.0), 5.0) for name in names)


# Half of 2 km, a tenth of that outside lanes, a car struck, at last off the road.
CRASHED = dataclasses.replace(
    FINISHED,
    index=1,
    route_id="9",
    town="b",
    length_km=2.0,
    driven_km=1.0,
    seconds=60.0,
    completion=50.0,
    clean_completion=30.0,
    outside_km=0.1,
    speed_percent=(),
    events=events("vehicle_collision", "off_road"),
)


def test_a_finished_route_has_the_full_score():
    assert FINISHED.driving_score == 100.0
    assert FINISHED.infractions == ()


def test_completion_is_multiplied_by_every_factor():
    assert CRASHED.driving_score == pytest.approx(27.0)  # 50 x 0.6 x (1 - 0.1)


@pytest.mark.parametrize(
    ("infractions", "factor"),
    [
        (("pedestrian_collision",), 0.5),
        (("vehicle_collision",), 0.6),
        (("static_collision",), 0.65),
        (("red_light",), 0.7),
        (("stop_sign",), 0.8),
        (("scenario_timeout",), 0.7),
        (("failed_to_yield",), 0.7),
        (("off_road",), 1.0),
        (("route_deviation",), 1.0),
        (("blocked",), 1.0),
        (("timeout",), 1.0),
        (("vehicle_collision", "red_light"), 0.42),  # 0.6 x 0.7
        (("pedestrian_collision", "static_collision"), 0.325),  # 0.5 x 0.65
        (("red_light", "red_light", "stop_sign"), 0.392),  # 0.7 x 0.7 x 0.8: each time counts
        (("scenario_timeout", "failed_to_yield", "stop_sign"), 0.392),  # 0.7 x 0.7 x 0.8
    ],
)
def test_factors_are_those_of_leaderboard_2(infractions, factor):
    route = dataclasses.replace(FINISHED, events=events(*infractions))
    assert route.penalty == pytest.approx(factor)
    assert route.driving_score == pytest.approx(100 * factor)


@pytest.mark.parametrize(
    ("outside_km", "completion", "factor"),
    [
        (0.25, 100.0, 0.75),  # a quarter of 1 km
        (0.25, 50.0, 0.5),  # half of the 0.5 km that were completed
        (0.0, 0.0, 1.0),  # nothing of nothing
    ],
)
def test_metres_outside_lanes_count_against_the_completed_route(outside_km, completion, factor):
    route = dataclasses.replace(FINISHED, outside_km=outside_km, completion=completion)
    assert route.penalty == pytest.approx(factor)


@pytest.mark.parametrize(
    ("percent", "factor", "num"),
    [
        ((50.0,), 0.85, 1),  # 1 - 0.3 x (1 - 0.5)
        ((0.0,), 0.7, 1),  # 1 - 0.3
        ((50.0, 50.0), 0.7225, 2),  # 0.85 x 0.85
        ((90.0, 200.0, 80.0, 100.0), 0.9118, 2),  # (1 - 0.03) x (1 - 0.06) = 0.97 x 0.94
        ((99.996,), 1.0, 0),  # 100.00 in two decimals
        ((99.99,), 0.99997, 1),  # 1 - 0.3 x 0.0001
    ],
)
def test_each_slow_stage_is_a_factor(percent, factor, num):
    route = dataclasses.replace(FINISHED, speed_percent=percent)
    assert route.penalty == pytest.approx(factor)
    assert route.infractions == ("min_speed",) * num


def test_all_factors_together():
    route = dataclasses.replace(
        FINISHED,
        completion=80.0,
        outside_km=0.16,  # a fifth of 0.8 km
        speed_percent=(50.0, 120.0, 75.0),
        events=events("pedestrian_collision", "red_light", "failed_to_yield", "blocked"),
    )
    # 0.5 x 0.7 x 0.7 = 0.245; x 0.8 = 0.196; x 0.85 x (1 - 0.3 x 0.25) = 0.196 x 0.78625
    assert route.penalty == pytest.approx(0.154105)
    assert route.driving_score == pytest.approx(12.3284)
    assert route.end == "blocked"


def test_a_set_of_routes_has_mean_deviation_and_rates():
    result = EvalResult((FINISHED, CRASHED))
    # Scores 100 and 27: mean 63.5, squared deviations 2 x 36.5^2 = 2664.5, root of that over 1
    assert result.driving_score == pytest.approx((63.5, 51.6188), rel=1e-5)
    # 100 and 50: mean 75, root of 2 x 25^2
    assert result.completion == pytest.approx((75.0, 35.35534), rel=1e-5)
    assert result.clean_completion[0] == pytest.approx(65.0)  # 100 and 30
    assert result.finished_frac == 0.5
    # 1 km x 100 % + 2 km x 50 % = 2 km with one collision, 0.1 km of them outside lanes
    assert result.completed_km == pytest.approx(2.0)
    assert result.infractions_per_km["vehicle_collision"] == pytest.approx(0.5)
    assert result.infractions_per_km["red_light"] == 0.0
    assert result.outside_frac == pytest.approx(0.05)


def test_one_route_deviates_from_nothing():
    assert EvalResult((CRASHED,)).driving_score == (pytest.approx(27.0), 0.0)


def test_repetitions_are_averaged_over_routes_first():
    again = dataclasses.replace(CRASHED, repetition=1, completion=100.0, outside_km=0.0)
    result = EvalResult((FINISHED, CRASHED, dataclasses.replace(FINISHED, repetition=1), again))
    # First time 100 and 27, mean 63.5; second time 100 and 60, mean 80
    mean, std = result.spread_of_repetitions(lambda route: route.driving_score)
    assert mean == pytest.approx(71.75)
    assert std == pytest.approx(11.66726, rel=1e-5)  # root of 2 x 8.25^2
    summary = result.summary()
    assert summary["driving_score_std_of_repetitions"] == pytest.approx(std)
    assert (summary["num_routes"], summary["num_repetitions"]) == (2, 2)


def test_the_score_without_minimum_speed_is_beside_it():
    slow = dataclasses.replace(FINISHED, speed_percent=(50.0,), events=events("stop_sign"))
    summary = EvalResult((slow,)).summary()
    assert summary["driving_score_mean"] == pytest.approx(68.0)  # 100 x 0.8 x 0.85
    assert summary["driving_score_without_min_speed_mean"] == pytest.approx(80.0)


def test_a_route_that_was_driven_to_its_end_is_finished_whatever_it_cost():
    costly = dataclasses.replace(FINISHED, events=events("red_light", "red_light"))
    result = EvalResult((costly,))
    assert result.finished_frac == 1.0
    assert result.infractions_per_km["red_light"] == pytest.approx(2.0)


def test_a_drive_without_any_progress_counts_a_metre():
    stuck = dataclasses.replace(FINISHED, completion=0.0, events=events("blocked"))
    assert EvalResult((stuck,)).infractions_per_km["blocked"] == pytest.approx(1000.0)


def test_towns_are_scored_apart():
    parts = EvalResult((FINISHED, CRASHED)).by_town()
    assert {town: part.completion[0] for town, part in parts.items()} == {"a": 100.0, "b": 50.0}


def test_json_holds_summary_towns_and_routes():
    values = json.loads(json.dumps(EvalResult((FINISHED, CRASHED)).to_json()))
    assert values["driving_score_mean"] == pytest.approx(63.5)
    assert values["towns"]["b"]["driving_score_mean"] == pytest.approx(27.0)
    assert values["routes"][1]["infractions"] == ["vehicle_collision", "off_road"]
    assert values["routes"][1]["driving_score"] == pytest.approx(27.0)


def rows_of(*routes):
    """What a terminal of 80 columns shows: {first word of a line: the rest, one list a table}."""
    out = io.StringIO()
    score_table.show(EvalResult(routes), Console(file=out, width=80), title="two towns")
    rows: dict[str, list[list[str]]] = {}
    for line in out.getvalue().splitlines():
        first, *rest = line.split() or [""]
        rows.setdefault(first, []).append(rest)
    return rows


def test_the_tables_have_the_means_and_a_row_for_each_town():
    rows = rows_of(FINISHED, CRASHED)
    assert rows["town"] == [
        ["drives", "DS", "RC", "clean", "done", "Out"],
        ["Ped", "Veh", "Stat", "Red", "Stop", "Dev", "Block", "MS", "TO", "STO", "Yield"],
    ]
    means, rates = rows["all"]
    assert means == [*"2 63.5 ± 51.6 75.0 ± 35.4 65.0 50 5.0".split()]
    # One car and one end off the road on 2 km
    assert rates == ["0.00", "0.50", "0.00", "0.00", "0.00", "0.50", *["0.00"] * 5]
    assert rows["a"][0][:4] == ["1", "100.0", "±", "0.0"]
    assert rows["b"][1][1] == "1.00"  # one on its 1 km


def test_the_table_of_one_town_has_one_row_and_repetitions_a_line():
    again = dataclasses.replace(FINISHED, repetition=1, completion=60.0)
    rows = rows_of(FINISHED, again)
    assert "a" not in rows and len(rows["all"]) == 2
    # 100 and 60: mean 80, root of 2 x 20^2 = 28.3
    assert " ".join(rows["over"][-1]) == "2 repetitions: DS 80.0 ± 28.3, RC 80.0 ± 28.3"
