"""Scenarios along a drawn route, about one every 100 m, by rejection. Host only.

For each stretch of the route the kinds are shuffled; each gets one try, at a place drawn uniformly
from the stretch, and the first that suits its place is taken. source: paper, Scenario Generation,
and the authors' generator.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from carljax.sim.route import Route
from carljax.sim.scenarios import registry
from carljax.sim.scenarios import site as site_module
from carljax.sim.scenarios.script import Scenario
from carljax.sim.scenarios.site import Site
from carljax.sim.town import Offsets, Town

SPACING = 100.0  # m. source: paper, Scenario Generation
START_ROOM = 20  # route points before the first trigger, so that the ego has set off. source: ours
END_ROOM = 60  # route points after the last trigger, in which it can play. source: ours
# m from the trigger to the junction, for kinds that need one: the ego is out of reach of what
# happens there, and comes while it happens. source: ours
JUNCTION_AHEAD = (30.0, 70.0)
AT_JUNCTION = frozenset(
    (
        "VehicleTurningRoute",
        "SignalizedJunctionLeftTurn",
        "SignalizedJunctionRightTurn",
        "NonSignalizedJunctionLeftTurn",
        "NonSignalizedJunctionRightTurn",
        "OppositeVehicleRunningRedLight",
    )
)


def place_along(
    town: Town,
    first: Offsets,
    route: Route,
    rng: np.random.Generator,
    spacing: float = SPACING,
    kinds: Sequence[str] = registry.KINDS,
) -> tuple[Scenario, ...]:
    """Draws the scenarios of a route.

    Args:
      town: where it is.
      first: where the town's rows begin in the shared tables.
      route: of NumPy arrays, in shared rows, a point a metre.
      rng: source of chance.
      spacing: m of route for each scenario, at most one in each stretch of that length.
      kinds: names from `registry.KINDS` to choose from.

    Returns:
      Scenarios without leading axes, in order of `arm_s`.
    """
    end = int(route.num_points) - END_ROOM
    begins = np.arange(0, max(end, 0), spacing)
    placed: list[Scenario] = []
    for begin, until in zip(begins, np.minimum(begins + spacing, end), strict=True):
        for name in rng.permutation(len(kinds)):
            index = int(rng.integers(int(begin), max(int(until), int(begin) + 1)))
            found = _try(kinds[name], Site(town, first, route, index), rng)
            if found is not None and not any(clash(found, other) for other in placed):
                placed.append(found)
                break
    return tuple(sorted(placed, key=lambda scenario: float(scenario.arm_s)))


def _try(kind: str, site: Site, rng: np.random.Generator) -> Scenario | None:
    """One try of one kind at one place."""
    if site.index < START_ROOM:
        return None
    if kind in AT_JUNCTION:
        crossing = site_module.next_junction(site)
        least, most = JUNCTION_AHEAD
        if crossing is None or not least <= crossing.entry_s - site.trigger_s <= most:
            return None
    return registry.place(kind, site, rng)


def clash(one: Scenario, other: Scenario) -> bool:
    """Whether two scenarios are in play at once while one holds lights or has cars on the lanes.

    So no scenario holds a junction that another uses, and no stream drives into another's cars.
    """
    together = one.arm_s <= other.end_s and other.arm_s <= one.end_s
    return bool(together and (_needs_road(one) or _needs_road(other)))


def _needs_road(scenario: Scenario) -> bool:
    return bool(scenario.held_junction >= 0 or (scenario.cars.model >= 0).any())
