"""What is driven for a score: an environment with its routes, and what they are called."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from carljax import benchmark, build, leaderboard_routes, route_bank
from carljax.config import HELD_OUT_SEED, ConfigError, TrainConfig
from carljax.sim import journey as journey_module
from carljax.sim import town as town_module
from carljax.sim import towns
from carljax.sim.env import DrivingEnv, EnvConfig
from carljax.sim.journey import Journey
from carljax.sim.town import Town


@dataclasses.dataclass(frozen=True)
class Course:
    """Routes to be scored on.

    Attributes:
      title: what they are, for people.
      env: with the routes in its bank.
      towns: of the bank, in its order.
      route_ids: of the bank's routes.
    """

    title: str
    env: DrivingEnv
    towns: tuple[Town, ...]
    route_ids: tuple[str, ...]

    @property
    def town_of_route(self) -> np.ndarray:
        """(S,) int, place in `towns` of each route."""
        return np.asarray(self.env.bank.routes.town)[: len(self.route_ids)]

    @property
    def num_scenarios(self) -> np.ndarray:
        """(S,) int, scenarios placed on each route."""
        return (np.asarray(self.env.bank.scenarios.kind) >= 0).sum(axis=1)[: len(self.route_ids)]


def held_out(config: TrainConfig, towns: Sequence[Town], num_routes: int) -> Course:
    """Routes drawn with a seed that no training run may use, in the world of the training.

    Args:
      config: of the policy.
      towns: where to drive.
      num_routes: over all towns.

    Returns:
      The course, always the same one.
    """
    return Course(
        title=f"{num_routes} held-out routes",
        env=build.environment(config, towns, num_routes, HELD_OUT_SEED),
        towns=tuple(towns),
        route_ids=tuple(str(number) for number in range(num_routes)),
    )


def carljax_36(config: TrainConfig) -> Course:
    """The benchmark.

    Args:
      config: of the policy; gives what it sees.

    Returns:
      The course.
    """
    loaded = benchmark.load_towns()
    return _course(config, benchmark.NAME, loaded, benchmark.journeys(loaded))


def of_route_file(
    config: TrainConfig, path: Path, maps: Path, triggers: Path | None, yaws: Path | None
) -> Course:
    """The routes of a file of CARLA's leaderboard.

    Args:
      config: of the policy; gives what it sees.
      path: the routes.
      maps: folder with the towns.
      triggers: leaderboard 1.0's scenarios, for a file without any.
      yaws: the same routes in version 1, which has the waypoints' yaw.

    Returns:
      The course.

    Raises:
      RouteFileError: in one line, what is wrong with which file.
      MapError: a map can't be read.
    """
    loaded = leaderboard_routes.load(path, maps, triggers, yaws)
    return _course(config, path.name, loaded.towns, loaded.journeys, loaded.ids)


def of_bank(config: TrainConfig, path: Path, map_file: Path | None) -> Course:
    """The routes of a bank on disk.

    Args:
      config: of the policy; gives what it sees.
      path: the bank.
      map_file: its map; None for a bundled town.

    Returns:
      The course.

    Raises:
      BankError: it can't be read, or is of another map.
      ConfigError: its map is not known.
    """
    name = route_bank.read_origin(path).map_name
    if map_file is None and name not in towns.names():
        raise ConfigError(f"--routes {path}: is of the map {name}; give its file with --map")
    file = map_file or towns.path(name)
    loaded = [town_module.load(file)]
    (first,) = town_module.offsets(loaded)
    journeys = route_bank.load(path, loaded[0], file)
    shifted = [journey_module.shift(one, first) for one in journeys]
    return _course(config, path.name, loaded, shifted)


def _course(
    config: TrainConfig,
    title: str,
    loaded: Sequence[Town],
    journeys: Sequence[Journey],
    ids: Sequence[str] | None = None,
) -> Course:
    """A course in the world as it is by default, however much traffic a policy has learned in."""
    world = EnvConfig()
    same_for_all = dataclasses.replace(
        config.env,
        num_agents=world.num_agents,
        num_pedestrians=world.num_pedestrians,
        num_scenario_slots=world.num_scenario_slots,
    )
    config = dataclasses.replace(config, env=same_for_all)
    return Course(
        title=title,
        env=build.environment_on(config, loaded, journeys, HELD_OUT_SEED),
        towns=tuple(loaded),
        route_ids=tuple(ids or (str(number) for number in range(len(journeys)))),
    )
