"""Lights, signs, crosswalks and stop lines, laid out as CARLA's towns do it.

A light or sign stands on the arm's own road with a validity of no lane; a reference at the entry
of every connecting road says which lanes it holds.
"""

from __future__ import annotations

import math

from towns.plan import Arm, Connection, Junction, Road, Town

LIGHT, STOP, YIELD, SPEED = "1000001", "206", "205", "274"
NAMES = {LIGHT: "Signal_3Light_Post01", STOP: "Sign_Stop", YIELD: "Sign_Yield", SPEED: "Speed"}
# How far outside the carriageway a post stands, m.
POST_ASIDE = 0.6
# Speed signs stand this far behind the junction, m.
SPEED_SIGN_BEHIND = 8.0
CROSSWALK_FROM, CROSSWALK_TO = 1.0, 3.5


def _from_junction(arm: Arm, distance: float) -> tuple[float, str]:
    """(s, orientation of the traffic that drives in) at a distance before the junction."""
    if arm.contact == "end":
        return arm.road.length - distance, "+"
    return distance, "-"


def _right_edge(arm: Arm, incoming: bool) -> float:
    """Distance of the last driving lane's outer border from the reference line, m."""
    lanes = arm.lanes(incoming)
    last = max(i for i, each in enumerate(lanes) if each.spec.kind == "driving")
    return sum(each.width for each in lanes[: last + 1])


def add_sign(town: Town, arm: Arm, connections: list[Connection], kind: str) -> int:
    """A light, stop or yield sign that holds everything the arm sends into the junction.

    Args:
      town: hands out the id.
      arm: where the post stands.
      connections: the junction's connecting roads; those of other arms are left out.
      kind: LIGHT, STOP or YIELD.

    Returns:
      The signal's id.
    """
    signal_id = town.next_id()
    s, orientation = _from_junction(arm, 0.5)
    aside = _right_edge(arm, True) + POST_ASIDE
    arm.road.signals.append(
        {
            "id": signal_id,
            "type": kind,
            "s": s,
            "t": -aside if orientation == "+" else aside,
            "orientation": orientation,
            "validity": (0, 0),
        }
    )
    for connection in connections:
        if connection.arm_in is arm:
            connection.road.references.append(
                {"id": signal_id, "s": 0.0, "t": 0.0, "validity": (-len(connection.lanes_in), -1)}
            )
    return signal_id


def add_lights(town: Town, junction: Junction, groups: list[list[Arm]]) -> None:
    """A light at every arm; each group of arms gets a controller, served in the given order."""
    for group in groups:
        controller = town.next_id()
        town.controllers[controller] = [
            add_sign(town, arm, junction.connections, LIGHT) for arm in group
        ]
        junction.controllers.append(controller)


def add_speed_sign(town: Town, road: Road, along: bool) -> None:
    """A speed-limit sign just behind the start of one direction of the road."""
    contact = "start" if along else "end"
    arm = Arm(road, contact)
    lanes = arm.driving(False)
    s, _ = _from_junction(arm, min(SPEED_SIGN_BEHIND, road.length / 2))
    aside = _right_edge(arm, False) + POST_ASIDE
    ids = [each.id for each in lanes]
    road.signals.append(
        {
            "id": town.next_id(),
            "type": SPEED,
            "s": s,
            "t": -aside if along else aside,
            "orientation": "+" if along else "-",
            "validity": (min(ids), max(ids)),
            "value": road.speed,
        }
    )


def add_speed_signs(town: Town) -> None:
    """A speed-limit sign for every direction of every road outside the junctions."""
    for road in town.roads:
        if road.junction is None:
            for along, contact in ((True, "start"), (False, "end")):
                if Arm(road, contact).driving(False):
                    add_speed_sign(town, road, along)


def add_crosswalk(town: Town, arm: Arm, connections: list[Connection]) -> None:
    """A crosswalk across the arm, just inside the junction behind the stop line."""
    road, start = next(
        (each.road, each.road.path[0].start) for each in connections if each.arm_in is arm
    )
    widths = [
        sum(each.width for each in arm.lanes(incoming) if each.spec.kind != "sidewalk")
        for incoming in (True, False)
    ]
    # The object lies in the frame of the connecting road's start, which looks as the arm does.
    _, left, _ = start.seen_from(arm.pose)
    corners = [
        (CROSSWALK_FROM, -widths[0] - left),
        (CROSSWALK_TO, -widths[0] - left),
        (CROSSWALK_TO, widths[1] - left),
        (CROSSWALK_FROM, widths[1] - left),
    ]
    road.objects.append(
        {
            "id": town.next_id(),
            "name": "SimpleCrosswalk",
            "type": "crosswalk",
            "s": 0.0,
            "t": 0.0,
            "hdg": 0.0,
            "length": CROSSWALK_TO - CROSSWALK_FROM,
            "width": sum(widths),
            "corners": corners,
        }
    )


def add_stop_line(town: Town, arm: Arm) -> None:
    """A stop line across the incoming lanes at the very end of the arm."""
    lanes = arm.driving(True)
    edge = _right_edge(arm, True)
    width = sum(each.width for each in lanes)
    s, orientation = _from_junction(arm, 0.2)
    middle = edge - width / 2
    arm.road.objects.append(
        {
            "id": town.next_id(),
            "name": "StopLine",
            "type": "roadMark",
            "s": s,
            "t": -middle if orientation == "+" else middle,
            "hdg": math.pi / 2,
            "length": width,
            "width": 0.4,
            "orientation": orientation,
        }
    )
