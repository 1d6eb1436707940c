"""Where a scenario is to be placed: a town, a route and a point on it. Host only.

Lane and light rows are the town's own in here; `shared_lanes` and the like give those of the tables
that all towns share, as `Route` and `Scenario` hold them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import jax
import numpy as np

from carljax.sim import junctions
from carljax.sim.junctions import FREE
from carljax.sim.route import Route
from carljax.sim.scenarios import script
from carljax.sim.scenarios.script import WAY_LANES, Scenario
from carljax.sim.town import Offsets, Town

LOOK_AHEAD = 150  # route points ahead of a site in which its junction is looked for. source: ours
ARM_AHEAD = 20.0  # m before the trigger, where a scenario gets its slot. source: ours
# m between two centre lines of points 1 m apart where they cross or have merged. source: ours; two
# such lines that cross have points within sqrt(1/2) m of one another
MEET_GAP = 1.0


@dataclasses.dataclass(frozen=True)
class Site:
    """A place for a scenario.

    Attributes:
      town: the town, with its own row numbers.
      first: where its rows begin in the shared tables; `route` and `Scenario` use shared rows.
      route: of NumPy arrays, padded beyond `num_points`.
      index: route index of the trigger.
    """

    town: Town
    first: Offsets
    route: Route
    index: int

    @property
    def trigger_s(self) -> float:
        """Arc length of the trigger on the route, m."""
        return float(self.route.s[self.index])

    @property
    def length(self) -> float:
        """Length of the route, m."""
        return float(self.route.length)


@dataclasses.dataclass(frozen=True)
class Place:
    """A place on the route: route index, xy (2,) m, yaw rad, lane (town's row), lane_s m."""

    index: int
    xy: np.ndarray
    yaw: float
    lane: int
    lane_s: float


@dataclasses.dataclass(frozen=True)
class RouteJunction:
    """A junction that the route passes.

    Attributes:
      junction: its index in the town.
      entry: first route index in it.
      exit: first route index beyond it.
      entry_s, exit_s: m on the route.
      yaw: rad, direction of travel before it.
      turn: rad, change of direction through it, positive to the left.
      approach: lane from which the route enters.
      lanes: the route's lanes inside, in order.
    """

    junction: int
    entry: int
    exit: int
    entry_s: float
    exit_s: float
    yaw: float
    turn: float
    approach: int
    lanes: tuple[int, ...]

    @property
    def way(self) -> str:
        """Is it "left", "right" or "straight" on, by the rule of the route's commands."""
        if abs(self.turn) <= junctions.TURN_YAW:
            return "straight"
        return "left" if self.turn > 0.0 else "right"


@dataclasses.dataclass(frozen=True)
class Way:
    """A chain of lanes as one line.

    Attributes:
      lanes: the town's rows.
      xy: (n, 2) m.
      s: (n,) m from the beginning of the first lane.
      length: m.
    """

    lanes: tuple[int, ...]
    xy: np.ndarray
    s: np.ndarray
    length: float


def place_at(site: Site, s: float) -> Place:
    """The route point nearest to an arc length, clipped to the route."""
    num = int(site.route.num_points)
    index = int(np.searchsorted(site.route.s[:num], s))
    index = min(index, num - 1)
    if index > 0 and s - site.route.s[index - 1] < site.route.s[index] - s:
        index -= 1
    return Place(
        index=index,
        xy=np.asarray(site.route.xy[index], float),
        yaw=float(site.route.yaw[index]),
        lane=int(site.route.lane[index]) - site.first.lane,
        lane_s=float(site.route.lane_s[index]),
    )


def next_junction(site: Site) -> RouteJunction | None:
    """The first junction that the route enters after the trigger and also leaves, if it is near."""
    begin = site.index
    end = min(begin + LOOK_AHEAD, int(site.route.num_points))
    lane = np.asarray(site.route.lane[begin:end]) - site.first.lane
    junction = site.town.junctions.junction[lane]
    entries = np.flatnonzero((junction[1:] >= 0) & (junction[1:] != junction[:-1])) + 1
    if len(entries) == 0:
        return None
    entry = int(entries[0])
    left = np.flatnonzero(junction[entry:] != junction[entry])
    if len(left) == 0:
        return None
    leave = entry + int(left[0])
    yaw = np.unwrap(np.asarray(site.route.yaw[begin + entry - 1 : begin + leave + 1], float))
    inside = lane[entry:leave]
    return RouteJunction(
        junction=int(junction[entry]),
        entry=begin + entry,
        exit=begin + leave,
        entry_s=float(site.route.s[begin + entry]),
        exit_s=float(site.route.s[begin + leave]),
        yaw=float(yaw[0]),
        turn=float(yaw[-1] - yaw[0]),
        approach=int(lane[entry - 1]),
        lanes=tuple(inside[np.r_[True, inside[1:] != inside[:-1]]].tolist()),
    )


def conflicting_lanes(town: Town, lanes: Iterable[int]) -> list[int]:
    """Lanes of the same junction that cross or merge with one of these, in order of rows."""
    table = town.junctions
    found: set[int] = set()
    for lane in lanes:
        members = np.flatnonzero(table.junction == table.junction[lane])
        owes = table.conflict[lane, table.slot[members]]
        found.update(members[owes != FREE].tolist())
    return sorted(found)


def entering_lanes(town: Town, lanes: Iterable[int]) -> list[int]:
    """Those of these lanes that lead into their junction from outside."""
    junction = town.junctions.junction
    return [
        lane
        for lane in lanes
        if any(junction[before] != junction[lane] for before in town.lanes.predecessors[lane])
    ]


def arm(town: Town, lane: int, reach: float, most: int) -> tuple[int, ...]:
    """Lanes that lead up to a lane of a junction, in order of travel.

    Where it is shorter than wanted it goes on straight through the junctions before.

    Args:
      town: where.
      lane: in a junction.
      reach: m wanted.
      most: lanes.
    """
    found: list[int] = []
    length = 0.0
    while length < reach and len(found) < most:
        before = _straightest(town, found[0] if found else lane)
        if before < 0 or before in found:
            break
        found.insert(0, before)
        length += float(town.lanes.length[before])
    return tuple(found)


def _straightest(town: Town, lane: int) -> int:
    """The lane that leads into another with the least turn, -1 where all of them turn."""
    turns = {
        row: abs(junctions.turn(town.lanes, row))
        for row in town.lanes.predecessors[lane]
        if town.junctions.junction[row] < 0
        or abs(junctions.turn(town.lanes, row)) <= junctions.TURN_YAW
    }
    return min(turns, key=lambda row: (turns[row], row), default=-1)


def through(town: Town, lane: int) -> tuple[int, ...]:
    """A lane inside a junction and its first way on, to the first lane beyond the junction."""
    found = [lane]
    junction = town.junctions.junction
    while junction[found[-1]] == junction[lane]:
        onward = town.lanes.successors[found[-1]]
        onward = onward[onward >= 0]
        if len(onward) == 0 or int(onward[0]) in found:
            break
        found.append(int(onward[0]))
    return tuple(found)


def way(town: Town, lanes: Sequence[int]) -> Way:
    """Joins lanes that follow one another."""
    table = town.lanes
    begins = np.concatenate([[0.0], np.cumsum(table.length[list(lanes)])])
    xy = [table.point_xyz[table.points(lane), :2] for lane in lanes]
    s = [
        begin + np.linspace(0.0, table.length[lane], len(points))
        for begin, lane, points in zip(begins[:-1], lanes, xy, strict=True)
    ]
    return Way(tuple(lanes), np.concatenate(xy), np.concatenate(s), float(begins[-1]))


def lane_yaw(town: Town, lane: int) -> float:
    """Direction of travel at a lane's beginning, rad."""
    return float(town.lanes.point_yaw[town.lanes.start[lane]])


def meeting(site: Site, first: int, last: int, other: Way) -> tuple[float, float] | None:
    """Where the route, between two of its points, first meets another line.

    Args:
      site: of the route.
      first: route index.
      last: route index, included.
      other: crosses the route or merges with it.

    Returns:
      Arc length on the route and on the other line, m, of where they cross, or of where they have
      merged; None where they do not meet.
    """
    ours = np.asarray(site.route.xy[first : last + 1], float)
    gap = np.hypot(*(ours[:, None, :] - other.xy[None, :, :]).transpose(2, 0, 1))
    nearest = gap.min(axis=1)
    met = np.flatnonzero(nearest < MEET_GAP)
    if len(met) == 0:
        return None
    run = met[: 1 + int((np.diff(met, append=-1) != 1).argmax())]
    merged = run[-1] == last - first
    at = int(run[0] if merged else run[nearest[run].argmin()])
    return float(site.route.s[first + at]), float(other.s[int(gap[at].argmin())])


def light_of(town: Town, lanes: Iterable[int]) -> int:
    """The light that holds on the first of these lanes that has one; the town's row or -1."""
    rows = [int(town.lights.lane_light[lane]) for lane in lanes]
    return next((row for row in rows if row >= 0), -1)


def shared_lanes(site: Site, lanes: Sequence[int]) -> np.ndarray:
    """(WAY_LANES,) int32, lanes as rows of the shared table, as many as fit, -1 pads."""
    rows = np.full(WAY_LANES, -1, np.int32)
    kept = list(lanes)[:WAY_LANES]
    rows[: len(kept)] = np.asarray(kept, int) + site.first.lane
    return rows


def hold(site: Site, scenario: Scenario, junction: int, green: Sequence[int]) -> Scenario:
    """The scenario with the lights of a junction held: those rows green, the others red."""
    rows = np.full(2, -1, np.int32)
    shown = sorted(set(green))
    rows[: len(shown)] = np.array(shown, int) + site.first.light
    return scenario.replace(held_junction=np.int32(junction + site.first.junction), held_green=rows)


def blank(site: Site, end_s: float, timeout_s: float) -> Scenario:
    """A scenario without actors or effects, unbatched, triggered at the site.

    Args:
      site: its place.
      end_s: m on the route, where it is over; clipped to the route.
      timeout_s: s after which it is over all the same.

    Returns:
      NumPy arrays to fill in with `replace`; the arrays are its own.
    """
    empty = jax.tree.map(lambda rows: rows[0], script.nothing(1))
    return empty.replace(
        arm_s=np.float32(max(site.trigger_s - ARM_AHEAD, 0.0)),
        trigger_s=np.float32(site.trigger_s),
        end_s=np.float32(min(end_s, site.length)),
        timeout_s=np.float32(timeout_s),
    )
