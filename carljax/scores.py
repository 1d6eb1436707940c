"""The Driving Score: route completion times a factor for each infraction.

Source: CARLA leaderboard 2.0; `leaderboard` says how a drive goes on after one, `result_file` how
the leaderboard writes it down. The completion up to the first hard infraction is reported beside
it: what an episode of training would have reached.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from carljax.leaderboard import ENDS, EVENTS

# source: CARLA leaderboard 2.0, infraction penalties
FACTORS: Mapping[str, float] = {
    "pedestrian_collision": 0.5,
    "vehicle_collision": 0.6,
    "static_collision": 0.65,
    "red_light": 0.7,
    "stop_sign": 0.8,
    "scenario_timeout": 0.7,
    "failed_to_yield": 0.7,
}
# `leaderboard.ENDS` have no factor of their own: what they cost is the rest of the route.

# What driving at no speed at all would cost on one stage. source: CARLA leaderboard 2.0, where
# factors of several stages are multiplied; its versions since August 2024 charge nothing
MIN_SPEED_WEIGHT = 0.3
MIN_SPEED = "min_speed"
INFRACTIONS = (*EVENTS, MIN_SPEED)


@dataclasses.dataclass(frozen=True)
class Event:
    """Something that happened on a drive.

    Attributes:
      name: one of `leaderboard.EVENTS`.
      xyz: where the ego was, m in the map's own frame; None where that is not known any more.
      seconds: from the start.
      agent: number of the other road user, None where there was none.
    """

    name: str
    xyz: tuple[float, float, float] | None
    seconds: float
    agent: int | None = None


@dataclasses.dataclass(frozen=True)
class RouteScore:
    """How one drive of one route went.

    Attributes:
      index: row in the bank of routes.
      route_id: its name.
      repetition: which drive of it.
      town: its name.
      length_km: of the route.
      driven_km: by the ego.
      seconds: of simulated time.
      completion: percent of the route.
      clean_completion: percent of the route at the first hard infraction.
      outside_km: of the route, passed outside lanes.
      num_scenarios: placed on the route.
      num_triggered: of them, that the ego came to.
      speed_percent: of the traffic's speed, on each stage of the route that was driven.
      events: in order of time.
    """

    index: int
    route_id: str
    repetition: int
    town: str
    length_km: float
    driven_km: float
    seconds: float
    completion: float
    clean_completion: float
    outside_km: float
    num_scenarios: int
    num_triggered: int
    speed_percent: tuple[float, ...]
    events: tuple[Event, ...]

    @property
    def completed_km(self) -> float:
        """Length of the route as far as it was completed, km."""
        return self.length_km * self.completion / 100.0

    @property
    def outside_frac(self) -> float:
        """Fraction of the completed route that was passed outside lanes."""
        return min(self.outside_km / self.completed_km, 1.0) if self.outside_km > 0 else 0.0

    @property
    def slow_percent(self) -> tuple[float, ...]:
        """Those of `speed_percent` that are an infraction, to two decimals."""
        rounded = (round(percent, 2) for percent in self.speed_percent)
        return tuple(percent for percent in rounded if percent < 100.0)

    @property
    def infractions(self) -> tuple[str, ...]:
        """Names of `INFRACTIONS`, one for each time it happened."""
        return (*(event.name for event in self.events), *(MIN_SPEED,) * len(self.slow_percent))

    @property
    def min_speed_penalty(self) -> float:
        """Product of the factors for being slow."""
        return math.prod(1 - MIN_SPEED_WEIGHT * (1 - slow / 100) for slow in self.slow_percent)

    @property
    def penalty(self) -> float:
        """Product of all factors."""
        happened = math.prod(FACTORS.get(event.name, 1.0) for event in self.events)
        return happened * (1.0 - self.outside_frac) * self.min_speed_penalty

    @property
    def driving_score(self) -> float:
        """Completion times the factors of what happened, percent."""
        return self.completion * self.penalty

    @property
    def end(self) -> str | None:
        """What ended the route before its end, one of `leaderboard.ENDS`; None: it was finished."""
        return next((event.name for event in self.events if event.name in ENDS), None)

    def to_json(self) -> dict[str, Any]:
        """All of it, in values that JSON can hold."""
        return {
            **dataclasses.asdict(self),
            "outside_frac": self.outside_frac,
            "infractions": list(self.infractions),
            "penalty": self.penalty,
            "driving_score": self.driving_score,
        }


@dataclasses.dataclass(frozen=True)
class EvalResult:
    """The scores of a set of routes, each driven once or several times."""

    routes: tuple[RouteScore, ...]

    def spread(self, value: Callable[[RouteScore], float]) -> tuple[float, float]:
        """Mean and standard deviation over all drives."""
        return mean_and_std([value(route) for route in self.routes])

    def spread_of_repetitions(self, value: Callable[[RouteScore], float]) -> tuple[float, float]:
        """Mean and standard deviation over repetitions of the mean over routes."""
        numbers = sorted({route.repetition for route in self.routes})
        return mean_and_std(
            [
                float(
                    np.mean([value(route) for route in self.routes if route.repetition == number])
                )
                for number in numbers
            ]
        )

    @property
    def driving_score(self) -> tuple[float, float]:
        """Mean and standard deviation over all drives, percent."""
        return self.spread(lambda route: route.driving_score)

    @property
    def completion(self) -> tuple[float, float]:
        """Mean and standard deviation of route completion, percent."""
        return self.spread(lambda route: route.completion)

    @property
    def clean_completion(self) -> tuple[float, float]:
        """Mean and standard deviation of the completion up to the first infraction, percent."""
        return self.spread(lambda route: route.clean_completion)

    @property
    def num_repetitions(self) -> int:
        """How often each route was driven."""
        return len({route.repetition for route in self.routes})

    @property
    def completed_km(self) -> float:
        """Length of the routes as far as they were completed, summed up, at least a metre.

        source: CARLA leaderboard 2.0, length times completion, at least 0.001 km
        """
        return max(sum(route.completed_km for route in self.routes), 0.001)

    @property
    def infractions_per_km(self) -> dict[str, float]:
        """Number of each infraction divided by the completed km."""
        names = [name for route in self.routes for name in route.infractions]
        return {name: names.count(name) / self.completed_km for name in INFRACTIONS}

    @property
    def outside_frac(self) -> float:
        """Fraction of all completed routes that was passed outside lanes."""
        return sum(route.outside_km for route in self.routes) / self.completed_km

    @property
    def finished_frac(self) -> float:
        """Fraction of routes driven to their end."""
        return sum(route.end is None for route in self.routes) / len(self.routes)

    def by_town(self) -> dict[str, EvalResult]:
        """The same scores for each town apart."""
        names = sorted({route.town for route in self.routes})
        return {
            name: EvalResult(tuple(route for route in self.routes if route.town == name))
            for name in names
        }

    def summary(self) -> dict[str, Any]:
        """Means and rates, in values that JSON can hold."""
        means: dict[str, float] = {}
        values: dict[str, Callable[[RouteScore], float]] = {
            "driving_score": lambda route: route.driving_score,
            "driving_score_without_min_speed": lambda route: (
                route.driving_score / route.min_speed_penalty
            ),
            "route_completion": lambda route: route.completion,
            "clean_completion": lambda route: route.clean_completion,
            "penalty": lambda route: route.penalty,
        }
        for name, value in values.items():
            means[f"{name}_mean"], means[f"{name}_std"] = self.spread(value)
            means[f"{name}_std_of_repetitions"] = self.spread_of_repetitions(value)[1]
        return {
            **means,
            "finished_frac": self.finished_frac,
            "num_routes": len(self.routes) // self.num_repetitions,
            "num_repetitions": self.num_repetitions,
            "completed_km": self.completed_km,
            "num_scenarios": sum(route.num_scenarios for route in self.routes),
            "num_triggered": sum(route.num_triggered for route in self.routes),
            "outside_frac": self.outside_frac,
            "infractions_per_km": self.infractions_per_km,
        }

    def to_json(self) -> dict[str, Any]:
        """Summary, also of each town, and single drives, in values that JSON can hold."""
        return {
            **self.summary(),
            "towns": {name: part.summary() for name, part in self.by_town().items()},
            "routes": [route.to_json() for route in self.routes],
        }


def mean_and_std(values: Sequence[float]) -> tuple[float, float]:
    """Mean and sample standard deviation; 0 for a single value. source: CARLA leaderboard 2.0."""
    std = float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
    return float(np.mean(values)), std
