"""CaRL's bird's-eye view in nuPlan: nine byte channels around the ego, heading up.

Source: the authors' nuPlan code, paper, nuPlan input. The map comes from one rotated gather over
whole numbers (`nuplan_atlas`), which small tables turn into route, lights and limits; boxes are
scattered onto the image. The authors' array has ahead along its columns; turned by a quarter it is
this one.

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
from carljax.sim.nuplan_atlas import (
    BORDER,
    CELL_SHIFT,
    DRIVABLE,
    LANE_BITS,
    LANE_SHIFT,
    STOP_LINE,
    NuplanAtlas,
)
from carljax.sim.raster_canvas import GATHER, SCATTER, RasterConfig, box_pixels, flat_index, pixel
from carljax.sim.raster_users import BUS_SIZE, CAR_SIZE, HEIGHT_REACH, NUM_LARGE
from carljax.sim.road_map import PIXELS_PER_METRE, RoadMap
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
SPEED_MAX, WALK_SPEED_MAX = 30.0, 4.0  # m/s, of vehicles and limits, of pedestrians
STATIC_VALUE = 127
GREEN_VALUE, YELLOW_VALUE, RED_VALUE = 80, 170, 255
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
    number = _static(ego, road_map, atlas, route, config)
    lane = number >> LANE_SHIFT & ((1 << LANE_BITS) - 1)
    table = _lane_table(road_map, atlas, clock)
    row = atlas.first_lane[route.town] + lane - 1
    both = table.at[jnp.maximum(row, 0)].get(**GATHER)
    both = jnp.where(lane > 0, both, 0)
    on_route = atlas.cell_on_route[episode_idx].at[number >> CELL_SHIFT].get(**GATHER)
    empty = jnp.zeros_like(number)
    planes = {
        "drivable": 255 * (number & DRIVABLE > 0),
        "route": 255 * on_route,
        "lane_borders": 255 * (number & BORDER > 0),
        "lights": both >> 8,
        "stop_lines": 255 * (number & STOP_LINE > 0) if options.stop_lines else empty,
        "speed_limits": both & 255,
        "vehicles": empty,
        "pedestrians": empty,
        "ego": _ego_box(ego, ego_size, config),
    }
    image = jnp.stack([planes[name].astype(jnp.uint8) for name in CHANNELS], axis=-1)
    image = _road_users(image, ego, agents, config)
    if options.speed_line:
        image = _speed_lines(image, ego, ego_size, agents, config)
    return image.reshape(config.height, config.width, len(CHANNELS))


def _static(
    ego: EgoState, road_map: RoadMap, atlas: NuplanAtlas, route: Route, config: RasterConfig
) -> jax.Array:
    """(H * W,) int32, the number of the atlas pixel around each pixel's centre; 0 outside.

    A coarse image looks at several places per pixel, lest it miss lines; areas need the middle.
    """
    lane_bits = ((1 << LANE_BITS) - 1) << LANE_SHIFT

    def at(down: float, right: float) -> jax.Array:
        index, inside = raster_road.atlas_index(ego, road_map, route, config, down, right)
        return jnp.where(inside, atlas.pixels.reshape(-1).at[index].get(**GATHER), 0)

    number = at(0.0, 0.0)
    num = math.ceil(1.0 / config.pixels_per_metre)
    assert PIXELS_PER_METRE == 2.0  # lines of 1 m are two pixels wide: one place a metre finds them
    if num > 1:
        offsets = (np.arange(num) + 0.5) / num - 0.5
        for down in offsets:
            for right in offsets:
                more = at(float(down), float(right))
                number |= more & (BORDER | STOP_LINE)
                number |= jnp.where(number & lane_bits == 0, more & lane_bits, 0)
    return number.reshape(-1)


def _lane_table(road_map: RoadMap, atlas: NuplanAtlas, clock: LightClock) -> jax.Array:
    """(K,) int32: what the centre line of each lane shows, its limit + 256 * its light."""
    colour = lights.colour(jnp.maximum(atlas.lane_light, 0), clock, road_map)
    value = jnp.where(colour == LIGHT_YELLOW, YELLOW_VALUE, GREEN_VALUE)
    value = jnp.where(colour == LIGHT_RED, RED_VALUE, value)
    value = jnp.where(atlas.lane_light >= 0, value, 0)
    return speed_value(road_map.lane_speed_limit, SPEED_MAX) + (value << 8)


def _ego_box(ego: EgoState, size: jax.Array, config: RasterConfig) -> jax.Array:
    """(H * W,) int32, the ego's own box: it never turns in its own frame."""
    px = config.pixels_per_metre
    down = jnp.arange(config.height) + 0.5 - (config.height - config.ego_from_bottom_px)
    right = jnp.arange(config.width) + 0.5 - config.width / 2
    inside = (jnp.abs(down) <= 0.5 * size[0] * px)[:, None] & (
        jnp.abs(right) <= 0.5 * size[1] * px
    )[None, :]
    return jnp.where(inside, speed_value(ego.speed, SPEED_MAX), 0).reshape(-1)


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
    turn = agents.yaw - ego.yaw
    length, width = jnp.minimum(agents.length, CAR_SIZE[0]), jnp.minimum(agents.width, CAR_SIZE[1])
    at = box_pixels(agents.xy, turn, length, width, shown, CAR_SIZE, ego, config)
    image = image.at[at, channel[:, None]].max(value[:, None], **SCATTER)
    excess = jnp.maximum(agents.length - CAR_SIZE[0], agents.width - CAR_SIZE[1])
    excess, large = jax.lax.top_k(jnp.where(shown, excess, -1.0), min(NUM_LARGE, len(shown)))
    size = agents.length[large], agents.width[large]
    at = box_pixels(agents.xy[large], turn[large], *size, excess > 0.0, BUS_SIZE, ego, config)
    return image.at[at, channel[large, None]].max(value[large, None], **SCATTER)


def _speed_lines(
    image: jax.Array, ego: EgoState, ego_size: jax.Array, agents: Agents, config: RasterConfig
) -> jax.Array:
    """Draws lines from the middle of everybody who moves, the ego included."""
    px = config.pixels_per_metre
    channel, value = _values(agents)
    shown = _shown(ego, agents, config) & (agents.kind != KIND_STATIC)

    def with_ego(others: jax.Array, own: jax.Array | int) -> jax.Array:
        return jnp.append(others, jnp.asarray(own, others.dtype)[None], axis=0)

    row, column = pixel(with_ego(agents.xy, ego.xy), ego, config)
    turn = with_ego(agents.yaw, ego.yaw)[:, None] - ego.yaw
    speed, length = with_ego(agents.speed, ego.speed), with_ego(agents.length, ego_size[0])
    farthest = math.hypot(config.height, config.width)
    out = np.arange(math.ceil(min(farthest, (SPEED_MAX * SPEED_LINE_S + BUS_SIZE[0]) * px)) + 1)
    out = out.astype(np.float32)
    reach = (0.5 * length + SPEED_LINE_S * speed) * px
    at = flat_index(
        row[:, None] - jnp.cos(turn) * out,
        column[:, None] - jnp.sin(turn) * out,
        with_ego(shown, True)[:, None] & (out <= reach[:, None]),
        config,
    )
    channel = with_ego(channel, _EGO)
    value = with_ego(value, speed_value(ego.speed, SPEED_MAX))
    return image.at[at, channel[:, None]].max(value[:, None], **SCATTER)
