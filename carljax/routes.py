"""Routes with scenarios: `python -m carljax.routes make|info|draw|check`.

`make` draws a bank of them for a town, to train on with `--run.routes`; `info` and `draw` look at
it; `check` reads a leaderboard's route file onto its maps and says what became of every scenario.
What can't be read ends with one line on stderr and exit status 2, and nothing is written.
"""

from __future__ import annotations

import collections
import dataclasses
import io
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from carljax import atomic, leaderboard_routes, route_bank
from carljax.config import HELD_OUT_SEED
from carljax.leaderboard_routes import LoadedRoutes
from carljax.route_bank import BankError, Origin
from carljax.sim import town as town_module
from carljax.sim import towns
from carljax.sim.journey import Journey
from carljax.sim.leaderboard_files import RouteFileError
from carljax.sim.road_network import MapError
from carljax.sim.route_generator import RouteError
from carljax.sim.scenarios.from_file import Placement

LENGTH_RANGE = (200.0, 20_000.0)  # m; shorter is no route, longer is no episode
SPACING_MIN = 20.0  # m


class UsageError(ValueError):
    """Arguments that do not go together, in one line."""


@dataclasses.dataclass(frozen=True)
class Make:
    """Draw routes and scenarios for a town and write them to a bank.

    A bank that holds just that already is left as it is.
    """

    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT.npz")]
    map: Annotated[str, tyro.conf.arg(metavar="FILE.xodr")]
    """OpenDRIVE file, or the name of a bundled town."""
    num: int = 500
    """Number of routes."""
    # source: 500 attempts a town in the authors' generator
    seed: int = 0
    """Of all that is drawn."""
    length: float = 1000.0
    """Metres."""
    scenario_spacing: float = 100.0
    """Metres of route for each scenario; 0 for none."""
    # source of both: paper, Scenario Generation


@dataclasses.dataclass(frozen=True)
class Info:
    """Print what is in a bank."""

    bank: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="BANK.npz")]
    json: bool = False
    """Print JSON instead of a table."""


@dataclasses.dataclass(frozen=True)
class Draw:
    """Draw a route with its scenarios on its map."""

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="BANK.npz|ROUTES.xml")]
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT.png")]
    route: str = "0"
    """Its number in the bank, or its id in the route file."""
    map: Annotated[str | None, tyro.conf.arg(metavar="FILE.xodr")] = None
    """The bank's map; needed where that is no bundled town."""
    maps: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder with the maps of a route file."""
    triggers: Annotated[Path | None, tyro.conf.arg(metavar="FILE.json")] = None
    """Leaderboard 1.0's triggers, for a route file without scenarios."""
    pixels: int = 2400
    """The longer side of the picture."""


@dataclasses.dataclass(frozen=True)
class Check:
    """Put the routes of a leaderboard file on their maps and report on every scenario."""

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="ROUTES.xml")]
    maps: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder with TOWN.xodr for every town of the file."""
    triggers: Annotated[Path | None, tyro.conf.arg(metavar="FILE.json")] = None
    """Leaderboard 1.0's triggers, for the routes that have no scenarios of their own."""
    yaws: Annotated[Path | None, tyro.conf.arg(metavar="ROUTES.xml")] = None
    """The same routes in version 1, which has the waypoints' yaw."""
    json: bool = False
    """Print JSON instead of tables."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command.

    Args:
      argv: arguments; those of the process by default.

    Returns:
      Exit status: 2 after a mistake in what the user gave, said in one line.
    """
    command: Make | Info | Draw | Check = tyro.cli(
        Make | Info | Draw | Check,
        args=argv,
        prog="python -m carljax.routes",
        description=__doc__,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    try:
        if isinstance(command, Make):
            return make(command)
        if isinstance(command, Info):
            return info(command)
        if isinstance(command, Draw):
            return draw(command)
        return check(command)
    except (BankError, MapError, RouteError, RouteFileError, UsageError) as error:
        print(f"error: {error}", file=sys.stderr)
    except OSError as error:
        print(f"error: {error.filename}: {error.strerror}", file=sys.stderr)
    return 2


def make(command: Make) -> int:
    """Draws a bank, unless the file holds it already."""
    _check_make(command)
    map_file = _map_file(command.map)
    town = town_module.load(map_file)
    wanted = route_bank.origin(
        town, map_file, command.num, command.seed, command.length, command.scenario_spacing
    )
    if command.out.exists() and command.out.samefile(map_file):
        raise UsageError(f"{command.out}: is the map, won't overwrite it")
    if _holds(command.out, wanted):
        print(f"{command.out}: holds these routes already")
        return 0
    journeys = route_bank.make(town, wanted)
    route_bank.save(command.out, journeys, wanted)
    num = sum(len(journey.scenarios) for journey in journeys)
    print(f"{command.out}: {len(journeys)} routes with {num} scenarios in {wanted.map_name}")
    return 0


def _holds(path: Path, wanted: Origin) -> bool:
    """Whether a file is a bank of just these routes; anything else is written over."""
    try:
        return route_bank.read_origin(path) == wanted
    except BankError:
        return False


def _check_make(command: Make) -> None:
    if command.num < 1:
        raise UsageError(f"--num {command.num}: is below the least allowed, 1")
    if command.seed < 0 or command.seed == HELD_OUT_SEED:
        what = "is below 0" if command.seed < 0 else "is the seed of the routes for scoring"
        raise UsageError(f"--seed {command.seed}: {what}")
    if not LENGTH_RANGE[0] <= command.length <= LENGTH_RANGE[1]:
        low, high = LENGTH_RANGE
        raise UsageError(f"--length {command.length:g}: must be from {low:g} to {high:g} m")
    if command.scenario_spacing != 0 and not command.scenario_spacing >= SPACING_MIN:
        raise UsageError(
            f"--scenario-spacing {command.scenario_spacing:g}: must be 0 for no scenarios, or "
            f"{SPACING_MIN:g} m and more"
        )


def _map_file(name: str) -> Path:
    """The file of a map that is given by its path or by the name of a bundled town."""
    bundled = name in towns.names() and not Path(name).exists()
    path = towns.path(name) if bundled else Path(name)
    if not path.is_file():
        raise UsageError(f"{name}: is neither an OpenDRIVE file nor a bundled town")
    return path


def info(command: Info) -> int:
    """Prints what is in a bank."""
    summary = route_bank.summary(command.bank)
    if command.json:
        print(json.dumps(summary))
    else:
        for name, value in summary.items():
            print(f"{name:<32} {value}")
    return 0


def draw(command: Draw) -> int:
    """Draws a route."""
    from carljax import route_drawing  # matplotlib is slow to import, and only needed here

    if command.out.suffix.lower() not in route_drawing.SUFFIXES:
        suffixes = ", ".join(route_drawing.SUFFIXES)
        raise UsageError(f"{command.out}: is no picture's name; it must end in {suffixes}")
    if not 100 <= command.pixels <= 20000:
        raise UsageError(f"--pixels {command.pixels}: must be from 100 to 20000")
    is_bank = command.file.suffix != ".xml"
    town, journey = _of_bank(command) if is_bank else _of_file(command)
    picture = io.BytesIO()
    title = f"{command.file.name}, route {command.route}"
    route_drawing.save(town, journey, title, picture, command.out.suffix[1:], command.pixels)
    atomic.write_bytes(command.out, picture.getvalue())
    print(command.out)
    return 0


def _of_bank(command: Draw) -> tuple[town_module.Town, Journey]:
    """A route of a bank and its town."""
    if command.maps is not None or command.triggers is not None:
        raise UsageError("--maps and --triggers go with a route file, not with a bank")
    made = route_bank.read_origin(command.file)
    if command.map is None and made.map_name not in towns.names():
        raise UsageError(f"{command.file}: is of the map {made.map_name}; give its file with --map")
    map_file = _map_file(command.map or made.map_name)
    town = town_module.load(map_file)
    journeys = route_bank.load(command.file, town, map_file)
    if not command.route.isdecimal() or int(command.route) >= len(journeys):
        raise UsageError(
            f"--route {command.route}: {command.file} has routes 0 to {len(journeys) - 1}"
        )
    return town, journeys[int(command.route)]


def _of_file(command: Draw) -> tuple[town_module.Town, Journey]:
    """A route of a leaderboard file and its town."""
    if command.maps is None or command.map is not None:
        raise UsageError("a route file takes --maps DIR, and no --map")
    loaded = leaderboard_routes.load(command.file, command.maps, command.triggers)
    if command.route not in loaded.ids:
        raise UsageError(f"--route {command.route}: {command.file} has no such route")
    journey = loaded.journeys[loaded.ids.index(command.route)]
    return loaded.towns[int(journey.route.town)], journey


def check(command: Check) -> int:
    """Reports on a route file."""
    loaded = leaderboard_routes.load(command.file, command.maps, command.triggers, command.yaws)
    values = report(loaded)
    if command.json:
        print(json.dumps(values))
        return 0
    for row in values["routes"]:
        print(
            "route {id:>4}  {town:<8} {length_m:7.0f} m  {lane_changes:2d} lane changes  "
            "{placed:2d} of {scenarios:2d} scenarios".format(**row)
        )
    for row in values["scenarios"]:
        moved = "placed as {kind} at {trigger_m:.0f} m, {away_m:.1f} m from its trigger point"
        if not row["reason"] and row["parameters"]:
            moved += ", with draws of its own for {parameters}"
        fate = "not placed: {reason}" if row["reason"] else moved
        print(f"route {row['route']:>4}  {row['name']}: {fate.format(**row)}")
    total = values["routes"]
    placed, of = (sum(row[name] for row in total) for name in ("placed", "scenarios"))
    print(f"{len(total)} routes, {placed} of {of} scenarios placed")
    return 0


def report(loaded: LoadedRoutes) -> dict[str, Any]:
    """What became of the routes of a file and of their scenarios, as JSON takes it."""
    of: dict[str, list[Placement]] = collections.defaultdict(list)
    for placement in loaded.placements:
        of[placement.route].append(placement)
    rows = []
    for name, journey in zip(loaded.ids, loaded.journeys, strict=True):
        town = loaded.towns[int(journey.route.town)]
        rows.append(
            {
                "id": name,
                "town": town.network.name,
                "length_m": round(float(journey.route.length), 1),
                "lane_changes": _lane_changes(journey),
                "placed": len(journey.scenarios),
                "scenarios": len(of[name]),
            }
        )
    scenarios = [
        {
            "route": p.route,
            "name": p.name,
            "type": p.type,
            "kind": p.kind,
            "trigger_m": round(p.trigger_s, 1) if p.kind else None,
            "away_m": round(p.away, 1),
            "reason": p.reason,
            "parameters": ", ".join(p.parameters),
        }
        for p in loaded.placements
    ]
    return {"routes": rows, "scenarios": scenarios}


def _lane_changes(journey: Journey) -> int:
    """Points of a route that lie a lane aside of the one before: 1 m on and a lane's width off."""
    step = np.hypot(*np.diff(np.asarray(journey.route.xy, float), axis=0).T)
    return int((step > 2.0).sum())


if __name__ == "__main__":
    sys.exit(main())
