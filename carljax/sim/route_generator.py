"""Random routes through a town's lane graph. Host only.

A route starts at a random lane, goes forward in steps of 1 m, chooses uniformly at branches and
changes lane with 10 % probability per metre outside junctions, where the paint allows it, at most
once in 200 m. source: paper, Scenario Generation, and the authors' generator.
"""

from __future__ import annotations

import numpy as np

from carljax.sim import route_assembly
from carljax.sim.route import Route
from carljax.sim.route_assembly import RouteSizes, Segment
from carljax.sim.town import Offsets, Town

LANE_CHANGE_PROB = 0.10  # per metre. source: authors' generator
LANE_CHANGE_GAP = 200.0  # m. source: authors' generator
CHANGE_ROOM = 20.0  # m that a change keeps to the end of either lane. source: ours
START_MIN_WIDTH = 2.5  # m; a car can't be put on a lane narrower than that. source: ours
ATTEMPTS = 200


class RouteError(ValueError):
    """A town in which no route of the wanted length was found."""


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
        route = route_assembly.assemble(town, first, segments)
        if route_assembly.fits(route, sizes):
            return route_assembly.pad(route, sizes)
    raise RouteError(
        f"{town.network.name}: no route of {length:.0f} m found in {ATTEMPTS} attempts; "
        "the lane graph may be too small or full of dead ends"
    )


def _walk(town: Town, length: float, rng: np.random.Generator) -> list[Segment] | None:
    """Lanes and the part of each that is driven, or None at a dead end or a bad start."""
    table = town.lanes
    lane, s = _start(town, rng)
    if _width(town, lane, s) < START_MIN_WIDTH:
        return None
    segments: list[Segment] = []
    travelled = 0.0
    next_change = 0.0
    while True:
        ends = min(float(table.length[lane]), s + length - travelled)
        change = _lane_change(town, lane, s, ends, max(0.0, next_change - travelled), rng)
        if change is not None:
            leaves, lane_to, s_to = change
            segments.append(Segment(lane, s, leaves))
            travelled += leaves - s
            next_change = travelled + LANE_CHANGE_GAP
            lane, s = lane_to, s_to
            continue
        segments.append(Segment(lane, s, ends))
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


def _width(town: Town, lane: int, s: float) -> float:
    """Width of a lane at a place, m."""
    width = town.lanes.point_width[town.lanes.points(lane)]
    return float(np.interp(s, np.linspace(0.0, town.lanes.length[lane], len(width)), width))


def _lane_change(
    town: Town, lane: int, s: float, end: float, earliest: float, rng: np.random.Generator
) -> tuple[float, int, float] | None:
    """Where the route leaves this lane for a neighbour: (s, lane, s there), or None."""
    table = town.lanes
    if table.junction[lane] is not None:
        return None
    ahead = earliest + rng.geometric(LANE_CHANGE_PROB)
    if s + ahead > min(end, float(table.length[lane]) - CHANGE_ROOM):
        return None
    spacing = float(table.length[lane]) / (int(table.num_points[lane]) - 1)
    number = round((s + ahead) / spacing)
    point = int(table.start[lane]) + number
    both = (town.neighbours.left[point], town.neighbours.right[point])
    beside = [int(row) for row in both if row >= 0]
    if not beside:
        return None
    to = int(rng.choice(beside))
    lane_to = int(table.point_lane[to])
    step = float(table.length[lane_to]) / (int(table.num_points[lane_to]) - 1)
    # As far beyond that point as the place that is left lies beyond its own.
    s_to = (to - int(table.start[lane_to])) * step + (s + ahead - number * spacing)
    if s_to > float(table.length[lane_to]) - CHANGE_ROOM:
        return None
    return s + ahead, lane_to, max(s_to, 0.0)
