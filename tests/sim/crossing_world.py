"""A town small enough to know by heart: two straight roads that cross at the origin.

Both roads have one lane of 3.5 m each way, keep to the right and run 100 m from the crossing, which is
the square of 20 m around the origin. The road along x has a broken centre line, solid outer lines and,
south of its western arm, a shoulder of 2 m; the road along y has a parking lane of 2 m on its east side,
north of the crossing. There is no paint inside the crossing.
"""

from __future__ import annotations

import numpy as np

from carljax.sim.road_network import MARK_BROKEN, MARK_SOLID, Lane, RoadMark, RoadNetwork


def lane(start, end, width=3.5, kind="driving", junction=None) -> Lane:
    """A straight lane with a point every metre or so."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    num = int(np.ceil(np.linalg.norm(end - start))) + 1
    xy = start + np.linspace(0, 1, num)[:, None] * (end - start)
    yaw = np.full(num, np.arctan2(*(end - start)[::-1]))
    return Lane(
        road_id="1",
        section=0,
        lane_id=-1,
        kind=kind,
        xyz=np.column_stack([xy, np.zeros(num)]),
        width=np.full(num, float(width)),
        s=np.linspace(0, np.linalg.norm(end - start), num),
        yaw=yaw,
        junction=junction,
        speed_limit=None,
    )


def mark(start, end, kind) -> RoadMark:
    return RoadMark(np.array([start, end], float), kind, "white")


def network() -> RoadNetwork:
    """The town of the module docstring."""
    lanes, marks = [], []
    for a, b, junction in ((-110, -10, None), (-10, 10, "9"), (10, 110, None)):
        lanes += [
            lane((a, -1.75), (b, -1.75), junction=junction),
            lane((b, 1.75), (a, 1.75), junction=junction),
            lane((1.75, a), (1.75, b), junction=junction),
            lane((-1.75, b), (-1.75, a), junction=junction),
        ]
    for a, b in ((-110, -10), (10, 110)):
        marks += [mark((a, 0), (b, 0), MARK_BROKEN), mark((a, 3.5), (b, 3.5), MARK_SOLID)]
        marks += [mark((a, -3.5), (b, -3.5), MARK_SOLID)]
    lanes += [
        lane((-110, -4.5), (-10, -4.5), width=2.0, kind="shoulder"),
        lane((4.5, 10), (4.5, 110), width=2.0, kind="parking"),
        lane((-110, 20), (-10, 20), width=2.0, kind="sidewalk"),
    ]
    return RoadNetwork(
        name="crossing",
        left_hand_traffic=False,
        lanes=tuple(lanes),
        marks=tuple(marks),
        signals=(),
        controllers={},
        junctions={},
        crosswalks=(),
        stop_lines=(),
    )
