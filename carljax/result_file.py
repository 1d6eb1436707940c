"""A result in the layout of CARLA leaderboard 2.0's own file, for scripts that read that.

Names of keys, their order in `values` and `labels`, wording of messages and rounding are the
leaderboard's; what it has no word for (a route that ended off the road) is put where it comes
nearest. Places are in CARLA's frame: left-handed, y to the south.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from carljax.scores import EvalResult, Event, RouteScore

# source: CARLA leaderboard 2.0
LAYOUT: Mapping[str, tuple[str, ...]] = {
    "collisions_layout": ("static_collision",),
    "collisions_pedestrian": ("pedestrian_collision",),
    "collisions_vehicle": ("vehicle_collision",),
    "red_light": ("red_light",),
    "stop_infraction": ("stop_sign",),
    "outside_route_lanes": (),
    "min_speed_infractions": (),
    "yield_emergency_vehicle_infractions": ("failed_to_yield",),
    "scenario_timeouts": ("scenario_timeout",),
    "route_dev": ("route_deviation", "off_road"),
    "vehicle_blocked": ("blocked",),
    "route_timeout": ("timeout",),
}
MESSAGES: Mapping[str, str] = {
    "static_collision": "Agent collided against object with type=static and id={agent}",
    "pedestrian_collision": "Agent collided against object with type=walker and id={agent}",
    "vehicle_collision": "Agent collided against object with type=vehicle and id={agent}",
    "red_light": "Agent ran a red light",
    "stop_sign": "Agent ran a stop",
    "failed_to_yield": "Agent failed to yield to an emergency vehicle",
    "scenario_timeout": "Agent timed out a scenario",
    "route_deviation": "Agent deviated from the route",
    "off_road": "Agent left the road",
    "blocked": "Agent got blocked",
    "timeout": "Route timeout.",
}
WITHOUT_PLACE = ("failed_to_yield", "scenario_timeout", "timeout")
FAILURES: Mapping[str, str] = {
    "off_road": "Failed - Agent left the road",
    "route_deviation": "Failed - Agent deviated from the route",
    "blocked": "Failed - Agent got blocked",
    "timeout": "Failed - Agent timed out",
}
LABELS: Mapping[str, str] = {
    "collisions_pedestrian": "Collisions with pedestrians",
    "collisions_vehicle": "Collisions with vehicles",
    "collisions_layout": "Collisions with layout",
    "red_light": "Red lights infractions",
    "stop_infraction": "Stop sign infractions",
    "outside_route_lanes": "Off-road infractions",
    "route_dev": "Route deviations",
    "route_timeout": "Route timeouts",
    "vehicle_blocked": "Agent blocked",
    "yield_emergency_vehicle_infractions": "Yield emergency vehicles infractions",
    "scenario_timeouts": "Scenario timeouts",
    "min_speed_infractions": "Min speed infractions",
}
SCORE_LABELS = {
    "score_composed": "Avg. driving score",
    "score_route": "Avg. route completion",
    "score_penalty": "Avg. infraction penalty",
}


def layout(result: EvalResult, system_seconds: float) -> dict[str, Any]:
    """Puts a result into the leaderboard's layout.

    Args:
      result: the scores.
      system_seconds: wall time of all drives together.

    Returns:
      Values that JSON can hold.
    """
    share = system_seconds / len(result.routes)
    records = [_record(number, route, share) for number, route in enumerate(result.routes)]
    overall = _global_record(result, records)
    scores = [overall["scores_mean"][key] for key in SCORE_LABELS]
    rates = [overall["infractions"][key] for key in LABELS]
    return {
        "_checkpoint": {
            "global_record": overall,
            "progress": [len(records), len(records)],
            "records": records,
        },
        "entry_status": "Finished",
        "eligible": True,
        "sensors": [],
        "values": [str(value) for value in (*scores, *rates)],
        "labels": [*SCORE_LABELS.values(), *LABELS.values()],
    }


def status(route: RouteScore) -> str:
    """The leaderboard's word for how a route ended."""
    if route.end is not None:
        return FAILURES[route.end]
    return "Completed" if any(_infractions(route).values()) else "Perfect"


def _record(number: int, route: RouteScore, system_seconds: float) -> dict[str, Any]:
    infractions = _infractions(route)
    return {
        "index": number,
        "route_id": f"RouteScenario_{route.route_id}_rep{route.repetition}",
        "status": status(route),
        "num_infractions": sum(len(messages) for messages in infractions.values()),
        "infractions": infractions,
        "scores": {
            "score_route": round(route.completion, 6),
            "score_penalty": round(route.penalty, 6),
            "score_composed": round(route.driving_score, 6),
        },
        "meta": {
            "route_length": round(1000.0 * route.length_km, 3),
            "duration_game": round(route.seconds, 3),
            "duration_system": round(system_seconds, 3),
        },
        "town_name": route.town,
    }


def _infractions(route: RouteScore) -> dict[str, list[str]]:
    """The leaderboard's messages by its keys."""
    messages = {
        key: [_message(event) for event in route.events if event.name in names]
        for key, names in LAYOUT.items()
    }
    if route.outside_km > 0:
        messages["outside_route_lanes"].append(
            "Agent went outside its route lanes for about"
            f" {round(1000.0 * route.outside_km, 3)} meters"
            f" ({round(100.0 * route.outside_frac, 2)}% of the completed route)"
        )
    messages["min_speed_infractions"] += [
        f"Average speed is {percent}% of the surrounding traffic's one"
        for percent in route.slow_percent
    ]
    return messages


def _message(event: Event) -> str:
    text = MESSAGES[event.name].format(agent=event.agent)
    if event.xyz is None or event.name in WITHOUT_PLACE:
        return text
    x, y, z = event.xyz
    return f"{text} at (x={round(x, 3)}, y={round(-y, 3)}, z={round(z, 3)})"


def _global_record(result: EvalResult, records: list[dict[str, Any]]) -> dict[str, Any]:
    counts = {key: sum(len(record["infractions"][key]) for record in records) for key in LAYOUT}
    rates = {key: round(count / result.completed_km, 3) for key, count in counts.items()}
    # Not a rate but the km themselves, as the leaderboard has it.
    rates["outside_route_lanes"] = round(sum(route.outside_km for route in result.routes), 3)
    scores = {
        "score_composed": result.driving_score,
        "score_route": result.completion,
        "score_penalty": result.spread(lambda route: route.penalty),
    }
    failed = [record for record in records if record["status"].startswith("Failed")]
    perfect = all(record["status"] == "Perfect" for record in records)
    return {
        "index": -1,
        "route_id": -1,
        "status": "Failed" if failed else "Perfect" if perfect else "Completed",
        "infractions": rates,
        "scores_mean": {key: round(value[0], 6) for key, value in scores.items()},
        "scores_std_dev": {key: round(value[1], 3) for key, value in scores.items()},
        "meta": {
            "total_length": round(sum(record["meta"]["route_length"] for record in records), 3),
            "duration_game": round(sum(record["meta"]["duration_game"] for record in records), 3),
            "duration_system": round(
                sum(record["meta"]["duration_system"] for record in records), 3
            ),
            "exceptions": [
                [record["route_id"], record["index"], record["status"]] for record in failed
            ],
        },
    }
