"""`village`: winding, hilly roads between stop and yield junctions around a roundabout."""

from __future__ import annotations

import dataclasses
import math

from towns import geometry, signs
from towns.geometry import Pose
from towns.nodes import RING_ROOM, Node, add_crossing, add_roundabout, pose
from towns.plan import (
    CENTRE_BROKEN,
    LANE_WIDTH,
    SOLID,
    Arm,
    Cubic,
    LaneSpec,
    Section,
    Town,
    ease,
    lane,
)

STREET_SPEED, ROAD_SPEED = 30.0, 50.0
NARROW, PARKING = 2.9, 2.2


NODES = {
    "C": Node(0, 0, 0, {"e": 0, "n": 90, "w": 180, "s": 270}, yields="enws", room=RING_ROOM),
    "E": Node(150, 20, 2, {"e": 10, "n": 95, "w": 185, "s": 275}, stops="enws"),
    "N": Node(-15, 140, 3, {"e": 10, "w": 180, "s": 275}, stops="s"),
    "W": Node(-150, -10, 1, {"e": 5, "n": 90, "w": 175, "s": 265}, yields="ew"),
    "S": Node(15, -140, -1, {"e": 0, "n": 95, "w": 175, "s": 275}, stops="ns"),
    "F": Node(175, -135, 4, {"e": 10, "n": 95, "w": 180}, yields="n"),
}


def build() -> Town:
    """The whole town."""
    town = Town("village")
    arms: dict[str, dict[str, Arm]] = {name: {} for name in NODES}
    for start, goal, via, kind in (
        ("Ce", "Ew", [], "street"),
        ("Cn", "Ns", [], "street"),
        ("Cw", "We", [], "street"),
        ("Cs", "Sn", [], "street"),
        ("Ne", "En", [(70, 162, -3), (138, 112, -65)], "road"),
        ("Wn", "Nw", [(-140, 70, 65), (-90, 125, 30)], "parking"),
        ("Sw", "Ws", [(-70, -120, 165), (-125, -85, 125)], "narrow"),
        ("Se", "Fw", [(95, -150, 0)], "street"),
        ("Fn", "Es", [], "street"),
        ("Ee", "Fe", [(210, 32, 0), (275, -45, -90), (230, -118, -160)], "road"),
        ("Ss", "Ww", [(-40, -215, 185), (-130, -190, 155), (-216, -95, 95)], "road"),
    ):
        _add_link(town, arms, (start, goal), [pose(*each) for each in via], kind)
    for name, node in NODES.items():
        if name == "C":
            add_roundabout(town, node, arms[name])
        else:
            add_crossing(town, node, arms[name])
    signs.add_speed_signs(town)
    return town


def _add_link(
    town: Town,
    arms: dict[str, dict[str, Arm]],
    ends: tuple[str, str],
    via: list[Pose],
    kind: str,
) -> None:
    first, last = (NODES[each[0]] for each in ends)
    goal = last.exit(ends[1][1]).turned(math.pi)
    path = geometry.wind(first.exit(ends[0][1]), *via, goal)
    length = geometry.length(path)
    # Long roads lead over a hill or through a dip, the short ones straight from height to height.
    middle = (first.height + last.height) / 2 + (5.0 if kind == "road" else 0.0)
    road = town.add_road(
        path,
        _sections(kind, length),
        ROAD_SPEED if kind == "road" else STREET_SPEED,
        kind="rural" if kind == "road" else "town",
        heights=_hill(first.height, middle, last.height, length),
    )
    arms[ends[0][0]][ends[0][1]] = Arm(road, "start")
    arms[ends[1][0]][ends[1][1]] = Arm(road, "end")


def _hill(start: float, middle: float, end: float, length: float) -> tuple[Cubic, ...]:
    half = length / 2
    return (ease(0.0, start, middle, half), ease(half, middle, end, half))


def _sections(kind: str, length: float) -> list[Section]:
    if kind == "road":
        rural = (lane("driving", LANE_WIDTH, SOLID), lane("shoulder", 1.5))
        return [Section(0.0, rural, rural, CENTRE_BROKEN)]
    walk = (lane("shoulder", 1.0), lane("sidewalk", 2.0))
    plain = (lane("driving", LANE_WIDTH, SOLID), *walk)
    if kind == "narrow":
        side = (_waist(length), *walk)
        return [Section(0.0, side, side, SOLID)]
    whole = Section(0.0, plain, plain, SOLID)
    if kind == "parking":
        start, end = 40.0, length - 40.0
        wide = (plain[0], _bay(end - start), *walk)
        return [
            whole,
            dataclasses.replace(whole, s=start, right=wide),
            dataclasses.replace(whole, s=end),
        ]
    return [whole]


def _waist(length: float) -> LaneSpec:
    """A driving lane that is narrow along its middle."""
    taper, from_end = 20.0, 15.0
    widths = (
        (0.0, LANE_WIDTH, 0.0, 0.0, 0.0),
        ease(from_end, LANE_WIDTH, NARROW, taper),
        (from_end + taper, NARROW, 0.0, 0.0, 0.0),
        ease(length - from_end - taper, NARROW, LANE_WIDTH, taper),
        (length - from_end, LANE_WIDTH, 0.0, 0.0, 0.0),
    )
    return LaneSpec("driving", widths, SOLID)


def _bay(length: float) -> LaneSpec:
    """A parking lane that opens and closes."""
    taper = 6.0
    widths = (
        ease(0.0, 0.0, PARKING, taper),
        (taper, PARKING, 0.0, 0.0, 0.0),
        ease(length - taper, PARKING, 0.0, taper),
    )
    return LaneSpec("parking", widths)
