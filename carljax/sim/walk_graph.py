"""Where pedestrians walk: a graph along pavements and across roads. Host only.

Nodes lie every few metres along the middle of pavements and, in pairs, at the kerbs where a way
across the road begins and ends. Between two kerbs there is one edge, straight across.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from carljax.sim import spawn
from carljax.sim.lane_table import LaneTable
from carljax.sim.road_map import (
    WALK_CROSSING,
    WALK_JAYWALK,
    WALK_PAVEMENT,
    WALK_TO_CROSSING,
    WALK_TO_JAYWALK,
)
from carljax.sim.road_network import RoadNetwork
from carljax.sim.walk_ways import Pavements, Road, Strip, Way, ways

SPACING = 3.0  # m between nodes: chords stay within 0.3 m of a corner of 4 m radius
SAME = 0.6  # m, nodes closer than this are one
JOIN = 3.0  # m, gaps between the ends of pavements that are stepped over
RING = (66.0, 115.0)  # m from a cell's centre, where people appear: just out of CaRL's image


@dataclasses.dataclass(frozen=True)
class WalkGraph:
    """A town's walk graph; every edge is there in both directions.

    Attributes:
      xyz: (n, 3) float64 m; z is the height of the nearest lane.
      neighbours: (n, D) int, -1 pads.
      yaw: (n, D) rad, direction of each edge.
      kind: (n, D) int, WALK_* of each edge.
      is_kerb: (n,) bool, a way across begins here.
    """

    xyz: np.ndarray
    neighbours: np.ndarray
    yaw: np.ndarray
    kind: np.ndarray
    is_kerb: np.ndarray


@dataclasses.dataclass
class _Draft:
    """Nodes (n, 3) m and edges (from, to, kind, kind of the way back) before they are merged."""

    xyz: list[np.ndarray] = dataclasses.field(default_factory=list)
    edges: list[tuple[int, int, int, int]] = dataclasses.field(default_factory=list)

    def add(self, xyz: np.ndarray) -> int:
        self.xyz.append(xyz)
        return len(self.xyz) - 1


def build(network: RoadNetwork, table: LaneTable) -> WalkGraph:
    """Makes the walk graph of a town; it is empty where the town has no pavement.

    Args:
      network: the town as read.
      table: its driving lanes.
    """
    pavements = Pavements(network)
    if not pavements.strips:
        return _table(np.zeros((0, 3)), [], 0)
    road = Road(table)
    across = ways(network, pavements, road)
    draft, joints = _along(pavements.strips, across)
    draft, joints = _merged(draft, joints)
    _join_ends(draft, road)
    num_pavement = len(draft.xyz)
    for way, ends in zip(across, joints, strict=True):
        _across(draft, way, ends)
    xyz = np.array(draft.xyz)
    xyz[:, 2] = road.height(xyz)
    return _table(xyz, draft.edges, num_pavement)


def respawn_table(
    graph: WalkGraph, origin: np.ndarray, extent: tuple[float, float], seed: int
) -> np.ndarray:
    """For each grid cell the ego may be in, nodes on pavements in a ring around it.

    Args:
      graph: the town's.
      origin: (2,) lower left corner of the grid, m.
      extent: width and height of the grid, m.
      seed: of the choice where a ring holds more nodes than there is room for.

    Returns:
      (Gy, Gx, C) int, -1 pads.
    """
    nodes = np.flatnonzero(~graph.is_kerb)
    places = spawn.Places(nodes, np.zeros(len(nodes)), graph.xyz[nodes, :2])
    return spawn.respawn_table(places, origin, extent, seed, RING)[0]


def _along(strips: list[Strip], across: list[Way]) -> tuple[_Draft, list[tuple[int, int]]]:
    """Nodes along each pavement; each way's two nodes among them."""
    draft = _Draft()
    joints = [[-1, -1] for _ in across]
    for number, strip in enumerate(strips):
        asked = [
            (way.s[end], i, end)
            for i, way in enumerate(across)
            for end in range(2)
            if way.strips[end] == number
        ]
        length = strip.s[-1]
        grid = np.linspace(0.0, length, max(2, int(np.ceil(length / SPACING)) + 1))
        exact = np.array([s for s, _, _ in asked])
        inner = grid[1:-1]
        inner = inner[(abs(inner[:, None] - exact) > SPACING / 2).all(axis=1)]
        places = np.unique(np.concatenate([[0.0, length], inner, exact]))
        rows = [draft.add(xyz) for xyz in strip.at(places)]
        draft.edges += [
            (a, b, WALK_PAVEMENT, WALK_PAVEMENT) for a, b in zip(rows, rows[1:], strict=False)
        ]
        for s, i, end in asked:
            joints[i][end] = rows[int(np.searchsorted(places, s))]
    return draft, [(first, second) for first, second in joints]


def _merged(draft: _Draft, joints: list[tuple[int, int]]) -> tuple[_Draft, list[tuple[int, int]]]:
    """Makes one of nodes that lie together: pavements that go on or overlap."""
    xyz = np.array(draft.xyz)
    pairs = cKDTree(xyz).query_pairs(SAME, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(xyz),) * 2)
    count, label = connected_components(links, directed=False)
    total = np.stack([np.bincount(label, xyz[:, i], count) for i in range(3)], axis=-1)
    middle = total / np.bincount(label, minlength=count)[:, None]
    edges = {
        (min(label[a], label[b]), max(label[a], label[b]), kind, back)
        for a, b, kind, back in draft.edges
        if label[a] != label[b]
    }
    merged = _Draft(list(middle), sorted((int(a), int(b), k, m) for a, b, k, m in edges))
    return merged, [(int(label[a]), int(label[b])) for a, b in joints]


def _join_ends(draft: _Draft, road: Road) -> None:
    """Joins pavements that end close to another one, not across the road."""
    xyz = np.array(draft.xyz)
    ends = np.bincount(np.array([e[:2] for e in draft.edges]).ravel(), minlength=len(xyz)) == 1
    beside = {(a, b) for a, b, _, _ in draft.edges} | {(b, a) for a, b, _, _ in draft.edges}
    tree = cKDTree(xyz)
    for row in np.flatnonzero(ends):
        near = [
            i
            for i in tree.query_ball_point(xyz[row], JOIN)
            if i != row and (int(row), i) not in beside
        ]
        for other in sorted(near, key=lambda i: float(np.hypot(*(xyz[i] - xyz[row])[:2]))):
            line = xyz[row, :2] + np.linspace(0, 1, 9)[:, None] * (xyz[other] - xyz[row])[:2]
            if road.covers(line).any():
                continue
            draft.edges.append((int(row), int(other), WALK_PAVEMENT, WALK_PAVEMENT))
            beside |= {(int(row), other), (other, int(row))}
            break


def _across(draft: _Draft, way: Way, ends: tuple[int, int]) -> None:
    """Adds the two kerbs of a way and the edges over them."""
    first, second = (
        draft.add(np.append(kerb, draft.xyz[end][2]))
        for kerb, end in zip(way.kerbs, ends, strict=True)
    )
    kind = WALK_CROSSING if way.is_crosswalk else WALK_JAYWALK
    to_kerb = WALK_TO_CROSSING if way.is_crosswalk else WALK_TO_JAYWALK
    draft.edges += [
        (ends[0], first, to_kerb, WALK_PAVEMENT),
        (first, second, kind, kind),
        (ends[1], second, to_kerb, WALK_PAVEMENT),
    ]


def _table(xyz: np.ndarray, edges: list[tuple[int, int, int, int]], num_pavement: int) -> WalkGraph:
    """Rows of neighbours from a list of edges."""
    both = sorted([(a, b, k) for a, b, k, _ in edges] + [(b, a, back) for a, b, _, back in edges])
    degree = np.bincount([a for a, _, _ in both], minlength=len(xyz)).astype(int)
    shape = (len(xyz), max(1, int(degree.max(initial=0))))
    neighbours = np.full(shape, -1)
    kind = np.full(shape, WALK_PAVEMENT)
    yaw = np.zeros(shape)
    filled = np.zeros(len(xyz), int)
    for a, b, edge_kind in both:
        column = filled[a]
        filled[a] += 1
        offset = xyz[b] - xyz[a]
        neighbours[a, column], kind[a, column] = b, edge_kind
        yaw[a, column] = np.arctan2(offset[1], offset[0])
    is_kerb = np.arange(len(xyz)) >= num_pavement
    return WalkGraph(xyz, neighbours, yaw, kind, is_kerb)
