"""A town small enough to know by heart: two straight roads that cross at the origin.

Both roads have one lane of 3.5 m each way, keep to the right and run 100 m from the crossing, which
is the square of 20 m around the origin. The road along x has a broken centre line, solid outer
lines and, south of its western arm, a shoulder of 2 m; the road along y has a parking lane of 2 m
on its east side, north of the crossing. There is no paint inside the crossing.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from carljax.sim import atlas
from carljax.sim.population import nobody
from carljax.sim.road_map import RoadMap
from carljax.sim.road_network import MARK_BROKEN, MARK_SOLID, Lane, RoadMark, RoadNetwork
from carljax.sim.route import Route
from carljax.sim.types import Agents, EgoState


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


def road_map() -> RoadMap:
    """Two towns in one place, one empty, one the crossing; only what the rasterizer reads."""
    net = network()
    origin, shape = atlas.frame(net)
    layers = np.stack([np.zeros(shape, np.uint8), atlas.layers(net, origin, shape)])
    rest = {field.name: jnp.zeros(0) for field in dataclasses.fields(RoadMap)}
    return with_pictures(RoadMap(**rest), layers, np.array([origin, origin]))


def with_pictures(road_map: RoadMap, layers: np.ndarray, origin: np.ndarray) -> RoadMap:
    """A map with other pictures: layers (M, H, W) uint8, origin (M, 2) m."""
    towns = range(len(layers))
    return road_map.replace(
        layers=jnp.asarray(layers.reshape(-1)),
        picture_start=jnp.asarray([town * layers[0].size for town in towns], jnp.int32),
        picture_size=jnp.asarray([layers[0].shape for _ in towns], jnp.int32),
        origin=jnp.asarray(origin, jnp.float32),
    )


def ego_at(x: float, y: float, yaw: float = 0.0, **rest: float) -> EgoState:
    """The ego; what isn't named is zero."""
    values = {field.name: jnp.float32(0.0) for field in dataclasses.fields(EgoState)}
    values |= {name: jnp.float32(value) for name, value in rest.items()}
    return EgoState(**values | {"xy": jnp.array([x, y], jnp.float32), "yaw": jnp.float32(yaw)})


def agents_of(*users: dict[str, float], slots: int = 8) -> Agents:
    """Road users by x, y, yaw, length, width, kind, speed, ...; other slots are empty."""

    def column(name: str) -> np.ndarray:
        return np.array([user.get(name, 0.0) for user in users] + [0.0] * (slots - len(users)))

    empty = nobody(slots)
    given = {name for user in users for name in user} - {"x", "y"}
    values = {name: jnp.asarray(column(name), getattr(empty, name).dtype) for name in given}
    xy = jnp.asarray(np.stack([column("x"), column("y")], axis=-1), jnp.float32)
    return empty.replace(xy=xy, **values)


def route_east(start: float = -100.0, num: int = 201, **rest) -> Route:
    """A route along y = -1.75 with a point a metre, through the crossing, in town 1."""
    x = start + np.arange(num)
    values = {field.name: np.zeros(num) for field in dataclasses.fields(Route)}
    values |= {
        "xy": np.stack([x, np.full(num, -1.75)], axis=-1),
        "s": x - start,
        "speed_limit": np.full(num, 8.0),
        "in_junction": np.abs(x) <= 10.0,
        "num_points": np.int32(num),
        "length": np.float32(num - 1),
        "town": np.int32(1),
        "stop_idx": np.full(4, -1, np.int32),
        "stop_xy": np.zeros((4, 2)),
        "stop_yaw": np.zeros(4),
        "stop_s": np.zeros(4),
        "stop_kind": np.zeros(4, np.int32),
        "stop_light": np.full(4, -1, np.int32),
        "stop_width": np.zeros(4),
        "sign_xy": np.zeros((3, 2)),
        "sign_idx": np.full(3, -1, np.int32),
        "sign_limit": np.zeros(3),
    } | rest
    floats = {name: v.astype(np.float32) for name, v in values.items() if v.dtype == np.float64}
    return Route(**{name: jnp.asarray(value) for name, value in (values | floats).items()})
