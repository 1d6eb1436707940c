"""The scenes of `bev_scene` as carljax draws them: many at once, frame after frame."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import bev_scene
import jax
import jax.numpy as jnp
import numpy as np
from bev_scene import LANE_WIDTH, REACH, SHOULDER_WIDTH, Road, Scene, Users
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from carljax.sim import atlas, rasterizer
from carljax.sim.population import nobody
from carljax.sim.raster_canvas import RasterConfig
from carljax.sim.road_map import PIXELS_PER_METRE, RoadMap
from carljax.sim.road_network import MARK_BROKEN, MARK_SOLID, Lane, RoadMark, RoadNetwork
from carljax.sim.route import Route
from carljax.sim.types import (
    KIND_PEDESTRIAN,
    KIND_STATIC,
    KIND_VEHICLE,
    LIGHT_GREEN,
    LIGHT_RED,
    LIGHT_YELLOW,
    STOP_LIGHT,
    STOP_SIGN,
    Agents,
    EgoState,
)

CONFIG = RasterConfig(
    height=bev_scene.HEIGHT,
    width=bev_scene.WIDTH,
    pixels_per_metre=bev_scene.PIXELS_PER_METRE,
    ego_from_bottom_px=bev_scene.EGO_FROM_BOTTOM,
)
_KINDS = {
    bev_scene.VEHICLE: KIND_VEHICLE,
    bev_scene.PEDESTRIAN: KIND_PEDESTRIAN,
    bev_scene.STATIC: KIND_STATIC,
}
_LIGHTS = {
    bev_scene.GREEN: LIGHT_GREEN,
    bev_scene.YELLOW: LIGHT_YELLOW,
    bev_scene.RED: LIGHT_RED,
}
_STOPS = {bev_scene.LIGHT: STOP_LIGHT, bev_scene.STOP: STOP_SIGN}


class Seen(NamedTuple):
    """What `rasterizer.render` is given besides the map; see there."""

    ego: EgoState
    agents: Agents
    route: Route
    light_state: jax.Array
    light_time_left: jax.Array


def frames(road_map: RoadMap, seen: Seen, turn: jax.Array, num_steps: int) -> jax.Array:
    """Draws frame after frame of several scenes; only the ego turns a little from one to the next.

    Args:
      road_map: the map.
      seen: (B,) scenes.
      turn: () rad from frame to frame; the first one is turned already.
      num_steps: frames of each scene.

    Returns:
      (B, H, W, 10) uint8, the last frames.
    """

    def draw(seen: Seen, turned: jax.Array) -> jax.Array:
        return rasterizer.render(
            seen.ego.replace(yaw=seen.ego.yaw + turned),
            seen.agents,
            road_map,
            seen.route,
            jnp.int32(bev_scene.ROUTE_IDX),
            seen.light_state,
            seen.light_time_left,
            jnp.zeros(seen.light_state.shape, bool),
            CONFIG,
        )

    def frame(_: jax.Array, number: jax.Array) -> tuple[jax.Array, None]:
        turned = turn * (number + 1).astype(jnp.float32)
        return jax.vmap(draw, in_axes=(0, None))(seen, turned), None

    num = seen.ego.yaw.shape[0]
    begin = jnp.zeros((num, *CONFIG.shape), jnp.uint8)
    return jax.lax.scan(frame, begin, jnp.arange(num_steps))[0]


def shared(
    num_steps: int, devices: Sequence[jax.Device], *given: Any
) -> tuple[Callable[..., jax.Array], tuple[Any, ...]]:
    """`frames` on several devices, each with its share of the scenes.

    Args:
      num_steps: frames of each scene.
      devices: as many as divide the scenes.
      *given: the other arguments of `frames`.

    Returns:
      The function, to be compiled, and its arguments, where they belong.
    """
    mesh = Mesh(np.array(devices), ("scenes",))
    specs = (PartitionSpec(), PartitionSpec("scenes"), PartitionSpec())
    function = jax.shard_map(
        functools.partial(frames, num_steps=num_steps),
        mesh=mesh,
        in_specs=specs,
        out_specs=PartitionSpec("scenes"),
        check_vma=False,
    )
    return function, jax.device_put(given, tuple(NamedSharding(mesh, spec) for spec in specs))


def road_map(roads: Sequence[Road]) -> RoadMap:
    """The roads as one town; only what the rasterizer reads is there."""
    lanes, marks = [], []
    for road in roads:
        lanes += [_lane(road, side * LANE_WIDTH / 2, LANE_WIDTH, "driving") for side in (-1, 1)]
        beside = LANE_WIDTH + SHOULDER_WIDTH / 2
        lanes += [_lane(road, side * beside, SHOULDER_WIDTH, "shoulder") for side in (-1, 1)]
        marks += [RoadMark(road.aside(a), MARK_SOLID, "white") for a in (-LANE_WIDTH, LANE_WIDTH)]
        marks.append(RoadMark(road.xy, MARK_BROKEN, "white"))
    network = RoadNetwork(
        name="roads",
        left_hand_traffic=False,
        lanes=tuple(lanes),
        marks=tuple(marks),
        signals=(),
        controllers={},
        junctions={},
        crosswalks=(),
        stop_lines=(),
    )
    origin, side = np.array([-REACH, -REACH]), int(2 * REACH * PIXELS_PER_METRE) + 1
    layers = atlas.layers(network, origin, (side, side))
    rest = {field.name: jnp.zeros(0) for field in dataclasses.fields(RoadMap)}
    picture = {
        "layers": jnp.asarray(layers.reshape(-1)),
        "picture_start": jnp.zeros(1, jnp.int32),
        "picture_size": jnp.asarray([layers.shape], jnp.int32),
        "origin": jnp.asarray(origin[None], jnp.float32),
    }
    return RoadMap(**{**rest, **picture})


def stack(scenes: Sequence[Scene]) -> Seen:
    """(B,) scenes side by side."""
    return jax.tree.map(lambda *x: jnp.stack(x), *[_seen(scene) for scene in scenes])


def _lane(road: Road, aside: float, width: float, kind: str) -> Lane:
    num = len(road.xy)
    return Lane(
        road_id="1",
        section=0,
        lane_id=-1,
        kind=kind,
        xyz=np.column_stack([road.aside(aside), np.zeros(num)]),
        width=np.full(num, width),
        s=np.arange(float(num)),
        yaw=road.yaw,
        junction=None,
        speed_limit=None,
    )


def _seen(scene: Scene) -> Seen:
    num = len(scene.stop_idx)
    zero = {field.name: jnp.zeros((), jnp.float32) for field in dataclasses.fields(EgoState)}
    place = {"xy": _float(scene.ego_xy), "yaw": _float(scene.ego_yaw)}
    return Seen(
        ego=EgoState(**{**zero, **place}),
        agents=_agents(scene.users),
        route=_route(scene),
        light_state=_as(_LIGHTS, scene.light),
        light_time_left=jnp.full(num, scene.yellow_left, jnp.float32),
    )


def _agents(users: Users) -> Agents:
    """Signals have the same bits on both sides."""
    return nobody(len(users.kind)).replace(
        kind=_as(_KINDS, users.kind),
        xy=_float(users.xy),
        yaw=_float(users.yaw),
        length=_float(users.length),
        width=_float(users.width),
        speed=_float(users.speed),
        signals=jnp.asarray(users.signals, jnp.int32),
    )


def _route(scene: Scene) -> Route:
    num = len(scene.route_xy)
    values = {field.name: jnp.zeros(num, jnp.float32) for field in dataclasses.fields(Route)}
    values |= {
        "xy": _float(scene.route_xy),
        "yaw": _float(scene.route_yaw),
        "in_junction": jnp.asarray(scene.in_junction),
        "num_points": jnp.int32(num),
        "town": jnp.int32(0),
        "stop_idx": jnp.asarray(scene.stop_idx, jnp.int32),
        "stop_xy": _float(scene.route_xy[scene.stop_idx]),
        "stop_yaw": _float(scene.route_yaw[scene.stop_idx]),
        "stop_width": _float(scene.stop_width),
        "stop_kind": _as(_STOPS, scene.stop_kind),
        "sign_idx": jnp.asarray(scene.sign_idx, jnp.int32),
        "sign_xy": _float(scene.sign_xy),
        "sign_limit": _float(scene.sign_limit),
    }
    return Route(**values)


def _float(values: np.ndarray | float) -> jax.Array:
    return jnp.asarray(values, jnp.float32)


def _as(names: dict[int, int], values: np.ndarray) -> jax.Array:
    return jnp.asarray([names[int(value)] for value in values], jnp.int32)
