"""Road blocks: what a route is made of where single lanes do not matter. Host only.

As in nuPlan: outside junctions all lanes of a road that go the same way; in a junction all lanes
that lead from one such block to another. source: nuPlan's roadblocks and roadblock connectors.
"""

from __future__ import annotations

import numpy as np

from carljax.sim.lane_table import LaneTable
from carljax.sim.road_network import Lane, RoadNetwork


def of_points(network: RoadNetwork, table: LaneTable) -> np.ndarray:
    """The block of each lane point.

    Args:
      network: the town.
      table: its lanes.

    Returns:
      (P,) int, blocks counted from 0.
    """
    out = np.zeros(len(table.point_yaw), int)
    numbers: dict[tuple, int] = {}
    for row, chain in enumerate(table.members):
        num = int(table.num_points[row])
        s = np.linspace(0.0, table.length[row], num)
        starts = table.raw_start[chain]
        which = np.clip(np.searchsorted(starts, s + 1e-6, side="right") - 1, 0, None)
        blocks = [numbers.setdefault(_key(network, raw), len(numbers)) for raw in chain]
        out[table.points(row)] = np.array(blocks)[which]
    return out


def _key(network: RoadNetwork, raw: int) -> tuple:
    """What lanes of one block share."""
    lane = network.lanes[raw]
    if lane.junction is None:
        return _road(lane)
    comes, goes = ([network.lanes[n] for n in x] for x in (lane.predecessors, lane.successors))
    if comes and goes and comes[0].junction is None and goes[0].junction is None:
        return lane.junction, _road(comes[0]), _road(goes[0])
    return lane.junction, *_road(lane)


def _road(lane: Lane) -> tuple:
    """Road and direction along it."""
    return lane.road_id, lane.lane_id > 0
