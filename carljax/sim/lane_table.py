"""Driving lanes of one town: joined, evenly resampled, with their stop lines. Host only."""

from __future__ import annotations

import dataclasses

import numpy as np

from carljax.sim.road_network import Lane, RoadNetwork
from carljax.sim.types import STOP_LIGHT, STOP_NONE, STOP_SIGN, STOP_YIELD

POINT_SPACING = 1.0  # m
LATERAL_ACCEL = 2.5  # m/s^2 in bends. source: ours, a comfortable value for traffic
DEFAULT_SPEED_LIMIT = (
    50.0 / 3.6
)  # m/s, for lanes of files that give none: built-up areas in most of Europe
CURVE_BRAKING = 1.5  # m/s^2 towards a bend. source: ours
MIN_LENGTH = 1e-3  # m
DRIVABLE_WIDTH = 2.5  # m, less is too narrow for a car. source: ours

_STOP_KINDS = {"light": STOP_LIGHT, "stop": STOP_SIGN, "yield": STOP_YIELD}
# Where a lane has several signals the first of these holds.
_STOP_RANK = {STOP_LIGHT: 0, STOP_SIGN: 1, STOP_YIELD: 2, STOP_NONE: 3}


@dataclasses.dataclass(frozen=True)
class Place:
    """A place on a lane of the table: row and arc length, m."""

    lane: int
    s: float


@dataclasses.dataclass(frozen=True)
class LaneTable:
    """Lanes of one town, NumPy float64; fields as in `RoadMap`.

    Attributes:
      members: for each lane the raw lanes it joins, indices into `RoadNetwork.lanes`.
      raw_lane: row of each raw lane in this table, -1 for lanes that aren't driven.
      raw_start: (raw,) where each raw lane begins on its row, m.
      end: (K,) m, to where it is wide enough to drive on: less than its length only where it tapers
        to an end.
      stop_signal: id of the signal that holds at the lane's stop line, "" for none.
    """

    members: list[list[int]]
    raw_lane: np.ndarray
    raw_start: np.ndarray
    length: np.ndarray
    end: np.ndarray
    num_points: np.ndarray
    start: np.ndarray
    speed_limit: np.ndarray
    curve_speed: np.ndarray
    successors: np.ndarray
    predecessors: list[list[int]]
    junction: list[str | None]
    stop_s: np.ndarray
    stop_kind: np.ndarray
    stop_signal: list[str]
    point_xyz: np.ndarray
    point_yaw: np.ndarray
    point_width: np.ndarray
    point_speed: np.ndarray
    point_lane: np.ndarray

    def place(self, raw: int, distance: float) -> Place:
        """Where a distance along a raw lane lies in the table."""
        lane = int(self.raw_lane[raw])
        return Place(lane, float(np.clip(self.raw_start[raw] + distance, 0.0, self.length[lane])))

    def points(self, lane: int) -> slice:
        """Rows of a lane in the point table."""
        return slice(int(self.start[lane]), int(self.start[lane] + self.num_points[lane]))


def build(network: RoadNetwork) -> LaneTable:
    """Makes the lane table of one town.

    Args:
      network: as read; at least one driving lane.

    Returns:
      The table; lanes are the maximal chains of driving lanes with a single way on.
    """
    stops = _stops(network)
    chains = _chains(network, stops)
    raw_lane = np.full(len(network.lanes), -1)
    raw_start = np.zeros(len(network.lanes))
    resampled = []
    for row, chain in enumerate(chains):
        offset = 0.0
        for raw in chain:
            raw_lane[raw], raw_start[raw] = row, offset
            offset += _length(network.lanes[raw])
        resampled.append(_resample([network.lanes[raw] for raw in chain]))
    num_points = np.array([len(xyz) for xyz, _, _, _ in resampled])
    length = np.array([length for _, _, _, length in resampled])
    stop_s, stop_kind, stop_signal = _chain_stops(chains, stops, raw_start)
    lanes = network.lanes
    return LaneTable(
        members=chains,
        raw_lane=raw_lane,
        raw_start=raw_start,
        length=length,
        end=np.array([_end(chain, lanes, r) for chain, r in zip(chains, resampled, strict=True)]),
        num_points=num_points,
        start=np.concatenate([[0], np.cumsum(num_points)[:-1]]),
        speed_limit=np.array([lanes[c[0]].speed_limit or DEFAULT_SPEED_LIMIT for c in chains]),
        curve_speed=np.array([_curve_speed(yaw, size).min() for _, yaw, _, size in resampled]),
        successors=_successors(network, chains, raw_lane),
        predecessors=[sorted({int(raw_lane[p]) for p in lanes[c[0]].predecessors}) for c in chains],
        junction=[lanes[c[0]].junction for c in chains],
        stop_s=stop_s,
        stop_kind=stop_kind,
        stop_signal=stop_signal,
        point_xyz=np.concatenate([xyz for xyz, _, _, _ in resampled]),
        point_yaw=np.concatenate([yaw for _, yaw, _, _ in resampled]),
        point_width=np.concatenate([width for _, _, width, _ in resampled]),
        point_speed=np.concatenate([_speed_profile(yaw, size) for _, yaw, _, size in resampled]),
        point_lane=np.repeat(np.arange(len(chains)), num_points),
    )


def _length(lane: Lane) -> float:
    return float(np.hypot(*np.diff(lane.xyz[:, :2], axis=0).T).sum())


def _stops(network: RoadNetwork) -> dict[int, tuple[int, float, str]]:
    """Stop line of each raw lane: kind, distance along it (m) and signal id."""
    stops: dict[int, tuple[int, float, str]] = {}
    for signal in network.signals:
        kind = _STOP_KINDS.get(signal.kind, STOP_NONE)
        if kind == STOP_NONE:
            continue
        for governed in signal.governed:
            held = stops.get(governed.lane)
            if held is None or _STOP_RANK[kind] < _STOP_RANK[held[0]]:
                # Inside a junction cars wait before it, wherever along the lane the post stands.
                inside = network.lanes[governed.lane].junction is not None
                stops[governed.lane] = (kind, 0.0 if inside else governed.distance, signal.id)
    return stops


def _chains(network: RoadNetwork, stops: dict[int, tuple[int, float, str]]) -> list[list[int]]:
    lanes = network.lanes
    driving = [i for i, lane in enumerate(lanes) if lane.kind == "driving"]

    def joins(a: int) -> int | None:
        if len(lanes[a].successors) != 1:
            return None
        b = lanes[a].successors[0]
        same = (
            lanes[a].junction == lanes[b].junction and lanes[a].speed_limit == lanes[b].speed_limit
        )
        alone = len(lanes[b].predecessors) == 1 and not (a in stops and b in stops)
        return b if same and alone and b != a else None

    follower = {a: joins(a) for a in driving}
    entered = {b for b in follower.values() if b is not None}
    chains, seen = [], set()
    # Chain heads first; what is left after them are closed loops, cut anywhere.
    for head in [a for a in driving if a not in entered] + driving:
        if head in seen:
            continue
        chain: list[int] = []
        link: int | None = head
        num_stops = 0
        while link is not None and link not in seen:
            num_stops += link in stops
            if num_stops > 1:
                break
            seen.add(link)
            chain.append(link)
            link = follower[link]
        chains.append(chain)
    return chains


def _resample(lanes: list[Lane]) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    xyz = np.concatenate([lane.xyz for lane in lanes])
    yaw = np.unwrap(np.concatenate([lane.yaw for lane in lanes]))
    width = np.concatenate([lane.width for lane in lanes])
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xyz[:, :2], axis=0).T))])
    length = max(float(s[-1]), MIN_LENGTH)
    at = np.linspace(0.0, s[-1], max(2, int(np.ceil(length / POINT_SPACING)) + 1))
    points = np.stack([np.interp(at, s, xyz[:, axis]) for axis in range(3)], axis=-1)
    wrapped = (np.interp(at, s, yaw) + np.pi) % (2 * np.pi) - np.pi
    return points, wrapped, np.interp(at, s, width), length


def _end(
    chain: list[int],
    lanes: tuple[Lane, ...],
    resampled: tuple[np.ndarray, np.ndarray, np.ndarray, float],
) -> float:
    """Where a lane that leads nowhere has become too narrow, m; else its length."""
    _, _, width, length = resampled
    wide = np.flatnonzero(width >= DRIVABLE_WIDTH)
    if lanes[chain[-1]].successors or len(wide) == 0:
        return float(length)
    return float(length) * int(wide[-1]) / (len(width) - 1)


def _curve_speed(yaw: np.ndarray, length: float) -> np.ndarray:
    """(P - 1,) m/s, comfortable between each two points."""
    turn = np.abs(np.diff(np.unwrap(yaw)))
    if len(turn) >= 3:  # over 3 m, so that a kink between two pieces is no hairpin
        turn = np.convolve(np.pad(turn, 1, mode="edge"), np.ones(3) / 3, mode="valid")
    curvature = np.maximum(turn / max(length / (len(yaw) - 1), 0.1), 1e-4)
    return np.sqrt(LATERAL_ACCEL / curvature)


def _speed_profile(yaw: np.ndarray, length: float) -> np.ndarray:
    """(P,) m/s from which `CURVE_BRAKING` is enough for every bend that follows."""
    between = _curve_speed(yaw, length)
    speed = np.minimum(np.append(between, between[-1]), np.append(between[0], between))
    spacing = length / (len(yaw) - 1)
    for k in range(len(speed) - 2, -1, -1):
        speed[k] = min(speed[k], np.sqrt(speed[k + 1] ** 2 + 2 * CURVE_BRAKING * spacing))
    return speed


def _successors(network: RoadNetwork, chains: list[list[int]], raw_lane: np.ndarray) -> np.ndarray:
    following = [
        sorted({int(raw_lane[b]) for b in network.lanes[chain[-1]].successors}) for chain in chains
    ]
    out = np.full((len(chains), max(1, *(len(rows) for rows in following))), -1)
    for row, onward in enumerate(following):
        out[row, : len(onward)] = onward
    return out


def _chain_stops(
    chains: list[list[int]], stops: dict[int, tuple[int, float, str]], raw_start: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    stop_s = np.zeros(len(chains))
    kind = np.full(len(chains), STOP_NONE)
    signal = [""] * len(chains)
    for row, chain in enumerate(chains):
        for raw in chain:
            if raw in stops:
                kind[row], distance, signal[row] = stops[raw]
                stop_s[row] = raw_start[raw] + distance
    return stop_s, kind, signal
