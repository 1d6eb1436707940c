"""Results in the layout of CARLA's leaderboard, read as other people's scripts read it."""

from __future__ import annotations

import dataclasses
import json
import re

import pytest

from carljax import result_file
from carljax.scores import EvalResult, Event, RouteScore

INFRACTIONS = {
    "collisions_layout",
    "collisions_pedestrian",
    "collisions_vehicle",
    "red_light",
    "stop_infraction",
    "outside_route_lanes",
    "min_speed_infractions",
    "yield_emergency_vehicle_infractions",
    "scenario_timeouts",
    "route_dev",
    "vehicle_blocked",
    "route_timeout",
}
PERFECT = RouteScore(
    index=0,
    route_id="3",
    repetition=0,
    town="grid",
    length_km=1.0,
    driven_km=1.0,
    seconds=100.0,
    completion=100.0,
    clean_completion=100.0,
    outside_km=0.0,
    num_scenarios=8,
    num_triggered=6,
    speed_percent=(100.0, 120.0, 100.0, 100.0),
    events=(),
)


def event(name, agent=None):
    return Event(name, (10.0, 20.5, 0.25), 7.0, agent)


COSTLY = dataclasses.replace(
    PERFECT,
    index=1,
    route_id="12",
    repetition=1,
    completion=50.0,
    outside_km=0.05,
    speed_percent=(80.0, 140.0),
    events=(
        event("vehicle_collision", 4),
        event("red_light"),
        event("scenario_timeout"),
        event("off_road"),
    ),
)


def written(*routes):
    layout = result_file.layout(EvalResult(routes), system_seconds=6.0)
    return json.loads(json.dumps(layout))


def test_the_file_has_the_leaderboards_keys():
    values = written(PERFECT, COSTLY)
    assert set(values) == {"_checkpoint", "entry_status", "eligible", "sensors", "values", "labels"}
    checkpoint = values["_checkpoint"]
    assert set(checkpoint) == {"global_record", "progress", "records"}
    assert checkpoint["progress"] == [2, 2]
    for record in checkpoint["records"]:
        assert {
            *("index", "route_id", "status", "num_infractions", "infractions", "scores", "meta")
        } <= set(record)
        assert set(record["infractions"]) == INFRACTIONS
        assert set(record["scores"]) == {"score_route", "score_penalty", "score_composed"}
        assert set(record["meta"]) == {"route_length", "duration_game", "duration_system"}
    overall = checkpoint["global_record"]
    assert set(overall["infractions"]) == INFRACTIONS
    assert set(overall["scores_mean"]) == set(overall["scores_std_dev"])
    assert (values["entry_status"], values["eligible"]) == ("Finished", True)
    assert (overall["index"], overall["route_id"]) == (-1, -1)


def test_a_perfect_route():
    (record,) = written(PERFECT)["_checkpoint"]["records"]
    assert record["status"] == "Perfect"
    assert record["num_infractions"] == 0
    assert record["scores"] == {"score_route": 100, "score_penalty": 1, "score_composed": 100}
    assert record["route_id"] == "RouteScenario_3_rep0"
    assert record["meta"] == {"route_length": 1000, "duration_game": 100, "duration_system": 6}


def test_a_route_with_infractions():
    record = written(PERFECT, COSTLY)["_checkpoint"]["records"][1]
    infractions = record["infractions"]
    # The map's y to the north is CARLA's y to the south.
    assert infractions["collisions_vehicle"] == [
        "Agent collided against object with type=vehicle and id=4 at (x=10.0, y=-20.5, z=0.25)"
    ]
    assert infractions["red_light"] == ["Agent ran a red light at (x=10.0, y=-20.5, z=0.25)"]
    assert infractions["scenario_timeouts"] == ["Agent timed out a scenario"]
    assert infractions["route_dev"] == ["Agent left the road at (x=10.0, y=-20.5, z=0.25)"]
    assert infractions["min_speed_infractions"] == [
        "Average speed is 80.0% of the surrounding traffic's one"
    ]
    assert record["num_infractions"] == 6  # and the metres outside lanes
    # 0.6 x 0.7 x 0.7 x (1 - 50 m / 500 m) x (1 - 0.3 x 0.2) = 0.294 x 0.9 x 0.94 = 0.248724
    assert record["scores"]["score_penalty"] == pytest.approx(0.248724)
    assert record["scores"]["score_composed"] == pytest.approx(12.4362)
    assert record["route_id"] == "RouteScenario_12_rep1"


def test_metres_outside_lanes_stand_where_scripts_look_for_them():
    record = written(PERFECT, COSTLY)["_checkpoint"]["records"][1]
    (message,) = record["infractions"]["outside_route_lanes"]
    assert float(message.split(" ")[8]) == 50.0
    assert re.search(r"about ([\d.]+) meters \(([\d.]+)% of the completed", message).groups() == (
        "50.0",
        "10.0",
    )


@pytest.mark.parametrize(
    ("end", "text"),
    [
        ("off_road", "Failed - Agent left the road"),
        ("route_deviation", "Failed - Agent deviated from the route"),
        ("blocked", "Failed - Agent got blocked"),
        ("timeout", "Failed - Agent timed out"),
    ],
)
def test_what_ended_a_route_is_its_status(end, text):
    route = dataclasses.replace(PERFECT, completion=40.0, events=(event(end),))
    checkpoint = written(route)["_checkpoint"]
    (record,) = checkpoint["records"]
    assert record["status"] == text
    assert record["num_infractions"] == 1
    assert checkpoint["global_record"]["status"] == "Failed"
    assert checkpoint["global_record"]["meta"]["exceptions"] == [["RouteScenario_3_rep0", 0, text]]


def test_a_finished_route_with_an_infraction_is_completed():
    route = dataclasses.replace(PERFECT, events=(event("stop_sign"),))
    checkpoint = written(PERFECT, route)["_checkpoint"]
    assert [record["status"] for record in checkpoint["records"]] == ["Perfect", "Completed"]
    assert checkpoint["global_record"]["status"] == "Completed"
    assert checkpoint["global_record"]["meta"]["exceptions"] == []


def test_the_global_record_has_means_deviations_and_rates():
    overall = written(PERFECT, COSTLY)["_checkpoint"]["global_record"]
    # 100 and 12.4362: mean 56.2181, root of 2 x 43.7819^2 = 61.917
    assert overall["scores_mean"]["score_composed"] == pytest.approx(56.2181)
    assert overall["scores_std_dev"]["score_composed"] == 61.917
    assert overall["scores_mean"]["score_route"] == 75.0
    # One red light on 1 km + 0.5 km
    assert overall["infractions"]["red_light"] == 0.667
    assert overall["infractions"]["outside_route_lanes"] == 0.05  # km, not a rate
    assert overall["meta"]["total_length"] == 2000
    assert overall["meta"]["duration_system"] == 6.0


def test_values_and_labels_go_together():
    values = written(PERFECT, COSTLY)
    by_label = dict(zip(values["labels"], values["values"], strict=True))
    assert float(by_label["Avg. driving score"]) == pytest.approx(56.2181)
    assert float(by_label["Collisions with vehicles"]) == 0.667
    assert float(by_label["Off-road infractions"]) == 0.05
    assert len(by_label) == 15


def test_an_event_whose_place_is_not_known_any_more_is_counted():
    lost = Event("vehicle_collision", None, 9.0)
    route = dataclasses.replace(PERFECT, events=(event("vehicle_collision", 2), lost))
    (record,) = written(route)["_checkpoint"]["records"]
    assert len(record["infractions"]["collisions_vehicle"]) == 2
    assert record["scores"]["score_penalty"] == pytest.approx(0.36)  # 0.6 x 0.6
