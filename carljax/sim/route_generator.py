"""Random routes through a town's lane graph. Host only.

A route starts at a random lane, goes forward in steps of 1 m, chooses uniformly at branches and
changes lane with 10 % probability per metre outside junctions, at most once in 200 m. source:
paper, Scenario Generation, and the authors' generator.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from carljax.sim.route import Route
from carljax.sim.town import Offsets, Town
from carljax.sim.types import STOP_NONE

LANE_CHANGE_PROB = 0.10  # per metre. source: authors' generator
LANE_CHANGE_GAP = 200.0  # m. source: authors' generator
LANE_CHANGE_MIN_WIDTH = 2.5  # m; no change onto a lane that is about to end or has just begun
START_SPEED_LIMIT = 30.0 / 3.6  # m/s, until the first sign. source: paper, Soft Penalties
SAME_SIGN = 3.0  # m of route within which a sign is passed once. source: ours
ATTEMPTS = 200


class RouteError(ValueError):
    """A town in which no route of the wanted length was found."""


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


def draw(
    town: Town, first: Offsets, length: float, sizes: RouteSizes, rng: np.random.Generator
) -> Route:
    """Draws one route.

    Args:
      town: where.
      first: where its rows begin in the shared tables.
      length: m.
      sizes: array sizes; routes with more stop lines or signs are drawn again.
      rng: source of chance.

    Returns:
      A `Route` of NumPy arrays.

    Raises:
      RouteError: no attempt succeeded.
    """
    for _ in range(ATTEMPTS):
        segments = _walk(town, length, rng)
        if segments is None:
            continue
        route = _assemble(town, first, segments, sizes)
        if route is not None:
            return route
    raise RouteError(
        f"{town.network.name}: no route of {length:.0f} m found in {ATTEMPTS} attempts; "
        "the lane graph may be too small or full of dead ends"
    )


@dataclasses.dataclass(frozen=True)
class _Segment:
    lane: int
    start: float
    end: float


def _walk(town: Town, length: float, rng: np.random.Generator) -> list[_Segment] | None:
    """Lanes and the part of each that is driven, or None at a dead end."""
    table = town.lanes
    lane, s = _start(town, rng)
    segments: list[_Segment] = []
    travelled = 0.0
    next_change = 0.0
    while True:
        ends = min(float(table.length[lane]), s + length - travelled)
        change = _lane_change(town, lane, s, ends, max(0.0, next_change - travelled), rng)
        if change is not None:
            leaves, lane_to, s_to = change
            segments.append(_Segment(lane, s, leaves))
            travelled += leaves - s
            next_change = travelled + LANE_CHANGE_GAP
            lane, s = lane_to, s_to
            continue
        segments.append(_Segment(lane, s, ends))
        travelled += ends - s
        if travelled >= length - 1e-6:
            return segments
        following = table.successors[lane][table.successors[lane] >= 0]
        if len(following) == 0:
            return None
        lane, s = int(rng.choice(following)), 0.0


def _start(town: Town, rng: np.random.Generator) -> tuple[int, float]:
    """A place outside junctions; roads are drawn first, so that wide ones get no more starts."""
    table, lanes = town.lanes, town.network.lanes
    outside = [row for row, name in enumerate(table.junction) if name is None]
    roads: dict[str, list[int]] = {}
    for row in outside or range(len(table.length)):
        roads.setdefault(lanes[table.members[row][0]].road_id, []).append(row)
    road = sorted(roads)[int(rng.integers(len(roads)))]
    row = int(rng.choice(roads[road]))
    # Not on the last metres before a junction, where a car could not be brought to a halt.
    return row, float(rng.uniform(0.0, max(0.0, table.length[row] - 15.0)))


def _lane_change(
    town: Town, lane: int, s: float, end: float, earliest: float, rng: np.random.Generator
) -> tuple[float, int, float] | None:
    """Where the route leaves this lane for a neighbour: (s, lane, s there), or None."""
    table = town.lanes
    if table.junction[lane] is not None:
        return None
    ahead = earliest + rng.geometric(LANE_CHANGE_PROB)
    # A change needs room: not within the last 20 m before a lane's end.
    if s + ahead > min(end, float(table.length[lane]) - 20.0):
        return None
    raw, distance = _raw_place(town, lane, s + ahead)
    here = town.network.lanes[raw]
    sides = [
        side
        for side, same in (
            (here.left, here.left_is_same_direction),
            (here.right, here.right_is_same_direction),
        )
        if side >= 0 and same and table.raw_lane[side] != lane
    ]
    if not sides:
        return None
    side = int(rng.choice(sides))
    there = town.network.lanes[side]
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(there.xyz[:, :2], axis=0).T))])
    here_along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(here.xyz[:, :2], axis=0).T))])
    road_s = np.interp(distance, here_along, here.s)
    rising = there.s[-1] >= there.s[0]
    to = np.interp(road_s, there.s if rising else there.s[::-1], along if rising else along[::-1])
    if np.interp(to, along, there.width) < LANE_CHANGE_MIN_WIDTH:
        return None
    place = table.place(side, float(to))
    if place.s > table.length[place.lane] - 20.0:
        return None
    return s + ahead, place.lane, place.s


def _raw_place(town: Town, lane: int, s: float) -> tuple[int, float]:
    """The raw lane under a place of the table, and the distance along it."""
    members = town.lanes.members[lane]
    starts = town.lanes.raw_start[members]
    number = max(0, int(np.searchsorted(starts, s, side="right")) - 1)
    return members[number], s - float(starts[number])


def _assemble(
    town: Town, first: Offsets, segments: list[_Segment], sizes: RouteSizes
) -> Route | None:
    """Arrays of a route, or None where it has more stop lines or signs than there is room for."""
    lane, lane_s = _sample(segments, sizes.num_points)
    num = len(lane)
    pose = _poses(town, lane, lane_s)
    stops_at, stop_lane = _stops_on(town, segments, num)
    signs = _signs_on(town, segments, num)
    if len(stops_at) > sizes.num_stops or len(signs) > sizes.num_signs:
        return None
    table = town.lanes
    line = _poses(town, stop_lane, table.stop_s[stop_lane])
    step = np.hypot(*np.diff(pose[:, :2], axis=0).T)
    light = town.lights.lane_light
    light = np.where(light >= 0, light + first.light, -1)
    s = np.concatenate([[0.0], np.cumsum(step)])
    in_junction = np.array([table.junction[row] is not None for row in lane])

    def pad(values: np.ndarray, size: int, fill: float | None = None) -> np.ndarray:
        last = values[-1:] if fill is None else np.full((1, *values.shape[1:]), fill)
        return np.concatenate([values, np.repeat(last, size - len(values), axis=0)])

    # On the host: `episodes.make_bank` stacks the routes and puts them on the device.
    fields: dict[str, Any] = {
        "xy": pad(pose[:, :2], sizes.num_points).astype(np.float32),
        "yaw": pad(pose[:, 2], sizes.num_points).astype(np.float32),
        "s": pad(s, sizes.num_points).astype(np.float32),
        "lane": pad(lane + first.lane, sizes.num_points).astype(np.int32),
        "lane_s": pad(lane_s, sizes.num_points).astype(np.float32),
        "speed_limit": pad(_limits(town, lane, signs), sizes.num_points).astype(np.float32),
        "in_junction": pad(in_junction, sizes.num_points),
        "num_points": np.int32(num),
        "length": np.float32(s[-1]),
        "z": np.float32(table.point_xyz[table.start[lane[0]] + int(lane_s[0]), 2]),
        "town": np.int32(first.town),
        "stop_idx": pad(_first_after(stops_at), sizes.num_stops, -1).astype(np.int32),
        "stop_xy": pad(line[:, :2], sizes.num_stops, 0.0).astype(np.float32),
        "stop_yaw": pad(line[:, 2], sizes.num_stops, 0.0).astype(np.float32),
        "stop_s": pad(np.interp(stops_at, np.arange(num), s), sizes.num_stops, 0.0).astype(
            np.float32
        ),
        "stop_kind": pad(table.stop_kind[stop_lane], sizes.num_stops, STOP_NONE).astype(np.int32),
        "stop_light": pad(light[stop_lane], sizes.num_stops, -1).astype(np.int32),
        "stop_width": pad(line[:, 3], sizes.num_stops, 0.0).astype(np.float32),
        "sign_xy": pad(
            np.array([town.network.signals[i].xyz[:2] for _, i in signs]).reshape(-1, 2),
            sizes.num_signs,
            0.0,
        ).astype(np.float32),
        "sign_idx": pad(np.array([at for at, _ in signs], int), sizes.num_signs, -1).astype(
            np.int32
        ),
        "sign_limit": pad(
            np.array([town.network.signals[i].value for _, i in signs], float), sizes.num_signs, 0.0
        ).astype(np.float32),
    }
    return Route(**fields)


def _sample(segments: list[_Segment], most: int) -> tuple[np.ndarray, np.ndarray]:
    """Lane row and arc length every metre along the segments."""
    spans = np.array([seg.end - seg.start for seg in segments])
    ends = np.cumsum(spans)
    at = np.arange(min(most, int(np.floor(ends[-1] + 1e-6)) + 1), dtype=float)
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


def _passings(segments: list[_Segment], lane: int, s: float, num: int) -> list[float]:
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


def _stops_on(town: Town, segments: list[_Segment], num: int) -> tuple[np.ndarray, np.ndarray]:
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


def _signs_on(town: Town, segments: list[_Segment], num: int) -> list[tuple[int, int]]:
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
