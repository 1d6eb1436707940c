"""`grid`: a signalised city of 4 x 3 blocks, two avenues of 2 + 2 lanes, rounded outer corners."""

from __future__ import annotations

import math

from towns import geometry, signs
from towns.crossing import add_junction, connect_all
from towns.geometry import Pose
from towns.plan import (
    BROKEN,
    LANE_WIDTH,
    SOLID,
    YELLOW,
    Arm,
    LaneSpec,
    Road,
    Section,
    Town,
    lane,
)

XS = (0.0, 100.0, 210.0, 310.0, 410.0)
YS = (0.0, 90.0, 190.0, 280.0)
# Streets that are avenues: the third from the west, the second from the south.
AVENUE_COLUMN, AVENUE_ROW = 2, 1
# A crossing that is out of line, so that the streets around it wind a little, m.
MOVED = {(1, 2): (6.0, -5.0), (3, 2): (-5.0, 7.0)}
# The crossing whose arms are served one at a time, as CARLA does; elsewhere opposing arms go
# together.
ONE_BY_ONE = (2, 2)
STREET_SPEED, AVENUE_SPEED = 30.0, 50.0
CORNER_RADIUS, CORNER_EASING = 20.0, 12.0
# Room for a right turn of 8.5 m radius at the lane centre, m.
TURN_ROOM = 8.5
EAST, NORTH, WEST, SOUTH = (0.0, math.pi / 2, math.pi, -math.pi / 2)
STEPS = {EAST: (1, 0), NORTH: (0, 1), WEST: (-1, 0), SOUTH: (0, -1)}

Node = tuple[int, int]


def build() -> Town:
    """The whole town."""
    town = Town("grid")
    arms: dict[Node, dict[float, Arm]] = {}
    for node in [(i, j) for j in range(len(YS)) for i in range(len(XS))]:
        for direction in (EAST, NORTH):
            other = _neighbour(node, direction)
            if other and not _is_corner(node) and not _is_corner(other):
                _add_street(town, arms, node, other, direction)
    for corner, first, second in (
        ((0, 0), EAST, NORTH),
        ((4, 0), NORTH, WEST),
        ((4, 3), WEST, SOUTH),
        ((0, 3), SOUTH, EAST),
    ):
        _add_corner(town, arms, corner, first, second)
    for node in sorted(arms, key=lambda n: (n[1], n[0])):
        _add_crossing(town, arms[node], node)
    signs.add_speed_signs(town)
    return town


def street(lanes: int) -> Section:
    """The cross-section of a street with so many lanes each way."""
    side: tuple[LaneSpec, ...] = (
        *[lane("driving", LANE_WIDTH, BROKEN)] * (lanes - 1),
        lane("driving", LANE_WIDTH, SOLID),
        lane("shoulder", 1.0),
        lane("sidewalk", 2.0),
    )
    return Section(0.0, side, side, YELLOW)


def _neighbour(node: Node, direction: float) -> Node | None:
    i, j = node[0] + STEPS[direction][0], node[1] + STEPS[direction][1]
    return (i, j) if 0 <= i < len(XS) and 0 <= j < len(YS) else None


def _is_corner(node: Node) -> bool:
    return node[0] in (0, len(XS) - 1) and node[1] in (0, len(YS) - 1)


def _lanes(node: Node, direction: float) -> int:
    """Lanes each way of the street that leaves the node in this direction."""
    along_row = direction in (EAST, WEST)
    return 2 if (node[1] == AVENUE_ROW if along_row else node[0] == AVENUE_COLUMN) else 1


def _exit(node: Node, direction: float) -> Pose:
    """Where a street leaves the crossing: far enough out for its right turns."""
    dx, dy = MOVED.get(node, (0.0, 0.0))
    crossing = direction + math.pi / 2 if direction in (EAST, WEST) else EAST
    lanes = _lanes(node, NORTH if abs(crossing) > 0.1 else EAST)
    room = (lanes - 0.5) * LANE_WIDTH + TURN_ROOM
    return Pose(XS[node[0]] + dx, YS[node[1]] + dy, direction).ahead(room)


def _add_street(
    town: Town, arms: dict[Node, dict[float, Arm]], node: Node, other: Node, direction: float
) -> None:
    back = direction + math.pi if direction == EAST else SOUTH
    goal = _exit(other, back).turned(math.pi)
    path = geometry.wind(_exit(node, direction), goal._replace(yaw=direction))
    _register(town, arms, path, (node, direction), (other, back), _lanes(node, direction))


def _add_corner(
    town: Town, arms: dict[Node, dict[float, Arm]], corner: Node, first: float, second: float
) -> None:
    """The road around a corner of the town, from the crossing on its `first` side to the other."""
    node, other = _neighbour(corner, first), _neighbour(corner, second)
    assert node and other
    start = _exit(node, _opposite(first))
    goal = _exit(other, _opposite(second))._replace(yaw=second)
    path = geometry.bend(start, goal, CORNER_RADIUS, CORNER_EASING)
    _register(town, arms, path, (node, _opposite(first)), (other, _opposite(second)), 1)


def _opposite(direction: float) -> float:
    return {EAST: WEST, WEST: EAST, NORTH: SOUTH, SOUTH: NORTH}[direction]


def _register(
    town: Town,
    arms: dict[Node, dict[float, Arm]],
    path: geometry.Path,
    start: tuple[Node, float],
    end: tuple[Node, float],
    lanes: int,
) -> None:
    speed = AVENUE_SPEED if lanes > 1 else STREET_SPEED
    road: Road = town.add_road(path, [street(lanes)], speed)
    for (node, direction), contact in ((start, "start"), (end, "end")):
        arms.setdefault(node, {})[direction] = Arm(road, contact)


def _add_crossing(town: Town, at: dict[float, Arm], node: Node) -> None:
    junction = add_junction(town, list(at.values()))
    # The junction keeps the arms it was given, so the groups below name the same objects.
    connect_all(town, junction)
    pairs = [[at[d] for d in pair if d in at] for pair in ((EAST, WEST), (NORTH, SOUTH))]
    one_by_one = [[at[d]] for d in (EAST, NORTH, WEST, SOUTH) if d in at]
    signs.add_lights(town, junction, one_by_one if node == ONE_BY_ONE else pairs)
    for direction, arm in at.items():
        signs.add_stop_line(town, arm)
        if direction in (EAST, WEST) or len(at) == 4:
            signs.add_crosswalk(town, arm, junction.connections)
