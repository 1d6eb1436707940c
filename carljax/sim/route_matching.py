"""From the sparse waypoints of a route to the lanes that join them. Host only.

Every waypoint may lie on several lanes, above all inside junctions, where they overlap. All that
are near enough and go the right way are kept, and the cheapest chain through the graph of the
file's lanes wins: the nearest lane of each waypoint alone would now and then lead round the block.
Cars may change lane outside junctions between neighbours that go the same way, whatever the paint
says: CARLA's routes do.
"""

from __future__ import annotations

import dataclasses
import heapq
import itertools
from collections.abc import Iterable, Sequence

import numpy as np
from scipy.spatial import cKDTree

from carljax.sim.road_network import RoadNetwork
from carljax.sim.route_assembly import Segment, along, beside
from carljax.sim.town import Town

# How far beside a lane's centre a waypoint may lie, m, and how far its yaw may differ, rad; the
# next pair only where no lane is within the one before. source: longest6, whose waypoints lie up to
# 1.6 m off and turn up to 45 degrees away; 40 degrees tell apart the lanes of a junction
REACH = ((1.6, np.radians(40.0)), (1.6, np.radians(60.0)), (5.0, np.radians(60.0)))
# The same for waypoints without yaw, by the lines from the last and to the next of them, from which
# a turn may lead far away.
CHORD_REACH = ((1.6, np.radians(90.0)), (1.6, np.pi), (5.0, np.pi))
CHANGE_COST = 10.0  # m of way that a lane change is worth. source: ours
CHANGES_MAX = 8  # in one section
CHANGE_ROOM = 20.0  # m; a change in less room than this costs more. source: ours
OFF_COST = 5.0  # m of way for each metre that a waypoint lies beside the lane. source: ours
MIN_WIDTH = 2.5  # m; lanes are entered from aside where a car fits
DETOUR = (3.0, 300.0)  # the longest way from one waypoint to the next: times the distance, plus m


class MatchError(ValueError):
    """Waypoints that no way along lanes joins: one line that names the waypoint."""


@dataclasses.dataclass(frozen=True)
class _Stop:
    """A waypoint on one of the lanes that it may lie on.

    Attributes:
      lane: index into `RoadNetwork.lanes`.
      distance: m along it.
      cost: m, for lying beside it.
    """

    lane: int
    distance: float
    cost: float


@dataclasses.dataclass(frozen=True)
class _Graph:
    """The driving lanes of a file.

    Attributes:
      network: as read.
      s: for each lane the distance of its points from its first, m.
      sides: for each lane the neighbours for which it may be left.
    """

    network: RoadNetwork
    s: list[np.ndarray]
    sides: list[list[int]]


def match(town: Town, xy: np.ndarray, yaw: np.ndarray | None) -> list[Segment]:
    """Finds the stretches of lanes that join waypoints in order.

    Args:
      town: where.
      xy: (n, 2) m, waypoints in the town's own coordinates.
      yaw: (n,) rad, direction of travel at each; None takes the lines between waypoints for it.

    Returns:
      The segments from the first waypoint to the last.

    Raises:
      MatchError: a waypoint is on no lane, or the next can't be reached without a great detour.
    """
    graph = _graph(town.network)
    stops = _stops(town.network, xy, yaw)
    cost = [[stop.cost for stop in stops[0]]]
    origin: list[list[int]] = []
    ways: list[dict[tuple[int, int], list[int]]] = []
    for i in range(1, len(xy)):
        reach = DETOUR[0] * float(np.hypot(*(xy[i] - xy[i - 1]))) + DETOUR[1]
        best = np.full(len(stops[i]), np.inf)
        came = [0] * len(stops[i])
        found: dict[tuple[int, int], list[int]] = {}
        for a, begin in enumerate(stops[i - 1]):
            for b, (way_cost, way) in _ways(graph, begin, stops[i], reach).items():
                found[a, b] = way
                total = cost[-1][a] + way_cost + stops[i][b].cost
                if total < best[b]:
                    best[b], came[b] = total, a
        if not np.isfinite(best).any():
            raise MatchError(
                f"waypoint {i} can't be reached from waypoint {i - 1} along lanes within "
                f"{reach:.0f} m"
            )
        cost.append(best.tolist())
        origin.append(came)
        ways.append(found)
    return _segments(town, graph, stops, _chain(cost, origin), ways)


def _chain(cost: list[list[float]], origin: list[list[int]]) -> list[int]:
    """Which candidate of each waypoint the cheapest chain takes."""
    chain = [int(np.argmin(cost[-1]))]
    for came in reversed(origin):
        chain.append(came[chain[-1]])
    return chain[::-1]


def _graph(network: RoadNetwork) -> _Graph:
    sides = []
    for lane in network.lanes:
        both = (
            (lane.left, lane.left_is_same_direction),
            (lane.right, lane.right_is_same_direction),
        )
        free = lane.kind == "driving" and lane.junction is None
        sides.append([side for side, same in both if free and same and side >= 0])
    return _Graph(network, [along(lane) for lane in network.lanes], sides)


def _change_cost(graph: _Graph, lane: int, changes: int, start: float, end: float) -> float:
    """What lane changes on the way to a lane cost, m, by their room: where the lane is wide."""
    if changes == 0:
        return 0.0
    s = graph.s[lane]
    wide = s[(graph.network.lanes[lane].width >= MIN_WIDTH) & (s >= start) & (s <= end)]
    room = float(np.ptp(wide)) if len(wide) else 0.0
    return changes * CHANGE_COST * (1.0 + changes * CHANGE_ROOM / max(room, 1.0))


def _stops(network: RoadNetwork, xy: np.ndarray, yaw: np.ndarray | None) -> list[list[_Stop]]:
    """The lanes that each waypoint may lie on."""
    driving = [i for i, lane in enumerate(network.lanes) if lane.kind == "driving"]
    points = np.concatenate([network.lanes[i].xyz[:, :2] for i in driving])
    owner = np.repeat(driving, [len(network.lanes[i].xyz) for i in driving])
    tree = cKDTree(points)
    # Points of a lane may lie far apart where it is straight.
    spacing = max(np.diff(along(network.lanes[i])).max(initial=0.0) for i in driving)
    chord = np.arctan2(*np.diff(xy, axis=0).T[::-1])
    out = []
    for i, at in enumerate(xy):
        near = sorted(set(owner[tree.query_ball_point(at, REACH[-1][0] + spacing)]))
        able = []
        for lane in near:
            distance, away, faces = _project(network, lane, at)
            goes = chord[max(i - 1, 0) : i + 1] if yaw is None else yaw[i : i + 1]
            turned = float(np.abs((goes - faces + np.pi) % (2 * np.pi) - np.pi).min())
            able.append((away, turned, _Stop(int(lane), distance, OFF_COST * away)))
        for reach, tolerance in CHORD_REACH if yaw is None else REACH:
            kept = [stop for away, turned, stop in able if away <= reach and turned <= tolerance]
            if kept:
                break
        else:
            raise MatchError(
                f"waypoint {i} is on no driving lane that goes its way within {REACH[-1][0]:g} m"
            )
        out.append(kept)
    return out


def _project(network: RoadNetwork, lane: int, xy: np.ndarray) -> tuple[float, float, float]:
    """A place on a lane's centre line: m along it, m from it, and the lane's yaw there."""
    there = network.lanes[lane]
    line, s = there.xyz[:, :2], along(there)
    piece = np.diff(line, axis=0)
    size = np.maximum((piece**2).sum(axis=1), 1e-12)
    frac = np.clip(((xy - line[:-1]) * piece).sum(axis=1) / size, 0.0, 1.0)
    away = np.hypot(*(line[:-1] + frac[:, None] * piece - xy).T)
    best = int(away.argmin())
    distance = s[best] + frac[best] * (s[best + 1] - s[best])
    yaw = float(np.interp(distance, s, np.unwrap(there.yaw)))
    return float(distance), float(away[best]), yaw


def _ways(
    graph: _Graph, begin: _Stop, ends: Sequence[_Stop], reach: float
) -> dict[int, tuple[float, list[int]]]:
    """Cheapest ways from a place to others: cost, m, and the lanes taken, by number in `ends`.

    A lane is a node; the way along it is paid for when it is left at its end, less what lay behind
    the place where the way began. Neighbours of the first lane share that beginning.
    """
    lanes = graph.network.lanes
    out: dict[int, tuple[float, list[int]]] = {}
    ties = itertools.count()  # first come, first served: of equal ways that with fewer changes
    first = _Visit(begin.lane, begin.distance, 0, None)
    heap: list[tuple[float, int, _Visit]] = [(0.0, next(ties), first)]
    # Changes are paid for when their section is left: the same lane after fewer is another node.
    seen: set[tuple[int, bool, int]] = set()
    while heap:
        cost, _, at = heapq.heappop(heap)
        node = (at.lane, at.since > 0.0, at.changes)
        if len(out) == len(ends) and cost >= max(price for price, _ in out.values()):
            break
        if node in seen or cost >= reach or at.changes > CHANGES_MAX:
            continue
        seen.add(node)
        for number, end in enumerate(ends):
            if end.lane == at.lane and end.distance >= at.since:
                price = cost + _paid(graph, at, end.distance)
                if price < out.get(number, (reach, []))[0]:
                    out[number] = price, at.way()
        onward = cost + _paid(graph, at, float(graph.s[at.lane][-1]))
        for to in lanes[at.lane].successors:
            heapq.heappush(heap, (onward, next(ties), _Visit(to, 0.0, 0, at)))
        for to in graph.sides[at.lane]:
            since = beside(lanes[at.lane], at.since, lanes[to])
            heapq.heappush(heap, (cost, next(ties), _Visit(to, since, at.changes + 1, at)))
    return out


@dataclasses.dataclass(frozen=True)
class _Visit:
    """A lane of a way in the search.

    Attributes:
      lane: index into `RoadNetwork.lanes`.
      since: m along it, where the way comes into its section.
      changes: lane changes in this section so far.
      before: the lane before it.
    """

    lane: int
    since: float
    changes: int
    before: _Visit | None

    def way(self) -> list[int]:
        """The lanes up to this one."""
        lanes = []
        visit: _Visit | None = self
        while visit is not None:
            lanes.append(visit.lane)
            visit = visit.before
        return lanes[::-1]


def _paid(graph: _Graph, at: _Visit, until: float) -> float:
    """What the way costs from where it comes into a section to a place on its lane, m."""
    way = max(until - at.since, 0.0)
    return way + _change_cost(graph, at.lane, at.changes, at.since, until)


def _segments(
    town: Town,
    graph: _Graph,
    stops: list[list[_Stop]],
    chain: list[int],
    ways: list[dict[tuple[int, int], list[int]]],
) -> list[Segment]:
    """The stretches of the lane table along the chosen ways."""
    pieces: list[tuple[int, float, float]] = []
    for i, found in enumerate(ways):
        begin, end = stops[i][chain[i]], stops[i + 1][chain[i + 1]]
        pieces += _pieces(graph, found[chain[i], chain[i + 1]], begin.distance, end.distance)
    out: list[Segment] = []
    for raw, start, until in pieces:
        place = town.lanes.place(raw, start)
        to = place.s + until - start
        last = out[-1] if out else None
        if last is not None and last.lane == place.lane and abs(last.end - place.s) < 1e-3:
            out[-1] = Segment(place.lane, last.start, to)
        else:
            out.append(Segment(place.lane, place.s, to))
    return [segment for segment in out if segment.end > segment.start] or out[:1]


def _pieces(
    graph: _Graph, way: list[int], start: float, end: float
) -> Iterable[tuple[int, float, float]]:
    """(lane of the file, m from, m to) along a way, its lane changes spread over their sections."""
    lanes = graph.network.lanes
    rest = list(way)
    while rest:
        # The lanes taken in one section: the first and those changed to.
        group = [rest.pop(0)]
        while rest and rest[0] not in lanes[group[-1]].successors:
            group.append(rest.pop(0))
        until = end if not rest else float(graph.s[group[-1]][-1])
        for number, lane in enumerate(group[:-1]):
            leave = _change_at(graph, group[number:], start, until)
            yield lane, start, leave
            start = beside(lanes[lane], leave, lanes[group[number + 1]])
        yield group[-1], start, max(start, until)
        start = 0.0


def _change_at(graph: _Graph, group: Sequence[int], start: float, until: float) -> float:
    """Where a lane is left for the next of a group: m along it, the room shared among changes."""
    here, there, goal = (graph.network.lanes[i] for i in (group[0], group[1], group[-1]))
    low = beside(here, start, there)
    high = max(low, beside(goal, until, there))
    s = graph.s[group[1]]
    wide = s[(there.width >= MIN_WIDTH) & (s >= low) & (s <= high)]
    if len(wide):
        low, high = float(wide[0]), float(wide[-1])
    return max(start, beside(there, low + (high - low) / len(group), here))
