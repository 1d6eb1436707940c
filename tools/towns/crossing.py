"""Junctions: which lane leads where, and the roads that join them."""

from __future__ import annotations

import math
from collections.abc import Callable

from towns import geometry
from towns.geometry import Path, Pose, wrap
from towns.plan import (
    Arm,
    ArmLane,
    Connection,
    Cubic,
    Junction,
    LaneSpec,
    Road,
    Section,
    Town,
    ease,
)

# Less than this between the directions of two arms and the way is straight on.
STRAIGHT = math.radians(40.0)


def add_junction(town: Town, arms: list[Arm], height: float = 0.0) -> Junction:
    """A junction without connections; names itself in the links of its arms.

    Args:
      town: gets the junction.
      arms: in any order.
      height: of the ground, m.
    """
    ordered = sorted(arms, key=lambda arm: wrap(arm.pose.yaw))
    junction = Junction(town.next_id(), tuple(ordered), height)
    town.junctions.append(junction)
    for arm in ordered:
        if arm.contact == "end":
            arm.road.after = ("junction", junction.id, None)
        else:
            arm.road.before = ("junction", junction.id, None)
    return junction


def connect(
    town: Town,
    junction: Junction,
    lanes_in: list[ArmLane],
    lanes_out: list[ArmLane],
    arms: tuple[Arm, Arm],
    fit: Callable[[Pose, Pose], Path] = geometry.turn,
    outside: bool = False,
    edge: tuple[float, float] | None = None,
) -> Road:
    """One connecting road for neighbouring lanes.

    Args:
      town: gets the road.
      junction: where it lies.
      lanes_in: neighbouring lanes of the first arm, from the inside outwards.
      lanes_out: as many of the second arm.
      arms: where it comes from and where it goes.
      fit: makes the reference line, which is the left border of the first lane.
      outside: whether shoulder and sidewalk go along.
      edge: width of a shoulder of its own at both ends, m.
    """
    path = fit(lanes_in[0].pose, lanes_out[0].pose)
    pairs = list(zip(lanes_in, lanes_out, strict=True))
    if outside:
        pairs += _same_kind(arms[0].outside(True), arms[1].outside(False))
    distance = geometry.length(path)
    specs = [LaneSpec(a.spec.kind, _width(a.width, b.width, distance)) for a, b in pairs]
    if edge:
        specs.append(LaneSpec("shoulder", _width(*edge, distance)))
    road = town.add_road(
        path,
        [Section(0.0, (), tuple(specs))],
        min(arms[0].road.speed, arms[1].road.speed),
        kind=arms[0].road.kind,
        junction=junction.id,
        heights=((0.0, junction.height, 0.0, 0.0, 0.0),) if junction.height else (),
    )
    road.before = ("road", arms[0].road.id, arms[0].contact)
    road.after = ("road", arms[1].road.id, arms[1].contact)
    for index, (a, b) in enumerate(pairs):
        if a.spec.kind == "driving":
            road.links[0, -index - 1] = (a.id, b.id)
    junction.connections.append(
        Connection(road, arms[0], arms[1], tuple(each.id for each in lanes_in))
    )
    return road


def _width(first: float, last: float, distance: float) -> tuple[Cubic, ...]:
    if abs(first - last) < 1e-9:
        return ((0.0, first, 0.0, 0.0, 0.0),)
    return (ease(0.0, first, last, distance),)


def _same_kind(first: list[ArmLane], second: list[ArmLane]) -> list[tuple[ArmLane, ArmLane]]:
    pairs = []
    for a, b in zip(first, second, strict=False):
        if a.spec.kind != b.spec.kind:
            break
        pairs.append((a, b))
    return pairs


def connect_all(town: Town, junction: Junction) -> None:
    """Joins every arm with every other: left from the left lane, right from the right one.

    Lanes that go straight on share one road. The way along the outside of the junction carries
    shoulder and sidewalk.
    """
    arms = junction.arms
    for index, arm in enumerate(arms):
        lanes_in = arm.driving(True)
        if not lanes_in:
            continue
        # Arms are ordered by the direction they look in, so the next one lies to the right.
        neighbour = arms[(index + 1) % len(arms)]
        goals = [other for other in arms if other is not arm and other.driving(False)]
        angles = {id(goal): _angle(arm, goal) for goal in goals}
        for goal in goals:
            for some_in, some_out in _lane_pairs(lanes_in, goal, angles[id(goal)]):
                along = goal is neighbour and some_in[-1] is lanes_in[-1]
                connect(town, junction, some_in, some_out, (arm, goal), outside=along)


def _angle(arm: Arm, goal: Arm) -> float:
    return wrap(goal.pose.yaw + math.pi - arm.pose.yaw)


def _lane_pairs(
    lanes_in: list[ArmLane], goal: Arm, angle: float
) -> list[tuple[list[ArmLane], list[ArmLane]]]:
    lanes_out = goal.driving(False)
    if abs(angle) < STRAIGHT:
        count = min(len(lanes_in), len(lanes_out))
        return [(lanes_in[:count], lanes_out[:count])]
    if angle > 0:
        return [(lanes_in[:1], lanes_out[:1])]
    return [(lanes_in[-1:], lanes_out[-1:])]
