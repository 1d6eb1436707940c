"""The routes of a leaderboard file on the maps of a folder: journeys, and what became of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from carljax.sim import leaderboard_files, route_assembly, route_matching
from carljax.sim import town as town_module
from carljax.sim.journey import Journey
from carljax.sim.leaderboard_files import FileRoute, RouteFileError, Trigger
from carljax.sim.route_matching import MatchError
from carljax.sim.scenarios import from_file
from carljax.sim.scenarios.from_file import Placement, Stage
from carljax.sim.town import Offsets, Town

SEED = 0  # of what the files leave open: the parameters of their scenarios


@dataclasses.dataclass(frozen=True)
class LoadedRoutes:
    """Routes of a file, ready to be driven.

    Attributes:
      maps: the towns' files.
      towns: those that the file's routes are in.
      ids: of the routes, as in the file.
      journeys: in the tables that the towns share.
      placements: what became of each scenario.
    """

    maps: tuple[Path, ...]
    towns: tuple[Town, ...]
    ids: tuple[str, ...]
    journeys: tuple[Journey, ...]
    placements: tuple[Placement, ...]


def load(
    path: Path, maps: Path, triggers: Path | None = None, yaws: Path | None = None
) -> LoadedRoutes:
    """Reads a file of routes and puts them on their maps.

    Args:
      path: the routes, version 1 or 2.
      maps: folder with TOWN.xodr for every town that they name.
      triggers: leaderboard 1.0's file of triggers, for the routes that have no scenarios.
      yaws: the same routes in version 1, which has the waypoints' yaw.

    Returns:
      The routes.

    Raises:
      RouteFileError: in one line, what is wrong with which file.
      MapError: a map can't be read.
    """
    routes = leaderboard_files.read_routes(path)
    if yaws is not None:
        routes = leaderboard_files.with_yaws(routes, leaderboard_files.read_routes(yaws))
    of_town = leaderboard_files.read_triggers(triggers) if triggers is not None else {}
    names = list(dict.fromkeys(route.town for route in routes))
    files = [_map_file(path, maps, name, routes) for name in names]
    towns = [town_module.load(file) for file in files]
    journeys: list[Journey] = []
    placements: list[Placement] = []
    firsts = town_module.offsets(towns)
    for number, route in enumerate(routes):
        at = names.index(route.town)
        spare = of_town.get(route.town, [])
        journey, placed = _journey(path, towns[at], firsts[at], route, spare, (SEED, number))
        journeys.append(journey)
        placements.extend(placed)
    return LoadedRoutes(
        maps=tuple(files),
        towns=tuple(towns),
        ids=tuple(route.id for route in routes),
        journeys=tuple(journeys),
        placements=tuple(placements),
    )


def _map_file(path: Path, maps: Path, name: str, routes: Sequence[FileRoute]) -> Path:
    file = maps / f"{name}.xodr"
    if not file.is_file():
        first = next(route.id for route in routes if route.town == name)
        raise RouteFileError(f"{path}: route {first}: its map {file} is not there")
    return file


def _journey(
    path: Path,
    town: Town,
    first: Offsets,
    route: FileRoute,
    spare: Sequence[Trigger],
    seed: Sequence[int],
) -> tuple[Journey, tuple[Placement, ...]]:
    """One route of the file, and what became of its scenarios."""
    try:
        segments = route_matching.match(town, route.xy - town.offset, route.yaw)
    except MatchError as error:
        raise RouteFileError(f"{path}: route {route.id}: {error}") from None
    found = route_assembly.assemble(town, first, segments)
    stage = Stage(town, first, found, route.id)
    own: list[list[Trigger]] = [[trigger] for trigger in route.triggers]
    scenarios, placements = from_file.place_all(
        stage, own or from_file.on_route(stage, spare), seed
    )
    return Journey(found, scenarios), placements
