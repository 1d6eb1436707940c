"""The Driving Score: route completion times a factor for each infraction.

Source: CARLA leaderboard 2.0; `leaderboard` says how a drive goes on after one. The completion up
to the first infraction is reported beside it: what an episode of training would have reached.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from carljax.leaderboard import ENDS, INFRACTIONS

# source: CARLA leaderboard 2.0, infraction penalties
FACTORS: Mapping[str, float] = {
    "pedestrian_collision": 0.5,
    "vehicle_collision": 0.6,
    "static_collision": 0.65,
    "red_light": 0.7,
    "stop_sign": 0.8,
}
# `leaderboard.ENDS` have no factor of their own: what they cost is the rest of the route.


@dataclasses.dataclass(frozen=True)
class RouteScore:
    """How one route went.

    Attributes:
      route: row in the bank of held-out routes.
      town: its name.
      length_km: of the route.
      driven_km: by the ego.
      seconds: of simulated time.
      completion: percent of the route.
      clean_completion: percent of the route at the first infraction of any kind.
      outside_frac: fraction of the driven distance outside lanes.
      infractions: names of `INFRACTIONS`, one for each time it happened.
    """

    route: int
    town: str
    length_km: float
    driven_km: float
    seconds: float
    completion: float
    clean_completion: float
    outside_frac: float
    infractions: tuple[str, ...]

    @property
    def driving_score(self) -> float:
        """Completion times the factors of what happened, percent."""
        score = self.completion * (1.0 - self.outside_frac)
        for name in self.infractions:
            score *= FACTORS.get(name, 1.0)
        return score


@dataclasses.dataclass(frozen=True)
class EvalResult:
    """The scores of a set of routes."""

    routes: tuple[RouteScore, ...]

    @property
    def driving_score(self) -> tuple[float, float]:
        """Mean and standard deviation over routes, percent."""
        return _mean_and_std([route.driving_score for route in self.routes])

    @property
    def completion(self) -> tuple[float, float]:
        """Mean and standard deviation of route completion, percent."""
        return _mean_and_std([route.completion for route in self.routes])

    @property
    def clean_completion(self) -> tuple[float, float]:
        """Mean and standard deviation of the completion up to the first infraction, percent."""
        return _mean_and_std([route.clean_completion for route in self.routes])

    @property
    def completed_km(self) -> float:
        """Length of the routes as far as they were completed, summed up, km."""
        return sum(route.length_km * route.completion / 100.0 for route in self.routes)

    @property
    def infractions_per_km(self) -> dict[str, float]:
        """Number of each infraction divided by the completed km (at least a metre per route).

        source: CARLA leaderboard 2.0, length times completion, at least 0.001 km
        """
        km = max(self.completed_km, 0.001 * len(self.routes))
        return {
            name: sum(route.infractions.count(name) for route in self.routes) / km
            for name in INFRACTIONS
        }

    @property
    def finished_frac(self) -> float:
        """Fraction of routes driven to their end."""
        finished = [not set(route.infractions) & set(ENDS) for route in self.routes]
        return sum(finished) / len(self.routes)

    def by_town(self) -> dict[str, EvalResult]:
        """The same scores for each town apart."""
        names = sorted({route.town for route in self.routes})
        return {
            name: EvalResult(tuple(route for route in self.routes if route.town == name))
            for name in names
        }

    def to_json(self) -> dict[str, Any]:
        """Summary and single routes, in values that JSON can hold."""
        score, completion = self.driving_score, self.completion
        return {
            "driving_score_mean": score[0],
            "driving_score_std": score[1],
            "route_completion_mean": completion[0],
            "route_completion_std": completion[1],
            "clean_completion_mean": self.clean_completion[0],
            "clean_completion_std": self.clean_completion[1],
            "finished_frac": self.finished_frac,
            "num_routes": len(self.routes),
            "completed_km": self.completed_km,
            "infractions_per_km": self.infractions_per_km,
            "routes": [
                {**dataclasses.asdict(route), "driving_score": route.driving_score}
                for route in self.routes
            ],
        }


def show(result: EvalResult, console: Console) -> None:
    """Prints the scores as two tables: by town, and infractions by kind."""
    towns = Table(title=f"{len(result.routes)} held-out routes, deterministic policy")
    columns = ("Driving Score", "route completion %", "before 1st infraction %", "finished %")
    for name in ("town", "routes", *columns):
        towns.add_column(name, justify="left" if name == "town" else "right")
    for town, part in {"all": result, **result.by_town()}.items():
        score, completion, clean = part.driving_score, part.completion, part.clean_completion
        towns.add_row(
            town,
            str(len(part.routes)),
            f"{score[0]:.1f} ± {score[1]:.1f}",
            f"{completion[0]:.1f} ± {completion[1]:.1f}",
            f"{clean[0]:.1f} ± {clean[1]:.1f}",
            f"{100 * part.finished_frac:.0f}",
        )
    rates = Table(title=f"infractions on {result.completed_km:.1f} km")
    for name in ("infraction", "factor", "per km"):
        rates.add_column(name, justify="left" if name == "infraction" else "right")
    for name, rate in result.infractions_per_km.items():
        factor = f"{FACTORS[name]:.2f}" if name in FACTORS else "ends the route"
        rates.add_row(name.replace("_", " "), factor, f"{rate:.3f}")
    console.print(towns, rates)


def _mean_and_std(values: Sequence[float]) -> tuple[float, float]:
    return float(np.mean(values)), float(np.std(values))
