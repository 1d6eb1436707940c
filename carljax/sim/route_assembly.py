"""From stretches of lanes to a `Route`: points 1 m apart, stop lines, signs. Host only."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from carljax.sim.road_network import Lane
from carljax.sim.route import Route
from carljax.sim.town import Offsets, Town
from carljax.sim.types import STOP_NONE

START_SPEED_LIMIT = 30.0 / 3.6  # m/s, until the first sign. source: paper, Soft Penalties
SAME_SIGN = 3.0  # m of route within which a sign is passed once. source: ours

# What pads the fields of a route beyond its own rows; points repeat their last one.
_POINTS = ("xy", "yaw", "s", "lane", "lane_s", "speed_limit", "in_junction")
_STOPS = {
    "stop_idx": -1,
    "stop_xy": 0.0,
    "stop_yaw": 0.0,
    "stop_s": 0.0,
    "stop_kind": STOP_NONE,
    "stop_light": -1,
    "stop_width": 0.0,
}
_SIGNS = {"sign_xy": 0.0, "sign_idx": -1, "sign_limit": 0.0}


@dataclasses.dataclass(frozen=True)
class RouteSizes:
    """Fixed array sizes of a route.

    Attributes:
      num_points: R.
      num_stops: Q.
      num_signs: G.
    """

    num_points: int
    num_stops: int = 24
    num_signs: int = 24


@dataclasses.dataclass(frozen=True)
class Segment:
    """A stretch of a lane that a route takes.

    Attributes:
      lane: row in the town's lane table.
      start, end: m on it.
    """

    lane: int
    start: float
    end: float


def assemble(town: Town, first: Offsets, segments: Sequence[Segment]) -> Route:
    """Makes a route of stretches of lanes.

    Args:
      town: where.
      first: where its rows begin in the shared tables.
      segments: in order; each begins where a car goes on from the one before, straight on or one
        lane aside.

    Returns:
      A `Route` of NumPy arrays, as long as they need to be.
    """
    lane, lane_s = _sample(segments)
    pose = _poses(town, lane, lane_s)
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(pose[:, :2], axis=0).T))])
    table = town.lanes
    signs = _signs_on(town, segments, len(lane))
    fields: dict[str, Any] = {
        "xy": pose[:, :2],
        "yaw": pose[:, 2],
        "s": s,
        "lane": lane + first.lane,
        "lane_s": lane_s,
        "speed_limit": _limits(town, lane, signs),
        "in_junction": np.array([table.junction[row] is not None for row in lane]),
        "num_points": np.int32(len(lane)),
        "length": np.float32(s[-1]),
        "z": np.float32(table.point_xyz[table.start[lane[0]] + int(lane_s[0]), 2]),
        "town": np.int32(first.town),
        **_stop_fields(town, first, segments, s),
        "sign_xy": np.array([town.network.signals[i].xyz[:2] for _, i in signs]).reshape(-1, 2),
        "sign_idx": np.array([at for at, _ in signs], int),
        "sign_limit": np.array([town.network.signals[i].value for _, i in signs], float),
    }
    return Route(**{name: _narrow(value) for name, value in fields.items()})


def _narrow(values: np.ndarray) -> Any:
    """The same in the types of the device."""
    return values.astype({"f": np.float32, "i": np.int32, "b": bool}[values.dtype.kind])


def _stop_fields(
    town: Town, first: Offsets, segments: Sequence[Segment], s: np.ndarray
) -> dict[str, np.ndarray]:
    """The stop lines on the route, in order; s (R,) m is the arc length of its points."""
    table, light = town.lanes, town.lights.lane_light
    at, lane = _stops_on(town, segments, len(s))
    line = _poses(town, lane, table.stop_s[lane])
    return {
        "stop_idx": _first_after(at),
        "stop_xy": line[:, :2],
        "stop_yaw": line[:, 2],
        "stop_s": np.interp(at, np.arange(len(s)), s),
        "stop_kind": table.stop_kind[lane],
        "stop_light": np.where(light >= 0, light + first.light, -1)[lane],
        "stop_width": line[:, 3],
    }


def sizes_of(routes: Sequence[Route]) -> RouteSizes:
    """The least sizes into which all the routes fit."""
    return RouteSizes(
        num_points=max(len(route.s) for route in routes),
        num_stops=max(len(route.stop_idx) for route in routes),
        num_signs=max(len(route.sign_idx) for route in routes),
    )


def fits(route: Route, sizes: RouteSizes) -> bool:
    """Whether a route has no more points, stop lines and signs than there is room for."""
    own = sizes_of([route])
    return (
        own.num_points <= sizes.num_points
        and own.num_stops <= sizes.num_stops
        and own.num_signs <= sizes.num_signs
    )


def pad(route: Route, sizes: RouteSizes) -> Route:
    """Fills a route up to fixed sizes; it must fit."""

    def filled(values: np.ndarray, size: int, fill: np.ndarray) -> np.ndarray:
        more = np.broadcast_to(fill.astype(values.dtype), (size - len(values), *values.shape[1:]))
        return np.concatenate([values, more])

    fields = {
        x: filled(y := np.asarray(getattr(route, x)), sizes.num_points, y[-1]) for x in _POINTS
    }
    for fills, size in ((_STOPS, sizes.num_stops), (_SIGNS, sizes.num_signs)):
        for name, value in fills.items():
            fields[name] = filled(np.asarray(getattr(route, name)), size, np.array(value))
    return route.replace(**fields)


def trim(route: Route) -> Route:
    """Takes the padding off: the inverse of `pad`."""
    num = int(route.num_points)
    fields = {name: np.asarray(getattr(route, name))[:num] for name in _POINTS}
    for names, index in ((_STOPS, route.stop_idx), (_SIGNS, route.sign_idx)):
        fields |= {name: np.asarray(getattr(route, name))[: (index >= 0).sum()] for name in names}
    return route.replace(**fields)


def along(lane: Lane) -> np.ndarray:
    """Distance of each point of a lane from its first, m."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(lane.xyz[:, :2], axis=0).T))])


def beside(here: Lane, distance: float, there: Lane) -> float:
    """The distance along a neighbour at which a car is that changes to it.

    Args:
      here: a lane of the file.
      distance: m along it.
      there: a lane of the same section.

    Returns:
      m along `there`.
    """
    road_s = np.interp(distance, along(here), here.s)
    known, to = there.s, along(there)
    if known[-1] < known[0]:
        known, to = known[::-1], to[::-1]
    return float(np.interp(road_s, known, to))


def _sample(segments: Sequence[Segment]) -> tuple[np.ndarray, np.ndarray]:
    """Lane row and arc length every metre along the segments."""
    spans = np.array([seg.end - seg.start for seg in segments])
    ends = np.cumsum(spans)
    at = np.arange(int(np.floor(ends[-1] + 1e-6)) + 1, dtype=float)
    which = np.minimum(np.searchsorted(ends, at, side="right"), len(segments) - 1)
    lane = np.array([seg.lane for seg in segments])[which]
    start = np.array([seg.start for seg in segments])[which]
    return lane, start + at - (ends - spans)[which]


def _poses(town: Town, lane: np.ndarray, lane_s: np.ndarray) -> np.ndarray:
    """(n, 4): x, y (m), yaw (rad), lane width (m)."""
    table = town.lanes
    along = lane_s / table.length[lane] * (table.num_points[lane] - 1)
    first = np.clip(along.astype(int), 0, table.num_points[lane] - 2)
    frac = (along - first)[:, None]
    row = table.start[lane] + first
    xy = table.point_xyz[row, :2] * (1 - frac) + table.point_xyz[row + 1, :2] * frac
    turn = (table.point_yaw[row + 1] - table.point_yaw[row] + np.pi) % (2 * np.pi) - np.pi
    yaw = (table.point_yaw[row] + frac[:, 0] * turn + np.pi) % (2 * np.pi) - np.pi
    return np.column_stack([xy, yaw, table.point_width[row]])


def _passings(segments: Sequence[Segment], lane: int, s: float, num: int) -> list[float]:
    """Distances along the route, m, at which it passes a place of the table."""
    out, begun = [], 0.0
    for seg in segments:
        if seg.lane == lane and seg.start - 1e-6 <= s <= seg.end:
            out.append(begun + max(0.0, s - seg.start))
        begun += seg.end - seg.start
    return [at for at in out if _first_after(np.array(at)) < num]


def _first_after(distance: np.ndarray) -> np.ndarray:
    """Index of the first route point at or beyond a distance along the route, m."""
    return np.ceil(distance - 1e-6).astype(int)


def _stops_on(town: Town, segments: Sequence[Segment], num: int) -> tuple[np.ndarray, np.ndarray]:
    """Stop lines passed, in order: distance along the route, m, and row in the lane table.

    A lane entered beyond its line (start of the route, lane change) has no line on this route.
    """
    table = town.lanes
    passed = {
        (at, lane)
        for lane in {seg.lane for seg in segments}
        if table.stop_kind[lane] != STOP_NONE
        for at in _passings(segments, lane, float(table.stop_s[lane]), num)
    }
    ordered = sorted(passed)
    return np.array([at for at, _ in ordered]), np.array([lane for _, lane in ordered], int)


def _signs_on(town: Town, segments: Sequence[Segment], num: int) -> list[tuple[int, int]]:
    """(route index, index into `network.signals`) of each speed sign passed, in order."""
    on: list[tuple[int, int]] = []
    for number, signal in enumerate(town.network.signals):
        if signal.kind != "speed" or signal.value is None:
            continue
        places = [town.lanes.place(g.lane, g.distance) for g in signal.governed]
        passed = sorted(at for p in places for at in _passings(segments, p.lane, p.s, num))
        # One sign for several lanes is passed once, even by a route that changes lane beside it.
        first = [at for i, at in enumerate(passed) if i == 0 or at - passed[i - 1] > SAME_SIGN]
        on.extend((int(_first_after(np.array(at))), number) for at in first)
    return sorted(on)


def _limits(town: Town, lane: np.ndarray, signs: list[tuple[int, int]]) -> np.ndarray:
    """Speed limit at each route point, m/s."""
    if not any(s.kind == "speed" and s.value is not None for s in town.network.signals):
        return town.lanes.speed_limit[lane]
    limit = np.full(len(lane), START_SPEED_LIMIT)
    for at, number in signs:
        limit[at:] = town.network.signals[number].value
    return limit
