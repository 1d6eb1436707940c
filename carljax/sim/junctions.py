"""Who gets in whose way inside a junction, and who yields. Host only."""

from __future__ import annotations

import dataclasses

import numpy as np

from carljax.sim.lane_table import LaneTable
from carljax.sim.road_network import RoadNetwork
from carljax.sim.types import STOP_LIGHT, STOP_NONE, STOP_SIGN, STOP_YIELD

# What lane a owes lane b of the same junction.
FREE, CONFLICT, CONFLICT_YIELD, CONFLICT_PRIORITY = 0, 1, 2, 3

CLEARANCE = (
    2.6  # m between lane centres at which two cars can't pass. source: ours, car width + 0.7 m
)
ONCOMING = -0.7  # cosine of the angle between the ways in of oncoming traffic. source: ours, 45 deg
TURN_YAW = np.deg2rad(35.0)  # beyond it a lane turns. source: CaRL's route generator, command rule


@dataclasses.dataclass(frozen=True)
class JunctionTable:
    """Fields as in `RoadMap`: junction (K,), slot (K,), conflict (K, J), fork, yield_s (K,)."""

    junction: np.ndarray
    slot: np.ndarray
    conflict: np.ndarray
    fork: np.ndarray
    yield_s: np.ndarray


def build(network: RoadNetwork, table: LaneTable) -> JunctionTable:
    """Finds conflicts between the lanes of each junction.

    Lanes that leave the same lane don't conflict: traffic on them follows one another until they
    part.
    """
    num_lanes = len(table.length)
    ids = junction_ids(table)
    junction = np.array([-1 if name is None else ids[name] for name in table.junction])
    fork = _forks(table)
    slot = np.zeros(num_lanes, int)
    members = [np.flatnonzero(junction == i) for i in range(len(ids))]
    size = max([len(m) for m in members], default=1)
    conflict = np.zeros((num_lanes, max(size, 1)), np.uint8)
    yield_s = np.full(num_lanes, np.inf)
    for name, i in ids.items():
        rows = members[i]
        slot[rows] = np.arange(len(rows))
        priority = set(network.junctions[name].priority) if name in network.junctions else set()
        for a in rows.tolist():
            for b in rows.tolist():
                if a != b and fork[a] != fork[b] and _meet(table, a, b):
                    conflict[a, slot[b]] = _owes(network, table, a, b, priority)
                    if _waits_for(table, a, b, int(conflict[a, slot[b]])):
                        yield_s[a] = min(yield_s[a], _meeting_s(table, a, b))
    return JunctionTable(junction, slot, conflict, fork, yield_s)


def junction_ids(table: LaneTable) -> dict[str, int]:
    """Running index of each junction that has driving lanes, by its id in the file."""
    return {name: i for i, name in enumerate(sorted({j for j in table.junction if j is not None}))}


def _forks(table: LaneTable) -> np.ndarray:
    """Equal numbers for lanes that share a predecessor; lanes without one get their own."""
    return np.array(
        [pred[0] if pred else -1 - lane for lane, pred in enumerate(table.predecessors)]
    )


def _meet(table: LaneTable, a: int, b: int) -> bool:
    return bool(_near(table, a, b).any())


def _near(table: LaneTable, a: int, b: int) -> np.ndarray:
    """Points of lane a, bool, at which two cars on the lanes can't pass."""
    xyz_a, xyz_b = table.point_xyz[table.points(a)], table.point_xyz[table.points(b)]
    gap = np.hypot(*(xyz_a[:, None, :2] - xyz_b[None, :, :2]).transpose(2, 0, 1))
    level = np.abs(xyz_a[:, None, 2] - xyz_b[None, :, 2]) < 3.0
    return ((gap < CLEARANCE) & level).any(axis=1)


def _meeting_s(table: LaneTable, a: int, b: int) -> float:
    """Arc length on lane a where it first comes too near to lane b, m."""
    return float(np.argmax(_near(table, a, b)) * table.length[a] / (table.num_points[a] - 1))


def _waits_for(table: LaneTable, a: int, b: int, owes: int) -> bool:
    """Whether lane a has to mind lane b; behind lights only oncoming lanes are green as well."""
    if owes not in (CONFLICT, CONFLICT_YIELD):
        return False
    if table.stop_kind[a] != STOP_LIGHT:
        return True
    yaw_a, yaw_b = (table.point_yaw[table.start[lane]] for lane in (a, b))
    return owes == CONFLICT_YIELD and np.cos(yaw_a - yaw_b) < ONCOMING


def turn(table: LaneTable, lane: int) -> float:
    """Change of direction along a lane, rad; positive to the left."""
    yaw = np.unwrap(table.point_yaw[table.points(lane)])
    return float(yaw[-1] - yaw[0])


def _owes(
    network: RoadNetwork, table: LaneTable, a: int, b: int, priority: set[tuple[str, str]]
) -> int:
    """Signs come first, then the file's priorities, then whoever crosses oncoming traffic."""
    rank = {STOP_NONE: 0, STOP_LIGHT: 0, STOP_YIELD: 1, STOP_SIGN: 1}
    kind_a, kind_b = rank[int(table.stop_kind[a])], rank[int(table.stop_kind[b])]
    road_a, road_b = (network.lanes[table.members[lane][0]].road_id for lane in (a, b))
    side = -1.0 if network.left_hand_traffic else 1.0
    crosses_a, crosses_b = (side * turn(table, lane) > TURN_YAW for lane in (a, b))
    owes_a, owes_b = kind_a > kind_b, kind_b > kind_a
    if owes_a == owes_b:
        owes_a, owes_b = (road_b, road_a) in priority, (road_a, road_b) in priority
    if owes_a == owes_b and kind_a == 0:
        owes_a, owes_b = crosses_a and not crosses_b, crosses_b and not crosses_a
    if owes_a == owes_b:
        return CONFLICT
    return CONFLICT_YIELD if owes_a else CONFLICT_PRIORITY
