"""A route with the scenarios that happen on it, before it is put on the device. Host only."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from carljax.sim import route as route_module
from carljax.sim import route_assembly
from carljax.sim.route import Route
from carljax.sim.route_assembly import RouteSizes
from carljax.sim.scenarios import script
from carljax.sim.scenarios.script import Scenario
from carljax.sim.town import Offsets

ROUTE_SLACK = 7  # route points beyond the last


@dataclasses.dataclass(frozen=True)
class Journey:
    """One route and its scenarios, wherever they come from: drawn, a bank on disk, a route file.

    Attributes:
      route: NumPy arrays.
      scenarios: of NumPy arrays without leading axes, in order of `arm_s`.
    """

    route: Route
    scenarios: tuple[Scenario, ...] = ()


def shift(journey: Journey, first: Offsets) -> Journey:
    """Moves a journey in a town of its own into the tables that towns share.

    Args:
      journey: with the town's own row numbers.
      first: where the town's rows begin.

    Returns:
      The journey in shared rows.
    """

    def moved(index: Any, by: int) -> np.ndarray:
        return np.where(np.asarray(index) >= 0, index + np.int32(by), index)

    route = journey.route
    return Journey(
        route=route.replace(
            lane=moved(route.lane, first.lane),
            stop_light=moved(route.stop_light, first.light),
            town=np.int32(first.town),
        ),
        scenarios=tuple(
            scenario.replace(
                cars=scenario.cars.replace(lanes=moved(scenario.cars.lanes, first.lane)),
                held_junction=moved(scenario.held_junction, first.junction),
                held_green=moved(scenario.held_green, first.light),
            )
            for scenario in journey.scenarios
        ),
    )


def stack_routes(journeys: Sequence[Journey]) -> Route:
    """The routes with a leading axis S, padded to one size."""
    least = route_assembly.sizes_of([journey.route for journey in journeys])
    sizes = RouteSizes(
        num_points=max(least.num_points + ROUTE_SLACK, route_module.WINDOW),
        num_stops=max(least.num_stops, RouteSizes.num_stops),
        num_signs=max(least.num_signs, RouteSizes.num_signs),
    )
    routes = [route_assembly.pad(journey.route, sizes) for journey in journeys]
    return jax.tree.map(lambda *rows: np.stack(rows), *routes)


def stack_scenarios(journeys: Sequence[Journey]) -> Scenario:
    """The scenarios with leading axes S, E; E is the most that any journey has, and at least 1."""
    most = max(1, *(len(journey.scenarios) for journey in journeys))
    nothing = jax.tree.map(lambda rows: rows[0], script.nothing(1))

    def rows(journey: Journey) -> Scenario:
        filled = [*journey.scenarios, *[nothing] * (most - len(journey.scenarios))]
        return jax.tree.map(lambda blank, *x: np.stack(x).astype(blank.dtype), nothing, *filled)

    return jax.tree.map(lambda *x: np.stack(x), *(rows(journey) for journey in journeys))
