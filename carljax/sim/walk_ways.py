"""Pavements of a town and the ways from one to another across the road. Host only."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
from scipy.spatial import cKDTree

from carljax.sim.lane_table import LaneTable
from carljax.sim.road_network import Lane, RoadNetwork

SIDEWALK = "sidewalk"
STEP = 0.5  # m between the points at which pavements are looked up
KERB_BEYOND = 0.4  # m from a crosswalk's end to where people wait. source: ours
KERB_MARGIN = 0.6  # m likewise from a pavement's edge to the road. source: ours
MIN_WIDTH = 0.8  # m, narrower pavements end here. source: ours, room for one person
ATTACH = 5.0  # m from a crosswalk's end to the middle of its pavement. source: ours
JAYWALK_SPACING = 18.0  # m between places to cross without a crosswalk. source: ours
JAYWALK_CLEARANCE = 15.0  # m kept to crosswalks and junctions: who is so near uses them
MIN_ROAD, MAX_ROAD = 3.0, 15.0  # m of carriageway: one lane to four
MAX_REACH = 26.0  # m between the middles of the two pavements
MAX_STEP_Z = 1.0  # m, ends further apart in height lie on different levels


@dataclasses.dataclass(frozen=True)
class Strip:
    """One pavement, sampled every `STEP` metres or less.

    Attributes:
      xyz: (P, 3) m, its middle.
      width: (P,) m.
      s: (P,) m along it.
      in_junction: whether it belongs to a junction.
    """

    xyz: np.ndarray
    width: np.ndarray
    s: np.ndarray
    in_junction: bool

    def at(self, s: np.ndarray | float) -> np.ndarray:
        """(..., 3) m, places along its middle."""
        return np.stack([np.interp(s, self.s, self.xyz[:, i]) for i in range(3)], axis=-1)


@dataclasses.dataclass(frozen=True)
class Way:
    """A way across the road, from the middle of one pavement to the middle of another.

    Attributes:
      strips: the two pavements.
      s: where along each, m.
      kerbs: (2, 2) m, where people wait at either end.
      is_crosswalk: whether it is a crosswalk.
    """

    strips: tuple[int, int]
    s: tuple[float, float]
    kerbs: np.ndarray
    is_crosswalk: bool


class Road:
    """Where cars drive, from the points of a lane table."""

    def __init__(self, table: LaneTable) -> None:
        self.xyz, self.yaw, self.width = table.point_xyz, table.point_yaw, table.point_width
        inside = np.array([junction is not None for junction in table.junction])
        self.in_junction = inside[table.point_lane]
        self.tree = cKDTree(self.xyz[:, :2])
        among = self.xyz[self.in_junction, :2]
        self.junction_tree = cKDTree(among if len(among) else np.full((1, 2), 1e9))

    def covers(self, xy: np.ndarray) -> np.ndarray:
        """(n,) bool, whether places (n, 2) lie on a driving lane."""
        near = self.tree.query(xy, k=min(4, len(self.xyz)))[1].reshape(len(xy), -1)
        offset = xy[:, None] - self.xyz[near, :2]
        cos, sin = np.cos(self.yaw[near]), np.sin(self.yaw[near])
        along = offset[..., 0] * cos + offset[..., 1] * sin
        lateral = offset[..., 1] * cos - offset[..., 0] * sin
        return np.asarray(((abs(along) < 0.6) & (abs(lateral) <= self.width[near] / 2)).any(axis=1))

    def height(self, xyz: np.ndarray) -> np.ndarray:
        """(n,) m, height of the nearest driving lane on the same level."""
        near = cKDTree(self.xyz).query(xyz)[1]
        return np.asarray(self.xyz[near, 2])


class Pavements:
    """All pavements of a town, to be looked up by place."""

    def __init__(self, network: RoadNetwork) -> None:
        strips = [_strip(lane) for lane in network.lanes if lane.kind == SIDEWALK]
        self.strips = [strip for strip in strips if strip is not None]
        if not self.strips:
            return
        self.xyz = np.concatenate([strip.xyz for strip in self.strips])
        self.s = np.concatenate([strip.s for strip in self.strips])
        self.width = np.concatenate([strip.width for strip in self.strips])
        sizes = [len(strip.s) for strip in self.strips]
        self.owner = np.repeat(np.arange(len(sizes)), sizes)
        self.tree = cKDTree(self.xyz[:, :2])


def ways(network: RoadNetwork, pavements: Pavements, road: Road) -> list[Way]:
    """All ways across: over every crosswalk that joins two pavements, and where there is none."""
    walks = [polygon[:, :2] for polygon in network.crosswalks]
    crossings = [way for way in (_crosswalk(p, pavements) for p in walks) if way is not None]
    centres = np.array([polygon.mean(axis=0) for polygon in walks]).reshape(-1, 2)
    return crossings + list(_jaywalks(pavements, road, centres))


def _strip(lane: Lane) -> Strip | None:
    """The part of a lane that is wide enough, as far as it is in one piece."""
    wide = np.flatnonzero(lane.width >= MIN_WIDTH)
    if len(wide) < 2:
        return None
    keep = slice(wide[0], wide[-1] + 1)
    xyz, width = lane.xyz[keep], lane.width[keep]
    known = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xyz[:, :2], axis=0).T))])
    if known[-1] < 1e-3:
        return None
    s = np.linspace(0.0, known[-1], int(np.ceil(known[-1] / STEP)) + 1)
    return Strip(
        xyz=np.stack([np.interp(s, known, xyz[:, i]) for i in range(3)], axis=-1),
        width=np.interp(s, known, width),
        s=s,
        in_junction=lane.junction is not None,
    )


def _crosswalk(polygon: np.ndarray, pavements: Pavements) -> Way | None:
    """The way over a crosswalk, None where one of its ends leads to no pavement.

    A crosswalk is longer across the road than it is wide; so its long axis says where it leads.
    """
    centre = polygon.mean(axis=0)
    axis = np.linalg.eigh(np.cov((polygon - centre).T))[1][:, -1]
    along = (polygon - centre) @ axis
    across = (polygon - centre) @ np.array([-axis[1], axis[0]])
    ends = [
        a0 + (a1 - a0) * c0 / (c0 - c1)
        for a0, a1, c0, c1 in zip(
            along, np.roll(along, -1), across, np.roll(across, -1), strict=True
        )
        if c0 * c1 < 0.0  # this side is crossed by the axis
    ]
    if len(ends) < 2:
        return None
    reach = np.array([min(ends) - KERB_BEYOND, max(ends) + KERB_BEYOND])
    kerbs = centre + reach[:, None] * axis
    away, rows = pavements.tree.query(kerbs)
    if away.max() > ATTACH or pavements.owner[rows[0]] == pavements.owner[rows[1]]:
        return None
    return _way(pavements, int(rows[0]), int(rows[1]), kerbs, True)


def _jaywalks(pavements: Pavements, road: Road, crosswalks: np.ndarray) -> Iterator[Way]:
    """Straight ways across outside junctions, away from crosswalks and from one another."""
    taken = list(crosswalks)
    for number, strip in enumerate(pavements.strips):
        if strip.in_junction:
            continue
        length = strip.s[-1]
        count = max(1, int(length / JAYWALK_SPACING))
        for s in (np.arange(count) + 0.5) * length / count:
            other = _opposite(strip, number, float(s), pavements, road)
            if other is None:
                continue
            middle = (strip.at(float(s))[:2] + pavements.xyz[other, :2]) / 2
            near = road.junction_tree.query(middle)[0] < JAYWALK_CLEARANCE
            if near or any(np.hypot(*(middle - x)) < JAYWALK_CLEARANCE for x in taken):
                continue
            taken.append(middle)
            here = np.flatnonzero(pavements.owner == number)
            first = here[np.argmin(abs(pavements.s[here] - s))]
            kerbs = _kerbs(pavements, np.array([first, other]))
            yield _way(pavements, int(first), other, kerbs, False)


def _opposite(strip: Strip, number: int, s: float, pavements: Pavements, road: Road) -> int | None:
    """Row of the pavement point straight across the road, None where there is no such."""
    here = strip.at(s)
    ahead, behind = strip.at(min(s + STEP, strip.s[-1])), strip.at(max(s - STEP, 0.0))
    along = (ahead - behind)[:2]
    normal = np.array([-along[1], along[0]]) / max(float(np.hypot(*along)), 1e-9)
    to_road = road.xyz[road.tree.query(here[:2])[1], :2] - here[:2]
    normal = normal if normal @ to_road > 0 else -normal
    reach = np.arange(0.0, MAX_REACH, STEP)
    on_line = here[:2] + reach[:, None] * normal
    away, row = pavements.tree.query(on_line)
    hit = (away < STEP) & (pavements.owner[row] != number) & (reach > MIN_ROAD)
    if not hit.any():
        return None
    first = int(np.argmax(hit))
    other = int(row[first])
    width = STEP * road.covers(on_line[: first + 1]).sum()
    level = abs(pavements.xyz[other, 2] - here[2]) < MAX_STEP_Z
    # Mostly carriageway between them, not a courtyard beyond a road.
    open_road = MIN_ROAD <= width <= MAX_ROAD and width > 0.5 * reach[first]
    return other if level and open_road else None


def _kerbs(pavements: Pavements, rows: np.ndarray) -> np.ndarray:
    """(2, 2) m, the kerbs between two pavement points on either side of a road."""
    middle = pavements.xyz[rows, :2]
    onward = (middle[1] - middle[0]) / np.hypot(*(middle[1] - middle[0]))
    inward = np.maximum(pavements.width[rows] / 2 - KERB_MARGIN, 0.1)[:, None]
    return middle + inward * np.stack([onward, -onward])


def _way(
    pavements: Pavements, first: int, second: int, kerbs: np.ndarray, is_crosswalk: bool
) -> Way:
    return Way(
        strips=(int(pavements.owner[first]), int(pavements.owner[second])),
        s=(float(pavements.s[first]), float(pavements.s[second])),
        kerbs=kerbs,
        is_crosswalk=is_crosswalk,
    )
