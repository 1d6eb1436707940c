"""A town on the host: what was read from its file and the tables made of it."""

from __future__ import annotations

import dataclasses
import functools
import pathlib
from collections.abc import Sequence

import numpy as np

from carljax.sim import (
    junctions,
    lane_neighbours,
    lane_table,
    light_table,
    opendrive,
    walk_graph,
)
from carljax.sim.road_network import MapError, RoadNetwork


@dataclasses.dataclass(frozen=True)
class Town:
    """One town, ready to be put on the device.

    Attributes:
      network: as read, moved so that its middle lies near (0, 0).
      offset: (2,) float64, what was subtracted from the file's coordinates, m.
      lanes, neighbours, junctions, lights: its tables.
      walks: where pedestrians walk.
    """

    network: RoadNetwork
    offset: np.ndarray
    lanes: lane_table.LaneTable
    neighbours: lane_neighbours.Neighbours
    junctions: junctions.JunctionTable
    lights: light_table.LightTable
    walks: walk_graph.WalkGraph

    @functools.cached_property
    def raw_points(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points of all lanes as read: xy (n, 2) m, width (n,) m, index into network.lanes (n,)."""
        lanes = self.network.lanes
        number = np.repeat(np.arange(len(lanes)), [len(lane.width) for lane in lanes])
        xy = np.concatenate([lane.xyz[:, :2] for lane in lanes])
        return xy, np.concatenate([lane.width for lane in lanes]), number


@dataclasses.dataclass(frozen=True)
class Offsets:
    """Where a town's rows begin in the tables that all towns share.

    Attributes:
      town: its index.
      lane, point, light, junction, walk: first rows.
    """

    town: int
    lane: int
    point: int
    light: int
    junction: int
    walk: int


def offsets(towns: Sequence[Town]) -> list[Offsets]:
    """First rows of each town in the shared tables."""
    out = [Offsets(0, 0, 0, 0, 0, 0)]
    for town in towns:
        last = out[-1]
        out.append(
            Offsets(
                town=last.town + 1,
                lane=last.lane + len(town.lanes.length),
                point=last.point + len(town.lanes.point_yaw),
                light=last.light + len(town.lights.cycle),
                junction=last.junction + int(town.junctions.junction.max(initial=-1)) + 1,
                walk=last.walk + len(town.walks.xyz),
            )
        )
    return out[:-1]


def load(path: str | pathlib.Path) -> Town:
    """Reads an OpenDRIVE file.

    Raises:
      MapError: in one line, what is wrong with the file and where.
    """
    return from_network(opendrive.load(path))


def from_network(network: RoadNetwork) -> Town:
    """Makes the tables of a town.

    Raises:
      MapError: the town has no driving lane.
    """
    if not any(lane.kind == "driving" for lane in network.lanes):
        raise MapError(f"{network.name}: no driving lane")
    network, offset = recentre(network)
    table = lane_table.build(network)
    return Town(
        network=network,
        offset=offset,
        lanes=table,
        neighbours=lane_neighbours.build(network, table),
        junctions=junctions.build(network, table),
        lights=light_table.build(network, table),
        walks=walk_graph.build(network, table),
    )


def recentre(network: RoadNetwork) -> tuple[RoadNetwork, np.ndarray]:
    """Moves a town to the origin in float64: float32 resolves only 0.25 m at UTM coordinates."""
    xy = np.concatenate([lane.xyz[:, :2] for lane in network.lanes if lane.kind == "driving"])
    offset = np.round((xy.min(axis=0) + xy.max(axis=0)) / 2)
    shift = np.array([*offset, 0.0])
    moved = dataclasses.replace(
        network,
        lanes=tuple(dataclasses.replace(x, xyz=x.xyz - shift) for x in network.lanes),
        marks=tuple(
            dataclasses.replace(x, xy=x.xy - shift[: x.xy.shape[1]]) for x in network.marks
        ),
        signals=tuple(dataclasses.replace(x, xyz=x.xyz - shift) for x in network.signals),
        crosswalks=tuple(x - shift for x in network.crosswalks),
        stop_lines=tuple(x - shift for x in network.stop_lines),
    )
    return moved, offset
