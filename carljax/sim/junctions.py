"""Who gets in whose way inside a junction, and who yields. Host only."""

from __future__ import annotations

import dataclasses

import numpy as np

from carljax.sim.lane_table import LaneTable
from carljax.sim.road_network import RoadNetwork
from carljax.sim.types import STOP_LIGHT, STOP_NONE, STOP_SIGN, STOP_YIELD

# What lane a owes lane b of the same junction.
FREE, CONFLICT, CONFLICT_YIELD, CONFLICT_PRIORITY = 0, 1, 2, 3

# How two lanes of a junction meet, other than by crossing: they end on one lane, begin on one.
MERGE, FORK = 1, 2

# `RoadMap.lane_meeting`, in steps of 1/4 m (up to 256 m). The first number: bits 0-1 what a lane
# owes the other, 2-3 MERGE and FORK, 4-13 and 14-23 from where to where on it the other lane is too
# near. The second: bits 0-11 and 12-23 the same on the other lane. 24 bits are exact in float32.
MEETING_STEPS, MEETING_MASK = 4.0, (1 << 10) - 1

CLEARANCE = (
    2.6  # m between lane centres at which two cars can't pass. source: ours, car width + 0.7 m
)
ONCOMING = -0.7  # cosine of the angle between the ways in of oncoming traffic. source: ours, 45 deg
TURN_YAW = np.deg2rad(35.0)  # beyond it a lane turns. source: CaRL's route generator, command rule


@dataclasses.dataclass(frozen=True)
class JunctionTable:
    """Fields as in `RoadMap`: junction, slot, yield_s (K,), meeting (K, J); and what it is made of.

    Attributes:
      conflict: (K, J) uint8, what each lane owes each lane of its junction.
      relation: (K, J) uint8, bits MERGE and FORK.
      enter, leave: (K, J) m along the lane, where it comes too near to the other and where it has
        left it; equal where it never does.
    """

    junction: np.ndarray
    slot: np.ndarray
    yield_s: np.ndarray
    conflict: np.ndarray
    relation: np.ndarray
    enter: np.ndarray
    leave: np.ndarray

    @property
    def meeting(self) -> np.ndarray:
        """(K, 2, J) float32, all of it as whole numbers of 24 bits; see `MEETING_STEPS`."""
        enter = np.minimum(np.floor(self.enter * MEETING_STEPS), MEETING_MASK).astype(int)
        leave = np.minimum(np.ceil(self.leave * MEETING_STEPS), MEETING_MASK).astype(int)
        mine = self.conflict.astype(int) | self.relation.astype(int) << 2 | enter << 4 | leave << 14
        both = np.stack([mine, np.zeros_like(mine)], axis=1)
        for rows in (np.flatnonzero(self.junction == i) for i in np.unique(self.junction)):
            if self.junction[rows[0]] >= 0:  # rows in the order of their slots
                there = (enter | leave << 12)[rows, : len(rows)]
                both[rows, 1, : len(rows)] = there.T
        return both.astype(np.float32)


def build(network: RoadNetwork, table: LaneTable) -> JunctionTable:
    """Finds where the lanes of each junction meet and who goes first.

    Lanes that leave the same lane don't conflict: traffic on them follows one another until they
    part.
    """
    num_lanes = len(table.length)
    ids = junction_ids(table)
    junction = np.array([-1 if name is None else ids[name] for name in table.junction])
    members = [np.flatnonzero(junction == i) for i in range(len(ids))]
    shape = (num_lanes, max([len(m) for m in members], default=1))
    found = JunctionTable(
        junction=junction,
        slot=np.zeros(num_lanes, int),
        yield_s=np.full(num_lanes, np.inf),
        conflict=np.zeros(shape, np.uint8),
        relation=np.zeros(shape, np.uint8),
        enter=np.zeros(shape),
        leave=np.zeros(shape),
    )
    for name, i in ids.items():
        rows = members[i].tolist()
        found.slot[rows] = np.arange(len(rows))
        priority = set(network.junctions[name].priority) if name in network.junctions else set()
        for a in rows:
            for b in rows:
                if a != b:
                    _fill(found, network, table, a, b, priority)
    return found


def _fill(
    found: JunctionTable,
    network: RoadNetwork,
    table: LaneTable,
    a: int,
    b: int,
    priority: set[tuple[str, str]],
) -> None:
    """Enters what lane a has to know of lane b."""
    near = np.flatnonzero(_near(table, a, b))
    if len(near) == 0:
        return
    spacing = table.length[a] / (table.num_points[a] - 1)
    place = (a, found.slot[b])
    # The lanes come near somewhere between two points.
    found.enter[place] = max(near[0] - 1, 0) * spacing
    found.leave[place] = min((near[-1] + 1) * spacing, table.length[a])
    ends = set(table.successors[a][table.successors[a] >= 0]) & set(table.successors[b])
    begins = set(table.predecessors[a]) & set(table.predecessors[b])
    found.relation[place] = (MERGE if ends else 0) | (FORK if begins else 0)
    if begins:
        return
    found.conflict[place] = _owes(network, table, a, b, priority)
    if _waits_for(table, a, b, int(found.conflict[place])):
        found.yield_s[a] = min(found.yield_s[a], near[0] * spacing)


def junction_ids(table: LaneTable) -> dict[str, int]:
    """Running index of each junction that has driving lanes, by its id in the file."""
    return {name: i for i, name in enumerate(sorted({j for j in table.junction if j is not None}))}


def _near(table: LaneTable, a: int, b: int) -> np.ndarray:
    """Points of lane a, bool, at which two cars on the lanes can't pass."""
    xyz_a, xyz_b = table.point_xyz[table.points(a)], table.point_xyz[table.points(b)]
    gap = np.hypot(*(xyz_a[:, None, :2] - xyz_b[None, :, :2]).transpose(2, 0, 1))
    level = np.abs(xyz_a[:, None, 2] - xyz_b[None, :, 2]) < 3.0
    return ((gap < CLEARANCE) & level).any(axis=1)


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
