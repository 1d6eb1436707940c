"""The kinds of scenarios by the names that CARLA's leaderboard gives them.

`Scenario.kind` is a place in `KINDS`. A kind is a module with a function `place(site, rng)` that
returns a `Scenario` of NumPy arrays without leading axes, its trigger at the site, or None where
the site does not suit it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from carljax.sim.scenarios import (
    control_loss,
    dynamic_object_crossing,
    hard_brake,
    non_signalized_left_turn,
    non_signalized_right_turn,
    opposite_vehicle_running_red_light,
    signalized_left_turn,
    signalized_right_turn,
    vehicle_turning,
)
from carljax.sim.scenarios.script import Scenario
from carljax.sim.scenarios.site import Site

Place = Callable[[Site, np.random.Generator], Scenario | None]

PLACE: dict[str, Place] = {
    "ControlLoss": control_loss.place,
    "HardBreakRoute": hard_brake.place,
    "DynamicObjectCrossing": dynamic_object_crossing.place,
    "VehicleTurningRoute": vehicle_turning.place,
    "SignalizedJunctionLeftTurn": signalized_left_turn.place,
    "SignalizedJunctionRightTurn": signalized_right_turn.place,
    "NonSignalizedJunctionLeftTurn": non_signalized_left_turn.place,
    "NonSignalizedJunctionRightTurn": non_signalized_right_turn.place,
    "OppositeVehicleRunningRedLight": opposite_vehicle_running_red_light.place,
}
KINDS = tuple(PLACE)


def place(kind: str, site: Site, rng: np.random.Generator) -> Scenario | None:
    """Places a scenario of a kind.

    Args:
      kind: one of `KINDS`.
      site: where.
      rng: source of chance.

    Returns:
      The scenario with its kind filled in, or None where the site does not suit it.
    """
    found = PLACE[kind](site, rng)
    return None if found is None else found.replace(kind=np.int32(KINDS.index(kind)))
