"""Pads routes and what goes with them to size classes, so that others are no other program.

Host only; the towns are padded already (`road_map_padding`).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from carljax.sim import route, route_assembly
from carljax.sim.episodes import EpisodeBank
from carljax.sim.route import Route
from carljax.sim.route_assembly import RouteSizes
from carljax.sim.scenarios import script
from carljax.sim.scenarios.script import Scenario
from carljax.sim.size_class import SizeClass, repeat_last

EPISODES = SizeClass(1, steps=4)
SCENARIOS = SizeClass(16)  # of one route; as many as one every 100 m of a long one
ROUTE_POINTS = SizeClass(route.WINDOW, steps=4)
STOPS = SizeClass(RouteSizes.num_stops, steps=4)
SIGNS = SizeClass(RouteSizes.num_signs, steps=4)


def pad(bank: EpisodeBank) -> EpisodeBank:
    """Pads all that there is of each episode, and the episodes.

    Args:
      bank: as `episodes.populate` makes it.

    Returns:
      The same episodes. Unused rows repeat the last one and are never drawn, for `num_episodes` is
      how many there are.
    """
    routes, agents, walkers, scenarios = jax.tree.map(
        np.asarray, (bank.routes, bank.agents, bank.walkers, bank.scenarios)
    )
    return bank.replace(
        routes=_episodes(_routes(routes)),
        agents=_episodes(agents),
        walkers=_episodes(walkers),
        scenarios=_episodes(_scenarios(scenarios)),
    )


def _routes(routes: Route) -> Route:
    sizes = RouteSizes(
        num_points=ROUTE_POINTS.round_up(routes.s.shape[1]),
        num_stops=STOPS.round_up(routes.stop_idx.shape[1]),
        num_signs=SIGNS.round_up(routes.sign_idx.shape[1]),
    )
    each = [jax.tree.map(lambda x, i=i: x[i], routes) for i in range(len(routes.s))]
    return jax.tree.map(lambda *x: np.stack(x), *(route_assembly.pad(x, sizes) for x in each))


def _scenarios(scenarios: Scenario) -> Scenario:
    num, most = scenarios.kind.shape
    missing = SCENARIOS.round_up(most) - most

    def widen(values: np.ndarray, blank: np.ndarray) -> np.ndarray:
        blanks = np.broadcast_to(blank, (num, missing, *values.shape[2:]))
        return np.concatenate([values, blanks.astype(values.dtype)], axis=1)

    return jax.tree.map(widen, scenarios, script.nothing(1))


def _episodes(tree: Any) -> Any:
    return jax.tree.map(lambda x: jnp.asarray(repeat_last(x, EPISODES.round_up(len(x)))), tree)
