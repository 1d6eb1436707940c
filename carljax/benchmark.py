"""carljax-36: the 36 routes on which policies and planners are compared on every machine.

Like CARLA's longest6 in numbers: 1 to 2 km each, with 5 to 21 scenarios. They lie in the bundled
towns, those kept for scoring among them, and are drawn from a seed that no training run may use.
Everything that they depend on stands here.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from carljax.config import HELD_OUT_SEED
from carljax.sim import route_generator, towns
from carljax.sim import town as town_module
from carljax.sim.journey import Journey
from carljax.sim.route_assembly import RouteSizes, trim
from carljax.sim.route_generator import RouteError
from carljax.sim.scenarios import generator
from carljax.sim.town import Town

NAME = "carljax-36"
NUM_ROUTES = 36  # source: longest6
LENGTH = (1000.0, 2000.0)  # m, drawn uniformly. source: longest6
NUM_SCENARIOS = (5, 21)  # a route with fewer or more is drawn again. source: longest6
SPACING = 100.0  # m of route for each scenario. source: paper, Scenario Generation
# source: paper, the seven of longest6; ours, the two at junctions without lights
KINDS = (
    "ControlLoss",
    "HardBreakRoute",
    "DynamicObjectCrossing",
    "VehicleTurningRoute",
    "SignalizedJunctionLeftTurn",
    "SignalizedJunctionRightTurn",
    "OppositeVehicleRunningRedLight",
    "NonSignalizedJunctionLeftTurn",
    "NonSignalizedJunctionRightTurn",
)
ATTEMPTS = 50


def town_names() -> tuple[str, ...]:
    """The bundled towns in which it lies, in order: route i is in town i modulo their number."""
    return towns.TRAINING + towns.HELD_OUT


def load_towns() -> list[Town]:
    """Its towns, in order."""
    return [town_module.load(towns.path(name)) for name in town_names()]


def journeys(loaded: Sequence[Town]) -> list[Journey]:
    """Draws its routes and scenarios, always the same ones.

    Args:
      loaded: what `load_towns` returns.

    Returns:
      NUM_ROUTES journeys, in the tables that the towns share.
    """
    firsts = town_module.offsets(loaded)
    places = [number % len(loaded) for number in range(NUM_ROUTES)]
    return [_journey(loaded[at], firsts[at], number) for number, at in enumerate(places)]


def _journey(town: Town, first: town_module.Offsets, number: int) -> Journey:
    # The last number keeps these draws apart from all others made of the same seed.
    rng = np.random.default_rng([HELD_OUT_SEED, number, NUM_ROUTES])
    length = float(rng.uniform(*LENGTH))
    sizes = RouteSizes(num_points=int(length) + 1, num_stops=int(length), num_signs=int(length))
    for _ in range(ATTEMPTS):
        route = trim(route_generator.draw(town, first, length, sizes, rng))
        scenarios = generator.place_along(town, first, route, rng, SPACING, KINDS)
        if NUM_SCENARIOS[0] <= len(scenarios) <= NUM_SCENARIOS[1]:
            return Journey(route, scenarios)
    raise RouteError(
        f"{town.network.name}: no route of {length:.0f} m with {NUM_SCENARIOS[0]} to "
        f"{NUM_SCENARIOS[1]} scenarios in {ATTEMPTS} attempts"
    )
