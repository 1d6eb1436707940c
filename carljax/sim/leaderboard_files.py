"""Reads the route files of CARLA's leaderboards 1.0 and 2.0, and 1.0's file of triggers.

    routes = read_routes("longest6.xml")
    triggers = read_triggers("all_towns_traffic_scenarios_public.json")

CARLA's frame is left-handed: y and yaw change their sign here, once. Weather, heights and the
places of other actors are not read: this world is flat, always clear, and its scenarios choose
their actors' places by themselves. Source: the files themselves, and CARLA's documentation of
them.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import pathlib
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from carljax.sim import opendrive_xml as ox
from carljax.sim.opendrive_xml import Place
from carljax.sim.road_network import MapError

# The scenarios of leaderboard 1.0 by the names that 2.0 gave them; where there are several, the
# route's way through the junction decides. source: CARLA's documentation of both leaderboards
V1_TYPES = {
    "Scenario1": ("ControlLoss",),
    "Scenario3": ("DynamicObjectCrossing",),
    "Scenario4": ("VehicleTurningRoute",),
    "Scenario7": ("OppositeVehicleRunningRedLight",),
    "Scenario8": ("SignalizedJunctionLeftTurn",),
    "Scenario9": ("SignalizedJunctionRightTurn",),
    "Scenario10": ("NonSignalizedJunctionLeftTurn", "NonSignalizedJunctionRightTurn"),
}
SAME_WAYPOINT = 0.05  # m; the two versions of a route agree to the last digit


class RouteFileError(ValueError):
    """A route file that can't be used: one line that names file, place and reason."""


@dataclasses.dataclass(frozen=True)
class Trigger:
    """Where a scenario of a file begins.

    Attributes:
      type: as in the file.
      name: of this one scenario.
      xy: (2,) float64 m, right-handed, in the coordinates of the map's file.
      yaw: rad.
      parameters: names of values that the file gives besides; scenarios here draw their own.
    """

    type: str
    name: str
    xy: np.ndarray
    yaw: float
    parameters: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class FileRoute:
    """A route of a file: sparse waypoints, to be joined along lanes in order.

    Attributes:
      id: as in the file.
      town: name of its map.
      xy: (n, 2) float64 m, right-handed, in the coordinates of the map's file.
      yaw: (n,) float64 rad, direction of travel; None where the file has none (version 2).
      triggers: its scenarios, in the file's order.
    """

    id: str
    town: str
    xy: np.ndarray
    yaw: np.ndarray | None
    triggers: tuple[Trigger, ...]


def read_routes(path: str | os.PathLike[str]) -> list[FileRoute]:
    """Reads a file of routes, version 1 or 2.

    Args:
      path: the XML file.

    Returns:
      Its routes, in order.

    Raises:
      RouteFileError: in one line, what is wrong with the file and where.
    """
    path = pathlib.Path(path)
    file = Place(str(path))
    try:
        root = ox.parse(path, file, "routes")
        routes = [_route(element, file) for element in root.findall("route")]
        if not routes:
            raise file.error("has no routes")
        seen: set[str] = set()
        for route in routes:
            if route.id in seen:
                raise file.at("route", route.id).error("is there twice")
            seen.add(route.id)
    except MapError as error:
        raise RouteFileError(str(error)) from None
    return routes


def _route(element: ET.Element, file: Place) -> FileRoute:
    name = ox.text(element, "id", file.at("route"))
    place = file.at("route", name)
    town = ox.text(element, "town", place).rpartition("/")[2]
    first, second = element.findall("waypoint"), element.findall("waypoints/position")
    if first and second:
        raise place.error("has waypoints of version 1 and of version 2")
    points = first or second
    if len(points) < 2:
        raise place.error(f"has {len(points)} waypoints; it takes 2 to make a route")
    kind = "waypoint" if first else "position"
    at = [place.at(kind, i) for i in range(len(points))]
    yaw = None
    if first and any("yaw" in point.attrib for point in points):
        yaw = np.array([_yaw(point, where) for point, where in zip(points, at, strict=True)])
    return FileRoute(
        id=name,
        town=town.removesuffix("_Opt"),  # CARLA's towns in layers have the same roads
        xy=np.array([_xy(point, where) for point, where in zip(points, at, strict=True)]),
        yaw=yaw,
        triggers=tuple(_trigger(x, place) for x in element.findall("scenarios/scenario")),
    )


def _trigger(element: ET.Element, route: Place) -> Trigger:
    place = route.at("scenario", element.get("name", ""))
    kind = ox.text(element, "type", place)
    point = element.find("trigger_point")
    if point is None:
        raise place.error("has no trigger_point")
    where = place.at("trigger_point")
    return Trigger(
        type=kind,
        name=element.get("name", kind),
        xy=np.array(_xy(point, where)),
        yaw=_yaw(point, where),
        parameters=tuple(child.tag for child in element if child is not point),
    )


def _xy(element: ET.Element, place: Place) -> tuple[float, float]:
    return _number(element.get("x"), "x", place), -_number(element.get("y"), "y", place)


def _yaw(element: ET.Element, place: Place) -> float:
    return _to_yaw(_number(element.get("yaw"), "yaw", place))


def _to_yaw(degrees: float) -> float:
    """CARLA's yaw, clockwise and in degrees of any turn, as ours in [-pi, pi)."""
    return (math.radians(-degrees) + math.pi) % (2 * math.pi) - math.pi


def _number(raw: Any, name: str, place: Place) -> float:
    """A finite number, written as one or as text."""
    if raw is None:
        raise place.error(f"has no {name}")
    try:
        value = math.nan if isinstance(raw, bool) else float(raw)
    except (TypeError, ValueError):
        value = math.nan
    if not abs(value) <= ox.NUMBER_MAX:
        raise place.error(f"{name} {ox.shown(str(raw))} is not a number")
    return value


def read_triggers(path: str | os.PathLike[str]) -> dict[str, list[Trigger]]:
    """Reads leaderboard 1.0's file of triggers.

    Args:
      path: the JSON file.

    Returns:
      For each town its triggers, in the file's order.

    Raises:
      RouteFileError: in one line, what is wrong with the file and where.
    """
    file = Place(str(path))
    try:
        values = json.loads(pathlib.Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise RouteFileError(f"{file}: can't be read: {error.strerror or error}") from None
    except json.JSONDecodeError as error:
        raise RouteFileError(f"{path}:{error.lineno}: not JSON: {error.msg}") from None
    except (ValueError, RecursionError) as error:  # bytes that are no UTF-8, endless nesting
        raise RouteFileError(f"{file}: not JSON: {error}") from None
    out: dict[str, list[Trigger]] = {}
    try:
        for part in _items(values, "available_scenarios", file):
            for town in _object(part, file.at("available_scenarios")):
                place = file.at(str(town))
                for group in _items(part, town, file):
                    out.setdefault(str(town), []).extend(_group(group, place))
    except MapError as error:
        raise RouteFileError(str(error)) from None
    return out


def _group(group: Any, town: Place) -> Iterable[Trigger]:
    """The triggers of one type in one town."""
    kind = _object(group, town).get("scenario_type")
    if not isinstance(kind, str):
        raise town.error("an entry has no scenario_type")
    place = town.at(kind)
    for i, event in enumerate(_items(group, "available_event_configurations", place)):
        where = place.at("event", i)
        transform = _object(_object(event, where).get("transform"), where.at("transform"))
        x, y, yaw = (_number(transform.get(name), name, where) for name in ("x", "y", "yaw"))
        yield Trigger(kind, f"{kind}_{i}", np.array((x, -y)), _to_yaw(yaw))


def _object(value: Any, place: Place) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise place.error("is not an object")
    return value


def _items(value: Any, name: str, place: Place) -> list[Any]:
    items = _object(value, place).get(name)
    if not isinstance(items, list):
        raise place.error(f"{name} is not a list")
    return items


def with_yaws(routes: Sequence[FileRoute], others: Sequence[FileRoute]) -> list[FileRoute]:
    """Gives routes the yaw of their waypoints from another version of the same routes.

    Args:
      routes: some of them without yaw.
      others: where to look for the same waypoints.

    Returns:
      The routes; those that have yaw already, or no twin, as they are.
    """

    def twin_yaw(route: FileRoute) -> np.ndarray | None:
        for other in others:
            if other.yaw is None or other.town != route.town or other.xy.shape != route.xy.shape:
                continue
            if np.abs(other.xy - route.xy).max() < SAME_WAYPOINT:
                return other.yaw
        return None

    return [
        dataclasses.replace(route, yaw=twin_yaw(route)) if route.yaw is None else route
        for route in routes
    ]
