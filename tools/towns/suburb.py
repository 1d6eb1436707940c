"""`suburb`: an avenue with lights between curved residential streets, a roundabout, parking bays.

Kept for evaluation: nothing is ever trained here. North of the avenue lie streets around a
roundabout, south of it streets between stop signs; two faster roads lead around the ends.
"""

from __future__ import annotations

import dataclasses
import math

from towns import geometry, signs
from towns.crossing import add_junction, connect_all
from towns.geometry import Pose
from towns.nodes import RING_ROOM, Node, add_crossing, add_roundabout, pose
from towns.plan import (
    BROKEN,
    CENTRE_BROKEN,
    LANE_WIDTH,
    SOLID,
    YELLOW,
    Arm,
    LaneSpec,
    Section,
    Town,
    ease,
    lane,
)

AVENUE_SPEED, ROAD_SPEED, STREET_SPEED = 60.0, 50.0, 30.0
LIGHT_ROOM = 16.0  # m from the middle of a junction with lights to its arms
PARKING, PARKING_TAPER, PARKING_END = 2.2, 6.0, 32.0

# Junctions along the avenue, from west to east, have lights.
NODES = {
    "A": Node(-215, -8, 0, {"e": 4, "n": 92, "w": 180, "s": 272}, room=LIGHT_ROOM),
    "B": Node(-60, 12, 1, {"e": -2, "n": 88, "w": 183}, room=LIGHT_ROOM),
    "C": Node(70, 2, 1, {"e": -4, "w": 174, "s": 268}, room=LIGHT_ROOM),
    "D": Node(220, -6, 0, {"e": 0, "n": 90, "w": 178, "s": 268}, room=LIGHT_ROOM),
    "R": Node(-45, 130, 3, {"e": 0, "n": 90, "w": 180, "s": 270}, yields="enws", room=RING_ROOM),
    "G": Node(-225, 115, 2, {"e": 0, "n": 95, "s": 270}, yields="e"),
    "H": Node(150, 120, 2, {"n": 80, "w": 175, "s": 275}, yields="w"),
    "K": Node(-20, 235, 5, {"e": 5, "w": 178, "s": 268}, stops="s"),
    "P": Node(-165, -125, -1, {"e": 10, "n": 90, "w": 180, "s": 275}, stops="ew"),
    "Q": Node(50, -120, -2, {"e": 0, "n": 90, "w": 170, "s": 265}, stops="enws"),
    "T": Node(215, -130, 0, {"e": 0, "n": 90, "w": 185}, yields="n"),
}
LIGHTS = "ABCD"
# Where links begin and end, the poses they pass and what they are.
LINKS: tuple[tuple[str, str, tuple[tuple[float, float, float], ...], str], ...] = (
    ("Ae", "Bw", (), "avenue"),
    ("Be", "Cw", (), "avenue"),
    ("Ce", "Dw", (), "avenue"),
    ("An", "Gs", (), "parking"),
    ("Bn", "Rs", (), "street"),
    ("Ge", "Rw", ((-150, 128, 20),), "street"),
    ("Re", "Hw", ((50, 112, -20),), "parking"),
    ("Rn", "Ks", (), "street"),
    ("Gn", "Kw", ((-205, 200, 60), (-110, 246, 15)), "street"),
    ("Hn", "Ke", ((140, 190, 115), (75, 250, 178)), "parking"),
    ("Hs", "Dn", ((190, 70, -45),), "street"),
    ("As", "Pn", ((-188, -65, -58),), "street"),
    ("Pe", "Qw", ((-100, -100, 25), (-25, -92, -30)), "parking"),
    ("Cs", "Qn", (), "street"),
    ("Qe", "Tw", ((135, -138, 0),), "street"),
    ("Ds", "Tn", (), "street"),
    ("Ps", "Qs", ((-130, -205, -40), (-50, -225, 5), (25, -190, 55)), "street"),
    ("Aw", "Pw", ((-290, -70, -90), (-240, -130, 0)), "road"),
    ("De", "Te", ((295, -65, -95),), "road"),
)


def build() -> Town:
    """The whole town."""
    town = Town("suburb")
    arms: dict[str, dict[str, Arm]] = {name: {} for name in NODES}
    for start, goal, via, kind in LINKS:
        _add_link(town, arms, start, goal, [pose(*each) for each in via], kind)
    for name, node in NODES.items():
        if name == "R":
            add_roundabout(town, node, arms[name])
        elif name in LIGHTS:
            _add_lights(town, arms[name], node.height)
        else:
            add_crossing(town, node, arms[name])
    signs.add_speed_signs(town)
    return town


def _add_link(
    town: Town,
    arms: dict[str, dict[str, Arm]],
    start: str,
    goal: str,
    via: list[Pose],
    kind: str,
) -> None:
    first, last = NODES[start[0]], NODES[goal[0]]
    path = geometry.wind(first.exit(start[1]), *via, last.exit(goal[1]).turned(math.pi))
    length = geometry.length(path)
    road = town.add_road(
        path,
        _sections(kind, length),
        {"avenue": AVENUE_SPEED, "road": ROAD_SPEED}.get(kind, STREET_SPEED),
        kind="rural" if kind == "road" else "town",
        heights=(ease(0.0, first.height, last.height, length),),
    )
    arms[start[0]][start[1]] = Arm(road, "start")
    arms[goal[0]][goal[1]] = Arm(road, "end")


def _sections(kind: str, length: float) -> list[Section]:
    if kind == "road":
        side = (lane("driving", LANE_WIDTH, SOLID), lane("shoulder", 1.5))
        return [Section(0.0, side, side, CENTRE_BROKEN)]
    walk = (lane("shoulder", 1.0), lane("sidewalk", 2.0))
    outer = lane("driving", LANE_WIDTH, SOLID)
    if kind == "avenue":
        side = (lane("driving", LANE_WIDTH, BROKEN), outer, *walk)
        return [Section(0.0, side, side, YELLOW)]
    plain = Section(0.0, (outer, *walk), (outer, *walk), CENTRE_BROKEN)
    if kind == "street":
        return [plain]
    # Bays on both sides, but not near the junctions.
    end = length - PARKING_END
    bay = (
        ease(0.0, 0.0, PARKING, PARKING_TAPER),
        (PARKING_TAPER, PARKING, 0.0, 0.0, 0.0),
        ease(end - PARKING_END - PARKING_TAPER, PARKING, 0.0, PARKING_TAPER),
    )
    side = (outer, LaneSpec("parking", bay), *walk)
    return [
        plain,
        Section(PARKING_END, side, side, CENTRE_BROKEN),
        dataclasses.replace(plain, s=end),
    ]


def _add_lights(town: Town, at: dict[str, Arm], height: float) -> None:
    """A junction of the avenue: its arms are green together, then the others one by one."""
    junction = add_junction(town, list(at.values()), height)
    connect_all(town, junction)
    along = [at[name] for name in "ew"]
    signs.add_lights(town, junction, [along, *[[at[name]] for name in "ns" if name in at]])
    for arm in at.values():
        signs.add_stop_line(town, arm)
        signs.add_crosswalk(town, arm, junction.connections)
