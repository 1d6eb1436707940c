"""The bank of episodes: routes and traffic made ahead, drawn from at every reset.

An episode is a route and the traffic at its start. The phase of the lights and every choice that
traffic makes later are drawn anew, so no two episodes on one episode are the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from carljax.sim import (
    crowd,
    pedestrians,
    road_map_builder,
    road_map_padding,
    route_generator,
    spawn,
    traffic,
)
from carljax.sim.journey import Journey, stack_routes, stack_scenarios
from carljax.sim.population import Population, nobody
from carljax.sim.road_map import RoadMap
from carljax.sim.route import Route
from carljax.sim.route_assembly import RouteSizes
from carljax.sim.scenarios import generator
from carljax.sim.scenarios.script import Scenario
from carljax.sim.town import Town, offsets
from carljax.sim.types import Agents, Walkers

TRAFFIC_RADIUS = 140.0  # m around the start, where traffic stands at first
EGO_CLEARANCE = 18.0  # m kept free around the start
_AT_START = 1  # keeps the draws of who is there at the start apart from those of the journey


_initial = jax.jit(jax.vmap(traffic.initial, in_axes=(0, 0, 0, None, 0)))
_bodies = jax.jit(jax.vmap(pedestrians.initial, in_axes=(0, None)))


class EpisodeBank(struct.PyTreeNode):
    """All that stays the same while training: held once per device.

    Attributes:
      road_map: the towns, padded to size classes (`road_map_padding`).
      routes: `Route` with a leading axis S.
      agents: `Agents` at the start, with a leading axis S.
      walkers: `Walkers` at the start, with a leading axis S.
      scenarios: `Scenario` with leading axes S, E, in order along each route.
      num_episodes: () int32, how many of the S rows are episodes; the others are padding.
    """

    road_map: RoadMap
    routes: Route
    agents: Agents
    walkers: Walkers
    scenarios: Scenario
    num_episodes: jax.Array


def make_bank(
    towns: Sequence[Town],
    num_episodes: int,
    population: Population,
    seed: int,
    route_length: float = 1000.0,
    scenario_spacing: float | None = None,
) -> EpisodeBank:
    """Draws episodes, the same number in every town (as evenly as it goes).

    Args:
      towns: at least one.
      num_episodes: S.
      population: how many of each kind of road user there is room for.
      seed: of everything drawn; other seeds give other routes.
      route_length: m.
      scenario_spacing: m of route for each scenario; None or 0 for none.

    Returns:
      The bank.

    Raises:
      RouteError: a town has no route of that length.
    """
    journeys = draw_journeys(towns, num_episodes, seed, route_length, scenario_spacing)
    return populate(towns, journeys, population, seed)


def draw_journeys(
    towns: Sequence[Town],
    num: int,
    seed: int,
    route_length: float,
    scenario_spacing: float | None,
) -> list[Journey]:
    """Draws routes and what happens on them, town by town in turn.

    Args:
      towns: at least one.
      num: how many.
      seed: see `make_bank`.
      route_length: m.
      scenario_spacing: see `make_bank`.

    Returns:
      The journeys, in the tables that the towns share.

    Raises:
      RouteError: a town has no route of that length.
    """
    sizes = RouteSizes(num_points=int(route_length) + 1)
    firsts = offsets(towns)
    journeys = []
    for number in range(num):
        town = number % len(towns)
        rng = np.random.default_rng([seed, number])
        there, first = towns[town], firsts[town]
        route = route_generator.draw(there, first, route_length, sizes, rng)
        if scenario_spacing:
            scenarios = generator.place_along(there, first, route, rng, scenario_spacing)
            journeys.append(Journey(route, scenarios))
        else:
            journeys.append(Journey(route))
    return journeys


def populate(
    towns: Sequence[Town], journeys: Sequence[Journey], population: Population, seed: int
) -> EpisodeBank:
    """Puts journeys and towns on the device and traffic at the start of each journey.

    Args:
      towns: at least one.
      journeys: S, in the tables that the towns share.
      population: how many of each kind of road user there is room for.
      seed: of who is there at the start.

    Returns:
      The bank.
    """
    found = [spawn.places(town.lanes) for town in towns]
    firsts = offsets(towns)
    agents, crowds = [], []
    for number, journey in enumerate(journeys):
        town = int(journey.route.town)
        rng = np.random.default_rng([seed, number, _AT_START])
        first_lane, most = firsts[town].lane, population.num_traffic
        agents.append(_traffic(towns[town], found[town], first_lane, journey.route, most, rng))
        start, num_walkers = np.asarray(journey.route.xy[0]), population.num_walkers
        crowds.append(crowd.draw(towns[town].walks, firsts[town].walk, start, num_walkers, rng))
    lane, s, speed = (np.stack(values) for values in zip(*agents, strict=True))
    road_map = road_map_padding.pad(road_map_builder.build(towns))
    num = len(journeys)
    cars = _initial(
        jnp.asarray(lane, jnp.int32),
        jnp.asarray(s, jnp.float32),
        jnp.asarray(speed, jnp.float32),
        road_map,
        jax.random.split(jax.random.key(seed), num),
    )
    walkers = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *crowds)
    num_rest = population.num_agents - population.num_traffic - population.num_walkers
    parts = cars, _repeat(nobody(num_rest), num), _bodies(walkers, road_map)
    return EpisodeBank(
        road_map=road_map,
        routes=jax.tree.map(jnp.asarray, stack_routes(journeys)),
        agents=jax.tree.map(lambda *x: jnp.concatenate(x, axis=1), *parts),
        walkers=walkers,
        scenarios=jax.tree.map(jnp.asarray, stack_scenarios(journeys)),
        num_episodes=jnp.int32(num),
    )


def _repeat(rows: Any, num: int) -> Any:
    """The same rows for every episode."""
    return jax.tree.map(lambda x: jnp.repeat(jnp.asarray(x)[None], num, axis=0), rows)


def _traffic(
    town: Town,
    found: spawn.Places,
    first_lane: int,
    route: Route,
    num_agents: int,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where traffic stands at the start: lane (N,), s (N,) m, speed (N,) m/s."""
    away = np.hypot(*(found.xy - route.xy[0]).T)
    free = np.flatnonzero((away > EGO_CLEARANCE) & (away < TRAFFIC_RADIUS))
    # From quiet streets to as many cars as there is room for.
    most = int(rng.integers(num_agents // 4, num_agents + 1))
    chosen = rng.permutation(free)[:most]
    lane = np.full(num_agents, -1)
    s, speed = np.zeros(num_agents), np.zeros(num_agents)
    lane[: len(chosen)] = found.lane[chosen]
    s[: len(chosen)] = found.s[chosen]
    for i in range(len(chosen)):
        # Slow enough to stop behind the car in front or before the lane's end.
        ahead = s[(lane == lane[i]) & (s > s[i])]
        gap = min(ahead.min(initial=np.inf) - 6.0, town.lanes.length[lane[i]] - 3.0) - s[i]
        limit = min(town.lanes.speed_limit[lane[i]], town.lanes.curve_speed[lane[i]])
        speed[i] = min(0.9 * limit, np.sqrt(2.0 * 2.0 * max(gap, 0.0)))
    lane[: len(chosen)] += first_lane
    return lane, s, speed
