"""Towns small enough to work out by hand: lanes from points, a straight road, a crossing.

The crossing has its middle at the origin and arms to the east, north, west and south, each with one
lane of 3.5 m each way, kept to the right. Inside the square of 20 m around the origin lie twelve
lanes: from each arm straight on (20 m), left (an arc of radius 11.75 m) and right (8.25 m).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from carljax.sim.road_network import Controller, Governed, Junction, Lane, RoadNetwork, Signal

WIDTH = 3.5
HALF = 10.0  # m, from the middle of the crossing to where its arms begin
ARM = 80.0  # m, length of an arm
LIMIT = 10.0  # m/s
ARMS = ("east", "north", "west", "south")
LEFT_RADIUS, RIGHT_RADIUS = HALF + WIDTH / 2, HALF - WIDTH / 2


def lane(xy, yaw=None, z=0.0, **fields) -> Lane:
    """A driving lane through the given points; yaw is that of its pieces where none is given."""
    xy = np.asarray(xy, float)
    pieces = np.diff(xy, axis=0)
    if yaw is None:
        along = np.unwrap(np.arctan2(pieces[:, 1], pieces[:, 0]))
        yaw = np.append(along, along[-1])
    values = {
        "road_id": "1",
        "section": 0,
        "lane_id": -1,
        "kind": "driving",
        "xyz": np.column_stack([xy, np.full(len(xy), float(z))]),
        "width": np.full(len(xy), WIDTH),
        "s": np.concatenate([[0.0], np.cumsum(np.hypot(*pieces.T))]),
        "yaw": np.broadcast_to(np.asarray(yaw, float), len(xy)),
        "junction": None,
        "speed_limit": LIMIT,
    }
    return Lane(**values | fields)


def straight(start, end, spacing=1.0, **fields) -> Lane:
    """A straight lane."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    num = int(np.ceil(np.linalg.norm(end - start) / spacing)) + 1
    return lane(start + np.linspace(0, 1, num)[:, None] * (end - start), **fields)


def arc(start, yaw, radius, angle, num=41, **fields) -> Lane:
    """A bend from a pose through an angle, positive to the left."""
    turned = np.linspace(0.0, angle, num)
    side = np.sign(angle)
    centre = np.asarray(start, float) + side * radius * np.array([-np.sin(yaw), np.cos(yaw)])
    at = yaw + turned
    xy = centre + side * radius * np.stack([np.sin(at), -np.cos(at)], axis=-1)
    return lane(xy, yaw=at, **fields)


def link(lanes, pairs):
    """Lanes with the given (from, to) links."""
    return tuple(
        dataclasses.replace(
            one,
            successors=tuple(b for a, b in pairs if a == i),
            predecessors=tuple(a for a, b in pairs if b == i),
        )
        for i, one in enumerate(lanes)
    )


def signal(name, kind, governed, value=None, xy=(0.0, 0.0)) -> Signal:
    """A signal that governs (lane, distance) places."""
    places = tuple(Governed(number, float(distance)) for number, distance in governed)
    return Signal(name, kind, "", name, np.array([*xy, 0.0]), 0.0, value, places)


def network(lanes, signals=(), controllers=(), junctions=(), **fields) -> RoadNetwork:
    """A road network of lanes that are linked already."""
    values = {
        "name": "small",
        "left_hand_traffic": False,
        "lanes": tuple(lanes),
        "marks": (),
        "signals": tuple(signals),
        "controllers": {c.id: c for c in controllers},
        "junctions": {j.id: j for j in junctions},
        "crosswalks": (),
        "stop_lines": (),
    }
    return RoadNetwork(**values | fields)


def road(*cuts, **fields) -> RoadNetwork:
    """A straight road to the east, one lane, in pieces between the given x."""
    pieces = [straight((a, 0), (b, 0)) for a, b in zip(cuts[:-1], cuts[1:], strict=True)]
    pairs = [(i, i + 1) for i in range(len(pieces) - 1)]
    return network(link(pieces, pairs), **fields)


# Lanes of the crossing: approach and exit of arm k are 2 k and 2 k + 1, then three for each arm.
def approach(arm: str) -> int:
    """The lane on which cars come from an arm."""
    return 2 * ARMS.index(arm)


def leaving(arm: str) -> int:
    """The lane on which cars leave by an arm."""
    return 2 * ARMS.index(arm) + 1


def inner(arm: str, way: str) -> int:
    """The lane inside the crossing from an arm: "straight", "left" or "right"."""
    return 8 + 3 * ARMS.index(arm) + ("straight", "left", "right").index(way)


def crossing(signs=(), groups=(), priority=(), mirrored=False) -> RoadNetwork:
    """The crossing of the module docstring.

    Args:
      signs: {arm: "light", "stop" or "yield"}; each holds at the arm's three lanes inside.
      groups: tuples of arms whose lights switch together, in the order they are served.
      priority: (high arm, low arm) pairs.
      mirrored: keep to the left instead; "left" and "right" change places.
    """
    lanes, pairs = [], []
    for k in range(4):
        out = k * np.pi / 2
        u, side = np.array([np.cos(out), np.sin(out)]), np.array([np.sin(out), -np.cos(out)])
        lanes += [
            straight((HALF + ARM) * u - WIDTH / 2 * side, HALF * u - WIDTH / 2 * side),
            straight(HALF * u + WIDTH / 2 * side, (HALF + ARM) * u + WIDTH / 2 * side),
        ]
    for k, arm in enumerate(ARMS):
        begin, yaw = lanes[approach(arm)].xyz[-1, :2], lanes[approach(arm)].yaw[-1]
        fields = {"junction": "9", "road_id": arm}
        end = lanes[leaving(ARMS[(k + 2) % 4])].xyz[0, :2]
        lanes += [
            straight(begin, end, **fields),
            arc(begin, yaw, LEFT_RADIUS, np.pi / 2, **fields),
            arc(begin, yaw, RIGHT_RADIUS, -np.pi / 2, **fields),
        ]
        for way, turned in (("straight", 2), ("left", 3), ("right", 1)):
            exits = leaving(ARMS[(k + turned) % 4])
            pairs += [(approach(arm), inner(arm, way)), (inner(arm, way), exits)]
    if mirrored:
        lanes = [
            dataclasses.replace(x, xyz=x.xyz * np.array([1, -1, 1]), yaw=-x.yaw) for x in lanes
        ]
    inside = ("straight", "left", "right")
    signals = [
        signal(arm, kind, [(inner(arm, way), 4.0) for way in inside])
        for arm, kind in dict(signs).items()
    ]
    controllers = [Controller("+".join(group), i, tuple(group)) for i, group in enumerate(groups)]
    order = tuple(c.id for c in controllers)
    junction = Junction("9", order, tuple(range(8, 20)), tuple(priority))
    return network(
        link(lanes, pairs),
        signals,
        controllers,
        [junction],
        name="crossing",
        left_hand_traffic=mirrored,
    )
