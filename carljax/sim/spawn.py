"""Places where traffic may appear, at the start and later out of the ego's sight. Host only."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial import cKDTree

from carljax.sim.lane_table import LaneTable

SPACING = 8.0  # m between places on a lane
MIN_WIDTH = 2.5  # m; tapering lanes begin where a car fits
END_CLEARANCE = 6.0  # m kept to a lane's ends
TAPER_CLEARANCE = 80.0  # m before a lane tapers to its end: room to change lanes. source: ours
CELL = 20.0  # m, side of the grid cells of the respawn table
CANDIDATES = 16  # respawn places a cell
RING = (60.0, 140.0)  # m from the cell's centre
ONCOMING_REACH = 25.0  # m across to a lane of oncoming traffic, medians included. source: ours
ONCOMING = -0.8  # cosine of the angle between lanes that are oncoming to one another. source: ours


@dataclasses.dataclass(frozen=True)
class Places:
    """Spawn places of one town: lane (n,), s (n,) m, xy (n, 2) m."""

    lane: np.ndarray
    s: np.ndarray
    xy: np.ndarray


def places(table: LaneTable) -> Places:
    """Places every `SPACING` metres on all lanes outside junctions."""
    lane, s, xy = [], [], []
    last = _last(table)
    for row in range(len(table.length)):
        if table.junction[row] is not None:
            continue
        points = table.points(row)
        at = np.arange(END_CLEARANCE, last[points.start], SPACING)
        known = np.linspace(0.0, table.length[row], int(table.num_points[row]))
        width = np.interp(at, known, table.point_width[points])
        at = at[width >= MIN_WIDTH]
        lane.append(np.full(len(at), row))
        s.append(at)
        xyz = table.point_xyz[points]
        xy.append(np.stack([np.interp(at, known, xyz[:, i]) for i in range(2)], axis=-1))
    if not lane:  # a town that is all junctions
        return Places(np.zeros(0, int), np.zeros(0), np.zeros((0, 2)))
    return Places(np.concatenate(lane), np.concatenate(s), np.concatenate(xy))


def oncoming(table: LaneTable, left_hand_traffic: bool) -> np.ndarray:
    """(P,) int, for each lane point the nearest one of oncoming traffic beside it, -1 for none.

    Args:
      table: the town's lanes.
      left_hand_traffic: whether cars keep to the left, and oncoming ones are to the right.
    """
    outside = np.array([name is None for name in table.junction])
    spacing = table.length / (table.num_points - 1)
    s = (np.arange(len(table.point_lane)) - table.start[table.point_lane]) * spacing[
        table.point_lane
    ]
    wide = table.point_width >= MIN_WIDTH
    usable = np.flatnonzero(
        outside[table.point_lane] & wide & (s >= END_CLEARANCE) & (s <= _last(table))
    )
    found = np.full(len(table.point_lane), -1)
    if len(usable) == 0:
        return found
    xy, yaw = table.point_xyz[:, :2], table.point_yaw
    tree = cKDTree(xy[usable])
    most = min(64, len(usable))
    away, near = tree.query(xy, k=np.arange(1, most + 1), distance_upper_bound=ONCOMING_REACH)
    near = usable[np.minimum(near, len(usable) - 1)]  # (P, most), nearest first
    offset = xy[near] - xy[:, None]
    left = np.cos(yaw)[:, None] * offset[..., 1] - np.sin(yaw)[:, None] * offset[..., 0]
    beside = -left if left_hand_traffic else left
    fits = np.isfinite(away) & (beside > 1.0) & (np.cos(yaw[near] - yaw[:, None]) < ONCOMING)
    has = fits.any(axis=1)
    found[has] = near[has, fits.argmax(axis=1)[has]]
    return found


def _last(table: LaneTable) -> np.ndarray:
    """(P,) m, last place on each point's lane where a car may appear."""
    tapers = table.end < table.length
    return (table.end - np.where(tapers, TAPER_CLEARANCE, END_CLEARANCE))[table.point_lane]


def arms(table: LaneTable, junction: np.ndarray) -> np.ndarray:
    """(number of junctions, most arms) int, lanes that lead into each junction, -1 pads.

    Args:
      table: the town's lanes.
      junction: (K,) int, running index of each lane's junction, -1 outside.
    """
    leads: list[set[int]] = [set() for _ in range(int(junction.max(initial=-1)) + 1)]
    for row in np.flatnonzero(junction >= 0):
        before = [p for p in table.predecessors[row] if junction[p] < 0]
        leads[junction[row]] |= {p for p in before if table.length[p] > 2 * END_CLEARANCE}
    most = max([len(lanes) for lanes in leads], default=0)
    rows = np.full((len(leads), max(most, 1)), -1)
    for number, lanes in enumerate(leads):
        rows[number, : len(lanes)] = sorted(lanes)
    return rows


def respawn_table(
    found: Places,
    origin: np.ndarray,
    extent: tuple[float, float],
    seed: int,
    ring: tuple[float, float] = RING,
) -> tuple[np.ndarray, np.ndarray]:
    """For each grid cell the ego may be in, places in a ring around it.

    Args:
      found: the town's places.
      origin: (2,) lower left corner of the grid, m.
      extent: width and height of the grid, m.
      seed: of the choice where a ring holds more than `CANDIDATES` places; each cell chooses by
        itself, so that a larger grid changes nothing.
      ring: least and greatest distance from the cell's centre, m.

    Returns:
      lane (Gy, Gx, C) int, -1 pads; s (Gy, Gx, C) m.
    """
    columns, rows = (int(np.ceil(e / CELL)) for e in extent)
    lane = np.full((rows, columns, CANDIDATES), -1)
    s = np.zeros((rows, columns, CANDIDATES))
    if len(found.lane) == 0:
        return lane, s
    tree = cKDTree(found.xy)
    for row in range(rows):
        for column in range(columns):
            centre = origin + CELL * (np.array([column, row]) + 0.5)
            near = np.array(tree.query_ball_point(centre, ring[1]), int)
            if len(near) == 0:
                continue
            near = near[np.hypot(*(found.xy[near] - centre).T) > ring[0]]
            near = np.random.default_rng([seed, row, column]).permutation(near)[:CANDIDATES]
            lane[row, column, : len(near)] = found.lane[near]
            s[row, column, : len(near)] = found.s[near]
    return lane, s
