"""Where a scenario is to be placed: a town, a route and a point on it. Host only."""

from __future__ import annotations

import dataclasses

import numpy as np

from carljax.sim.route import Route
from carljax.sim.town import Offsets, Town


@dataclasses.dataclass(frozen=True)
class Site:
    """A place for a scenario.

    Attributes:
      town: the town, with its own row numbers.
      first: where its rows begin in the shared tables; `route` and `Scenario` use shared rows.
      route: of NumPy arrays, padded beyond `num_points`.
      index: route index of the trigger.
    """

    town: Town
    first: Offsets
    route: Route
    index: int

    @property
    def trigger_s(self) -> float:
        """Arc length of the trigger on the route, m."""
        return float(np.asarray(self.route.s)[self.index])
