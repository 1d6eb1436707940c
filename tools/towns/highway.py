"""`highway`: a dual carriageway around an oval with an interchange, and the local roads it serves.

The carriageways share one reference line that runs counter-clockwise: right lanes on the outside.
On the south side a third lane each way takes in a ramp at its beginning and gives one off at its
end. Two crossings with lights, at the west and the east, join the inside with the outside.
"""

from __future__ import annotations

import dataclasses
import math

from towns import geometry, signs
from towns.crossing import add_junction, connect, connect_all
from towns.geometry import Path, Pose
from towns.plan import (
    BROKEN,
    CENTRE_BROKEN,
    LANE_WIDTH,
    SOLID,
    YELLOW,
    Arm,
    Junction,
    Road,
    Section,
    Town,
    join_roads,
    lane,
)

# The oval's reference line is a rectangle of this half size with rounded corners, m.
HALF_X, HALF_Y = 250.0, 125.0
RADIUS, EASING = 80.0, 40.0
MEDIAN, SHOULDER = 1.5, 2.0
BEND_SPEED, INTERCHANGE_SPEED, STRAIGHT_SPEED = 60.0, 80.0, 100.0
RAMP_SPEED, LOCAL_SPEED = 40.0, 50.0
# The third lane reaches this far to either side of the middle; its ramps take so much more, m.
THIRD_LANE, RAMP_ZONE = 50.0, 60.0
# Where a ramp meets its zone: further out than the third lane (m), at this angle (rad).
RAMP_ASIDE, RAMP_ANGLE = 3.0, 0.1
# Crossings of highway and local road: from the middle to the arms of either, m.
HIGHWAY_ROOM, CROSSING_ROOM, LOCAL_ROOM = 13.0, 17.0, 13.0
SOUTH_ROAD_Y, RAMP_X, BULGE = -190.0, 155.0, 48.0


@dataclasses.dataclass(frozen=True)
class Oval:
    """The roads of the dual carriageway, counter-clockwise from the western crossing."""

    southwest: Road
    south: Road
    southeast: Road
    northeast: Road
    northwest: Road


def build() -> Town:
    """The whole town."""
    town = Town("highway")
    oval = _add_oval(town)
    outer = _add_outer_road(town)
    inner = _add_inner_street(town)
    ramps = _add_ramps(town)
    for joins_at_end, road in (("start", oval.southwest), ("end", oval.southeast)):
        _add_ramp_zone(town, joins_at_end, road, oval.south, ramps)
    _add_ramp_ends(town, outer, inner, ramps)
    for contacts, parts in (
        (("start", "end", "start", "start"), (oval.southwest, oval.northwest, outer[0], inner[0])),
        (("end", "start", "end", "end"), (oval.southeast, oval.northeast, outer[2], inner[2])),
    ):
        arms = [Arm(road, contact) for road, contact in zip(parts, contacts, strict=True)]
        _add_crossing(town, arms)
    signs.add_speed_signs(town)
    return town


def _carriageways(lanes: int) -> Section:
    side = (
        lane("median", MEDIAN, YELLOW),
        *[lane("driving", LANE_WIDTH, BROKEN)] * (lanes - 1),
        lane("driving", LANE_WIDTH, SOLID),
        lane("shoulder", SHOULDER),
    )
    return Section(0.0, side, side)


def _add_oval(town: Town) -> Oval:
    end = THIRD_LANE + RAMP_ZONE
    middle = geometry.turn(Pose(-THIRD_LANE, -HALF_Y, 0.0), Pose(THIRD_LANE, -HALF_Y, 0.0))
    west = Pose(-HALF_X, 0.0, -math.pi / 2)
    east = Pose(HALF_X, 0.0, math.pi / 2)
    # The northern bends end where the straight between them begins, with its higher limit.
    straight = HALF_X - RADIUS - EASING
    northeast = Pose(straight, HALF_Y, math.pi)
    northwest = Pose(-straight, HALF_Y, math.pi)
    plans: tuple[tuple[Path, int, float], ...] = (
        (_rounded(west.ahead(HIGHWAY_ROOM), Pose(-end, -HALF_Y, 0.0)), 2, BEND_SPEED),
        (middle, 3, INTERCHANGE_SPEED),
        (_rounded(Pose(end, -HALF_Y, 0.0), east.ahead(-HIGHWAY_ROOM)), 2, BEND_SPEED),
        (_rounded(east.ahead(HIGHWAY_ROOM), northeast), 2, BEND_SPEED),
        (geometry.turn(northeast, northwest), 2, STRAIGHT_SPEED),
        (_rounded(northwest, west.ahead(-HIGHWAY_ROOM)), 2, BEND_SPEED),
    )
    roads = [
        town.add_road(path, [_carriageways(lanes)], speed, kind="motorway")
        for path, lanes, speed in plans
    ]
    join_roads(roads[3], roads[4])
    join_roads(roads[4], roads[5])
    return Oval(roads[0], roads[1], roads[2], roads[3], roads[5])


def _rounded(start: Pose, goal: Pose) -> Path:
    return geometry.bend(start, goal, RADIUS, EASING)


def _local(walk: bool) -> Section:
    edge = (lane("shoulder", 1.0), lane("sidewalk", 2.0)) if walk else (lane("shoulder", 1.5),)
    side = (lane("driving", LANE_WIDTH, SOLID), *edge)
    return Section(0.0, side, side, YELLOW if walk else CENTRE_BROKEN)


def _add_outer_road(town: Town) -> list[Road]:
    """The road around the south, from the western crossing to the eastern one, cut at its ramps."""
    out = HALF_X + CROSSING_ROOM
    stop = RAMP_X + LOCAL_ROOM
    paths = (
        geometry.wind(
            Pose(-out, 0.0, math.pi),
            Pose(-out - BULGE, -90.0, -math.pi / 2),
            Pose(-stop, SOUTH_ROAD_Y, 0.0),
        ),
        geometry.wind(
            Pose(-RAMP_X + LOCAL_ROOM, SOUTH_ROAD_Y, 0.0),
            Pose(0.0, SOUTH_ROAD_Y - 8.0, 0.0),
            Pose(RAMP_X - LOCAL_ROOM, SOUTH_ROAD_Y, 0.0),
        ),
        geometry.wind(
            Pose(stop, SOUTH_ROAD_Y, 0.0),
            Pose(out + BULGE, -90.0, math.pi / 2),
            Pose(out, 0.0, math.pi),
        ),
    )
    return [town.add_road(path, [_local(False)], LOCAL_SPEED, kind="rural") for path in paths]


def _add_inner_street(town: Town) -> list[Road]:
    """The street inside the oval from west to east, cut at its ramps."""
    ends = (-HALF_X + CROSSING_ROOM, -RAMP_X, RAMP_X, HALF_X - CROSSING_ROOM)
    rooms = (0.0, LOCAL_ROOM, LOCAL_ROOM, 0.0)
    roads = []
    for index in range(3):
        start = Pose(ends[index] + rooms[index], 0.0, 0.0)
        goal = Pose(ends[index + 1] - rooms[index + 1], 0.0, 0.0)
        via = [Pose(0.0, 12.0, 0.0)] if index == 1 else []
        path = geometry.wind(start, *via, goal)
        roads.append(town.add_road(path, [_local(True)], LOCAL_SPEED))
    return roads


def _add_ramps(town: Town) -> dict[tuple[str, str], Road]:
    """The four ramps by side ("out", "in") and end of the third lane ("start" west, "end" east)."""
    edge = MEDIAN + 3 * LANE_WIDTH
    aside = edge - LANE_WIDTH + RAMP_ASIDE
    zone = THIRD_LANE + RAMP_ZONE
    outer_y, inner_y = -HALF_Y - aside, -HALF_Y + aside
    south, north = SOUTH_ROAD_Y + LOCAL_ROOM, -LOCAL_ROOM
    up, down = math.pi / 2, -math.pi / 2
    ends = {
        ("out", "start"): (Pose(-RAMP_X, south, up), Pose(-zone, outer_y, RAMP_ANGLE)),
        ("out", "end"): (Pose(zone, outer_y, -RAMP_ANGLE), Pose(RAMP_X, south, down)),
        ("in", "start"): (
            Pose(-zone, inner_y, math.pi - RAMP_ANGLE),
            Pose(-RAMP_X, north, up),
        ),
        ("in", "end"): (Pose(RAMP_X, north, down), Pose(zone, inner_y, math.pi + RAMP_ANGLE)),
    }
    section = Section(
        0.0,
        (lane("shoulder", 1.0),),
        (lane("driving", LANE_WIDTH, SOLID), lane("shoulder", 1.5)),
        YELLOW,
    )
    return {
        key: town.add_road(geometry.wind(start, goal), [section], RAMP_SPEED, kind="motorway")
        for key, (start, goal) in ends.items()
    }


def _add_ramp_zone(
    town: Town, contact: str, road: Road, third: Road, ramps: dict[tuple[str, str], Road]
) -> None:
    """The junction at one end of the third lane: two carriageways, a ramp in and a ramp out.

    Args:
      town: gets the junction.
      contact: the end of the third lane.
      road: the highway beyond, with two lanes.
      third: the highway with three lanes.
      ramps: all of them.
    """
    main, wide = Arm(road, "end" if contact == "start" else "start"), Arm(third, contact)
    # Outside traffic runs eastwards: its ramp joins at the west. Inside it is the other way round.
    side = ("out", "in") if contact == "start" else ("in", "out")
    joining = Arm(ramps[side[0], contact], "end")
    leaving = Arm(ramps[side[1], contact], "start")
    junction = add_junction(town, [main, wide, joining, leaving])
    into, away = main.driving(True), wide.driving(False)
    connect(town, junction, into, away[:2], (main, wide))
    connect(town, junction, into[1:], away[2:], (main, wide), edge=(SHOULDER, 0.0))
    connect(town, junction, joining.driving(True), away[2:], (joining, wide), outside=True)
    into, away = wide.driving(True), main.driving(False)
    connect(town, junction, into[:2], away, (wide, main))
    connect(town, junction, into[2:], away[1:], (wide, main), edge=(0.0, SHOULDER))
    connect(town, junction, into[2:], leaving.driving(False), (wide, leaving), outside=True)


def _add_ramp_ends(
    town: Town, outer: list[Road], inner: list[Road], ramps: dict[tuple[str, str], Road]
) -> None:
    """The four junctions where ramps meet local roads: a stop sign, lights, and right of way."""
    for side, locals_ in (("out", outer), ("in", inner)):
        for index, contact in enumerate(("start", "end")):
            leads_in = (side, contact) in (("out", "start"), ("in", "end"))
            ramp = Arm(ramps[side, contact], "start" if leads_in else "end")
            arms = [Arm(locals_[index], "end"), Arm(locals_[index + 1], "start"), ramp]
            junction = add_junction(town, arms)
            connect_all(town, junction)
            _control_ramp_end(town, junction, arms, side, leads_in)


def _control_ramp_end(
    town: Town, junction: Junction, arms: list[Arm], side: str, leads_in: bool
) -> None:
    with_traffic = arms[:2] if leads_in else arms
    if side == "in":
        signs.add_lights(town, junction, [[arm] for arm in with_traffic])
        for arm in with_traffic:
            signs.add_stop_line(town, arm)
        signs.add_crosswalk(town, arms[0], junction.connections)
    elif not leads_in:
        signs.add_sign(town, arms[2], junction.connections, signs.STOP)
        signs.add_stop_line(town, arms[2])


def _add_crossing(town: Town, arms: list[Arm]) -> None:
    """Highway and local road cross at a light: the highway together, then either local arm."""
    junction = add_junction(town, arms)
    connect_all(town, junction)
    signs.add_lights(town, junction, [arms[:2], arms[2:3], arms[3:]])
    for arm in arms:
        signs.add_stop_line(town, arm)
    for arm in arms[2:]:
        signs.add_crosswalk(town, arm, junction.connections)
