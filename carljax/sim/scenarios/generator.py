"""Scenarios along a drawn route, about one every 100 m, by rejection. Host only.

For each stretch of the route the kinds are shuffled; each gets one try, at a place drawn uniformly
from the stretch, and the first that suits its place is taken. source: paper, Scenario Generation,
and the authors' generator. Here kinds that few places suit go first: some other kind suits every
place, and in longest6 they are every other scenario.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from carljax.sim.route import Route
from carljax.sim.scenarios import registry
from carljax.sim.scenarios.script import DRIVE_LEGAL, Scenario
from carljax.sim.scenarios.site import Site
from carljax.sim.town import Offsets, Town
from carljax.sim.types import KIND_NONE

SPACING = 100.0  # m. source: paper, Scenario Generation
START_ROOM = 20  # route points before the first trigger, so that the ego has set off. source: ours
END_ROOM = 60  # route points after the last trigger, in which it can play. source: ours
JUNCTION_SIZE = 40.0  # m of route around a meeting that belong to its junction. source: ours
# Kinds that few places suit: they need a certain junction, and a certain way through it.
RARE = frozenset(
    (
        "SignalizedJunctionLeftTurn",
        "SignalizedJunctionRightTurn",
        "NonSignalizedJunctionLeftTurn",
        "NonSignalizedJunctionRightTurn",
        "OppositeVehicleRunningRedLight",
    )
)
AT_JUNCTION = RARE | {"VehicleTurningRoute"}


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
        for kind in _order(kinds, rng):
            index = int(rng.integers(int(begin), max(int(until), int(begin) + 1)))
            found = _try(kind, Site(town, first, route, index), rng)
            if found is not None and not any(clash(found, other) for other in placed):
                placed.append(found)
                break
    return tuple(sorted(placed, key=lambda scenario: float(scenario.arm_s)))


def _order(kinds: Sequence[str], rng: np.random.Generator) -> list[str]:
    """The kinds shuffled, rare ones first."""
    shuffled = [kinds[i] for i in rng.permutation(len(kinds))]
    return sorted(shuffled, key=lambda kind: kind not in RARE)


def _try(kind: str, site: Site, rng: np.random.Generator) -> Scenario | None:
    """One try of one kind at one place; kinds at junctions move their trigger somewhat."""
    found = registry.place(kind, site, rng)
    if found is None or found.trigger_s < site.route.s[START_ROOM]:
        return None
    return found


def clash(one: Scenario, other: Scenario) -> bool:
    """Whether one scenario gets in another's way.

    Two that hold lights or have cars that wait for nobody never play at once, and nobody stands or
    crosses where such cars meet the ego.
    """
    alone, other_alone = _needs_road(one), _needs_road(other)
    if alone and other_alone:
        return bool(one.trigger_s <= other.end_s and other.trigger_s <= one.end_s)
    return (alone and _stands_at(other, one)) or (other_alone and _stands_at(one, other))


def _needs_road(scenario: Scenario) -> bool:
    cars = scenario.cars
    is_lawless = (cars.model >= 0) & (cars.drive != DRIVE_LEGAL)
    return bool(scenario.held_junction >= 0 or is_lawless.any())


def _stands_at(scenario: Scenario, other: Scenario) -> bool:
    """Whether an actor off the lanes is to meet the ego near where the other's cars do."""
    meet_s = scenario.others.meet_s[scenario.others.kind != KIND_NONE]
    junction_s = other.cars.meet_s[other.cars.model >= 0]
    return bool((np.abs(meet_s[:, None] - junction_s) < JUNCTION_SIZE).any())
