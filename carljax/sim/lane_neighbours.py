"""The lane beside, for each lane point: where traffic may change lanes. Host only."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial import cKDTree

from carljax.sim.lane_table import LaneTable
from carljax.sim.road_network import MARK_SOLID, Lane, RoadNetwork

MIN_WIDTH = 2.5  # m; no change onto a lane that is about to end or has just begun. source: ours
NEAR = 0.6  # m between a border and the points of the line painted on it. source: ours
LEVEL = 3.0  # m between a road and the one above it, whose lines do not count


@dataclasses.dataclass(frozen=True)
class Neighbours:
    """Fields as in `RoadMap`: point_left (P,), point_right (P,)."""

    left: np.ndarray
    right: np.ndarray


def build(network: RoadNetwork, table: LaneTable) -> Neighbours:
    """Finds the point beside each lane point.

    Only a lane of the same direction, outside junctions, wide enough, and only where no solid line
    lies between: across broken lines and where nothing is painted one may change.
    """
    solid = _solid_points(network)
    left = np.full(len(table.point_lane), -1)
    right = left.copy()
    for raw, lane in enumerate(network.lanes):
        if table.raw_lane[raw] < 0 or lane.junction is not None:
            continue
        for beside, other, is_same, side in (
            (left, lane.left, lane.left_is_same_direction, 1.0),
            (right, lane.right, lane.right_is_same_direction, -1.0),
        ):
            if other >= 0 and is_same and table.raw_lane[other] != table.raw_lane[raw]:
                points, distance = _points_of(table, raw, lane)
                to = _beside(lane, network.lanes[other], distance)
                wide = np.interp(to, _along(network.lanes[other]), network.lanes[other].width)
                allowed = (wide >= MIN_WIDTH) & ~_is_solid(solid, _border(lane, distance, side))
                beside[points[allowed]] = _nearest_points(table, other, to[allowed])
    return Neighbours(left, right)


def _along(lane: Lane) -> np.ndarray:
    """Arc length at each point of a raw lane, m."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(lane.xyz[:, :2], axis=0).T))])


def _points_of(table: LaneTable, raw: int, lane: Lane) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the point table that lie on a raw lane, and their distance along it, m."""
    row = int(table.raw_lane[raw])
    spacing = table.length[row] / (table.num_points[row] - 1)
    distance = np.arange(table.num_points[row]) * spacing - table.raw_start[raw]
    on = (distance > -1e-6) & (distance < _along(lane)[-1] + 1e-6)
    return table.start[row] + np.flatnonzero(on), distance[on]


def _beside(lane: Lane, other: Lane, distance: np.ndarray) -> np.ndarray:
    """Distances along the lane beside at the same arc lengths of the road, m."""
    road_s = np.interp(distance, _along(lane), lane.s)
    order = slice(None) if other.s[-1] >= other.s[0] else slice(None, None, -1)
    return np.interp(road_s, other.s[order], _along(other)[order])


def _nearest_points(table: LaneTable, raw: int, distance: np.ndarray) -> np.ndarray:
    """Rows of the point table nearest to distances along a raw lane."""
    row = int(table.raw_lane[raw])
    spacing = table.length[row] / (table.num_points[row] - 1)
    number = np.rint((table.raw_start[raw] + distance) / spacing).astype(int)
    return table.start[row] + np.clip(number, 0, table.num_points[row] - 1)


def _border(lane: Lane, distance: np.ndarray, side: float) -> np.ndarray:
    """(n, 3) m, the lane's border on its left (1) or right (-1)."""
    along = _along(lane)
    yaw = np.interp(distance, along, np.unwrap(lane.yaw))
    half = side * np.interp(distance, along, lane.width) / 2
    across = np.stack([-np.sin(yaw), np.cos(yaw), np.zeros_like(yaw)], axis=-1)
    xyz = np.stack([np.interp(distance, along, lane.xyz[:, i]) for i in range(3)], axis=-1)
    return xyz + half[:, None] * across


def _solid_points(network: RoadNetwork) -> cKDTree:
    """The points of all solid lines, heights scaled so that NEAR means LEVEL."""
    points = [np.zeros((0, 3))]
    for mark in network.marks:
        if mark.kind == MARK_SOLID:
            z = mark.z if len(mark.z) else np.zeros(len(mark.xy))
            points.append(np.column_stack([mark.xy[:, :2], z * NEAR / LEVEL]))
    return cKDTree(np.concatenate(points))


def _is_solid(solid: cKDTree, border: np.ndarray) -> np.ndarray:
    """(n,) bool, a solid line is painted there."""
    if solid.n == 0:
        return np.zeros(len(border), bool)
    distance, _ = solid.query(border * [1.0, 1.0, NEAR / LEVEL], distance_upper_bound=NEAR)
    return np.isfinite(distance)
