"""Junctions by place and directions of their arms: crossings with signs, roundabouts."""

from __future__ import annotations

import dataclasses
import math

from towns import geometry, signs
from towns.crossing import add_junction, connect_all
from towns.geometry import Pose
from towns.plan import SOLID, Arm, Road, Section, Town, lane

# From the middle of a junction to its arms, m.
ROOM = 13.0
# Roundabout: lane centre radius, lane width, distance of the arms, half the angle of an arm.
RING_RADIUS, RING_WIDTH, RING_ROOM, RING_HALF = 15.0, 4.5, 27.0, math.radians(30.0)
RING_SPEED = 30.0


@dataclasses.dataclass(frozen=True)
class Node:
    """A junction: where it lies, how high, the directions of its arms (degrees), who waits.

    Attributes:
      x, y, height: m.
      directions: of the arms by name, degrees counter-clockwise from east, outwards.
      stops, yields: arms with such a sign.
      room: from its middle to the arms, m.
    """

    x: float
    y: float
    height: float
    directions: dict[str, float]
    stops: str = ""
    yields: str = ""
    room: float = ROOM

    def exit(self, name: str) -> Pose:
        """Where an arm begins, looking outwards."""
        direction = math.radians(self.directions[name])
        return Pose(self.x, self.y, geometry.wrap(direction)).ahead(self.room)


def pose(x: float, y: float, degrees: float) -> Pose:
    """A pose from a direction in degrees."""
    return Pose(float(x), float(y), math.radians(degrees))


def add_crossing(town: Town, node: Node, at: dict[str, Arm]) -> None:
    """A junction in which the arms that the node names have signs.

    Args:
      town: gets the junction.
      node: where.
      at: its arms by name.
    """
    junction = add_junction(town, list(at.values()), node.height)
    connect_all(town, junction)
    for name, arm in at.items():
        if name in node.stops + node.yields:
            kind = signs.STOP if name in node.stops else signs.YIELD
            signs.add_sign(town, arm, junction.connections, kind)
            signs.add_stop_line(town, arm)
        if name in node.stops:
            signs.add_crosswalk(town, arm, junction.connections)


def add_roundabout(town: Town, node: Node, at: dict[str, Arm]) -> None:
    """A ring of one-way roads; a junction at every arm joins it with the ways in and out.

    Args:
      town: gets the roads and junctions.
      node: the middle of the ring.
      at: its arms by name.
    """
    names = sorted(at, key=lambda name: node.directions[name])
    ring = [
        _ring_road(town, node, node.directions[a], node.directions[b])
        for a, b in zip(names, names[1:] + names[:1], strict=True)
    ]
    for index, name in enumerate(names):
        arm = at[name]
        parts = [arm, Arm(ring[index - 1], "end"), Arm(ring[index], "start")]
        junction = add_junction(town, parts, node.height)
        connect_all(town, junction)
        signs.add_sign(town, arm, junction.connections, signs.YIELD)


def _ring_road(town: Town, node: Node, first: float, second: float) -> Road:
    """The stretch of the ring between two arms, given by their directions in degrees."""
    radius = RING_RADIUS - RING_WIDTH / 2
    start = math.radians(first) + RING_HALF
    angle = math.radians((second - first) % 360) - 2 * RING_HALF
    middle = Pose(node.x, node.y, geometry.wrap(start))
    path = geometry.chain(
        middle.ahead(radius).turned(math.pi / 2), (radius * angle, 1 / radius, 1 / radius)
    )
    lanes = (lane("driving", RING_WIDTH, SOLID), lane("shoulder", 1.0), lane("sidewalk", 2.0))
    section = Section(0.0, (), lanes, SOLID)
    heights = ((0.0, node.height, 0.0, 0.0, 0.0),) if node.height else ()
    return town.add_road(path, [section], RING_SPEED, heights=heights)
