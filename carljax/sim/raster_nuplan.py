"""CaRL's bird's-eye view in nuPlan: nine byte channels around the ego, heading up.

Source: the authors' nuPlan code, paper, nuPlan input. The map comes from one rotated gather of
pixel kinds (`nuplan_atlas`) and one from a table of what each kind shows now, with its lights and
the route; boxes are scattered onto the image. The authors' array has ahead along its columns;
turned by a quarter it is this one.

Ours, not the authors': lines are 1 m wide (there 1 px), since a gather at 2 px/m could miss thinner
ones; where centre lines cross, the nearest one shows; of overlapping values of a channel the larger
stays; all road users in the image are drawn, not the 50 nearest; intersections are the junction's
lanes.
"""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np

from carljax.sim import lights, raster_road
from carljax.sim.nuplan_atlas import BORDER, DRIVABLE, STOP_LINE, NuplanAtlas
from carljax.sim.raster_canvas import GATHER, RasterConfig, box_pixels, pixel, poses, ray_pixels
from carljax.sim.raster_marks import draw_channel
from carljax.sim.raster_users import BUS_SIZE, CAR_SIZE, HEIGHT_REACH, NUM_LARGE
from carljax.sim.road_map import RoadMap
from carljax.sim.route import Route
from carljax.sim.types import (
    KIND_PEDESTRIAN,
    KIND_STATIC,
    KIND_VEHICLE,
    LIGHT_RED,
    LIGHT_YELLOW,
    Agents,
    EgoState,
    LightClock,
)

# source: the authors' code: 78 m ahead, 50 m behind, 64 m to either side
RASTER = RasterConfig(height=256, width=256, pixels_per_metre=2.0, ego_from_bottom_px=100)
CHANNELS = (
    "drivable",
    "route",
    "lane_borders",
    "lights",
    "stop_lines",
    "speed_limits",
    "vehicles",
    "pedestrians",
    "ego",
)
LINES = ("lane_borders", "lights", "stop_lines", "speed_limits")  # the others are areas
SPEED_MAX, WALK_SPEED_MAX = 30.0, 4.0  # m/s, of vehicles and limits, of pedestrians
STATIC_VALUE = 127
GREEN_VALUE, YELLOW_VALUE, RED_VALUE = 80, 170, 255
# The values other than 0 of those channels that have few; the others take any.
LEVELS = {
    **dict.fromkeys(("drivable", "route", "lane_borders", "stop_lines"), (255,)),
    "lights": (GREEN_VALUE, YELLOW_VALUE, RED_VALUE),
}
SPEED_LINE_S = 1.0  # s

_VEHICLES, _PEDESTRIANS, _EGO = (CHANNELS.index(x) for x in ("vehicles", "pedestrians", "ego"))


@dataclasses.dataclass(frozen=True)
class NuplanOptions:
    """Options of the observation `nuplan`."""

    stop_lines: bool = False
    """Draw all stop lines; the paper dropped them, and the code leaves their channel empty."""
    speed_line: bool = False
    """Draw a line from each mover's middle to a second's way ahead of its front; off in CaRL."""


def speed_value(speed: jax.Array, most: float) -> jax.Array:
    """The byte that stands for a speed: 127 at rest, 255 from `most` m/s on.

    Source: the authors' code: int(127.5 clip(v / most, 0, 1) + 127.5).

    Args:
      speed: (...) m/s.
      most: m/s.

    Returns:
      (...) int32 in 127 ... 255.
    """
    return (127.5 * jnp.clip(speed / most, 0.0, 1.0) + 127.5).astype(jnp.int32)


def render(
    ego: EgoState,
    ego_size: jax.Array,
    agents: Agents,
    road_map: RoadMap,
    atlas: NuplanAtlas,
    route: Route,
    episode_idx: jax.Array,
    clock: LightClock,
    options: NuplanOptions,
    config: RasterConfig,
) -> jax.Array:
    """Draws what the ego sees, itself included.

    Args:
      ego: pose of the image, heading up.
      ego_size: (2,) its length and width, m.
      agents: the other road users.
      road_map: lanes and lights.
      atlas: the static world.
      route: of this episode; names the town.
      episode_idx: () int32, row of the bank.
      clock: of the lights.
      options: what else is drawn.
      config: size.

    Returns:
      (H, W, 9) uint8; row 0 is farthest ahead, column 0 farthest to the left.
    """
    table = _table(road_map, atlas, route, episode_idx, clock, options)
    image = _static(ego, road_map, atlas, route, table, config)
    image = _road_users(image, ego, agents, config)
    image = _ego_box(image, ego, ego_size, config)
    if options.speed_line:
        image = _speed_lines(image, ego, ego_size, agents, config)
    return image.reshape(config.height, config.width, len(CHANNELS))


def _table(
    road_map: RoadMap,
    atlas: NuplanAtlas,
    route: Route,
    episode_idx: jax.Array,
    clock: LightClock,
    options: NuplanOptions,
) -> jax.Array:
    """(Q, 9) uint8: what each kind of pixel of the route's town shows now."""
    bits, lane, cell = (x[route.town] for x in (atlas.kind_bits, atlas.kind_lane, atlas.kind_cell))
    light = jnp.where(lane >= 0, atlas.lane_light[lane], -1)
    colour = lights.colour(jnp.maximum(light, 0), clock, road_map)
    value = jnp.where(colour == LIGHT_YELLOW, YELLOW_VALUE, GREEN_VALUE)
    value = jnp.where(colour == LIGHT_RED, RED_VALUE, value)
    limit = speed_value(road_map.lane_speed_limit[lane], SPEED_MAX)
    columns = {
        "drivable": 255 * (bits & DRIVABLE > 0),
        "route": 255 * atlas.cell_on_route[episode_idx][cell],
        "lane_borders": 255 * (bits & BORDER > 0),
        "lights": jnp.where(light >= 0, value, 0),
        "speed_limits": jnp.where(lane >= 0, limit, 0),
    }
    if options.stop_lines:
        columns["stop_lines"] = 255 * (bits & STOP_LINE > 0)
    none = jnp.zeros_like(lane)
    return jnp.stack([columns.get(x, none).astype(jnp.uint8) for x in CHANNELS], axis=-1)


def _static(
    ego: EgoState,
    road_map: RoadMap,
    atlas: NuplanAtlas,
    route: Route,
    table: jax.Array,
    config: RasterConfig,
) -> jax.Array:
    """(H * W, 9) uint8, what the atlas pixel around each pixel's centre shows.

    A coarse image looks at several places per pixel, lest it miss lines; areas need the middle.
    """

    def at(down: float, right: float) -> jax.Array:
        index, inside = raster_road.atlas_index(ego, road_map, route, config, down, right)
        return jnp.where(inside, atlas.pixels.at[index].get(**GATHER), 0)

    image = table.at[at(0.0, 0.0)].get(**GATHER)
    num = math.ceil(1.0 / config.pixels_per_metre)  # lines are a metre wide
    if num > 1:
        lines = table * np.array([name in LINES for name in CHANNELS], np.uint8)
        offsets = (np.arange(num) + 0.5) / num - 0.5
        for down in offsets:
            for right in offsets:
                more = lines.at[at(float(down), float(right))].get(**GATHER)
                image = jnp.maximum(image, more)
    return image.reshape(-1, len(CHANNELS))


def _ego_box(image: jax.Array, ego: EgoState, size: jax.Array, config: RasterConfig) -> jax.Array:
    """Draws the ego's own box."""
    middle = poses(ego.xy[None], ego.yaw[None], ego, config)
    at = box_pixels(middle, size[:1], size[1:], jnp.ones(1, bool), CAR_SIZE, config)
    return draw_channel(image, at, _EGO, speed_value(ego.speed, SPEED_MAX)[None])


def _shown(ego: EgoState, agents: Agents, config: RasterConfig) -> jax.Array:
    """(N,) bool: in use, near the ego's height, and the middle in the image."""
    row, column = pixel(agents.xy, ego, config)
    inside = (row >= 0.0) & (row < config.height) & (column >= 0.0) & (column < config.width)
    return agents.valid & inside & (jnp.abs(agents.z - ego.z) < HEIGHT_REACH)


def _values(agents: Agents) -> tuple[jax.Array, jax.Array]:
    """(N,) int32 the channel and (N,) uint8 the value of each road user."""
    walking = speed_value(agents.speed, WALK_SPEED_MAX)
    value = jnp.where(agents.kind == KIND_PEDESTRIAN, walking, STATIC_VALUE)
    is_vehicle = agents.kind == KIND_VEHICLE
    value = jnp.where(is_vehicle, speed_value(agents.speed, SPEED_MAX), value)
    return jnp.where(is_vehicle, _VEHICLES, _PEDESTRIANS), value.astype(jnp.uint8)


def _road_users(image: jax.Array, ego: EgoState, agents: Agents, config: RasterConfig) -> jax.Array:
    """Draws boxes: all as if they were no larger than cars, then the few large ones again."""
    shown = _shown(ego, agents, config)
    channel, value = _values(agents)
    at = poses(agents.xy, agents.yaw, ego, config)
    size = jnp.minimum(agents.length, CAR_SIZE[0]), jnp.minimum(agents.width, CAR_SIZE[1])
    image = draw_channel(image, box_pixels(at, *size, shown, CAR_SIZE, config), channel, value)
    excess = jnp.maximum(agents.length - CAR_SIZE[0], agents.width - CAR_SIZE[1])
    excess, large = jax.lax.top_k(jnp.where(shown, excess, -1.0), min(NUM_LARGE, len(shown)))
    at, channel, value = jax.tree.map(lambda x: x[large], (at, channel, value))
    size = agents.length[large], agents.width[large]
    pixels = box_pixels(at, *size, excess > 0.0, BUS_SIZE, config)
    return draw_channel(image, pixels, channel, value)


def _speed_lines(
    image: jax.Array, ego: EgoState, ego_size: jax.Array, agents: Agents, config: RasterConfig
) -> jax.Array:
    """Draws lines from the middle of everybody who moves, the ego included."""
    channel, value = _values(agents)
    shown = _shown(ego, agents, config) & (agents.kind != KIND_STATIC)

    def with_ego(others: jax.Array, own: jax.Array | int) -> jax.Array:
        return jnp.append(others, jnp.asarray(own, others.dtype)[None], axis=0)

    speed, length = with_ego(agents.speed, ego.speed), with_ego(agents.length, ego_size[0])
    reach = jnp.where(with_ego(shown, True), 0.5 * length + SPEED_LINE_S * speed, -1.0)
    begin = poses(with_ego(agents.xy, ego.xy), with_ego(agents.yaw, ego.yaw), ego, config)
    diagonal = math.hypot(config.height, config.width) / config.pixels_per_metre
    longest = min(diagonal, SPEED_MAX * SPEED_LINE_S + BUS_SIZE[0])
    at = ray_pixels(begin, reach, longest, config)
    value = with_ego(value, speed_value(ego.speed, SPEED_MAX))
    return draw_channel(image, at, with_ego(channel, _EGO), value)
