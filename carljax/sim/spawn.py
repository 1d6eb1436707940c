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


@dataclasses.dataclass(frozen=True)
class Places:
    """Spawn places of one town: lane (n,), s (n,) m, xy (n, 2) m."""

    lane: np.ndarray
    s: np.ndarray
    xy: np.ndarray


def places(table: LaneTable) -> Places:
    """Places every `SPACING` metres on all lanes outside junctions."""
    lane, s, xy = [], [], []
    for row in range(len(table.length)):
        if table.junction[row] is not None:
            continue
        tapers = table.end[row] < table.length[row]
        end = table.end[row] - (TAPER_CLEARANCE if tapers else END_CLEARANCE)
        at = np.arange(END_CLEARANCE, end, SPACING)
        points = table.points(row)
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
