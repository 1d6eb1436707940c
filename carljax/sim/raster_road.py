"""What the road shows on the bird's-eye view: the town, the route, stop lines and signs."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np

from carljax.sim.raster_canvas import (
    CHANNELS,
    GATHER,
    NOWHERE,
    RasterConfig,
    box_pixels,
    flat_index,
    pixel,
    poses,
)
from carljax.sim.raster_marks import SCATTER, draw_channel, spread
from carljax.sim.raster_users import speed_value
from carljax.sim.road_map import (
    LAYER_MARK_BROKEN,
    LAYER_MARK_SOLID,
    PIXELS_PER_METRE,
    RoadMap,
)
from carljax.sim.route import Route
from carljax.sim.types import LIGHT_RED, LIGHT_YELLOW, STOP_LIGHT, STOP_SIGN, EgoState

LIGHTS, STOP, SPEED_SIGNS = (CHANNELS.index(x) for x in ("lights", "stop_sign", "speed_signs"))

# source: the authors' code
GREEN_VALUE, YELLOW_DIP, YELLOW_RAMP = 80, 0.33, 3.0  # byte, fraction of 255, s
LIGHTS_BEHIND, LIGHTS_AHEAD = 20, 150  # route points of about 1 m
ROUTE_RADIUS = 1.5  # m: 3 px at 2 px/m
STOP_LINE_THICKNESS, STOP_LINE_FRAC = 1.5, 0.8  # m: 3 px at 2 px/m; of the lane's width
SPEED_SIGN_SIDE = 2.0  # m
# source: the authors' code looks for it 20 m ahead; ours: it holds until the car's rear is over it
STOP_SIGN_BEHIND, STOP_SIGN_AHEAD = 3, 20  # route points
LANE_WIDTH_MAX = 6.0  # m; wider stop lines show gaps. source: ours

ROUTE_BIT = 64  # beside the LAYER_* bits of the atlas, which are smaller
NUM_BITS = 7
# Leaves 15 bits before the point: 16 km of atlas.
_FRACTION_BITS = 16


def static(ego: EgoState, road_map: RoadMap, route: Route, config: RasterConfig) -> jax.Array:
    """(H * W,) uint8 of LAYER_* bits: the atlas around the ego, 0 outside the town's picture."""
    scale = PIXELS_PER_METRE / config.pixels_per_metre  # atlas pixels per image pixel
    # A coarse image looks at several places per pixel, lest it miss lines; areas need the middle.
    num = math.ceil(scale / PIXELS_PER_METRE)
    offsets = (np.arange(num) + 0.5) / num - 0.5
    bits = _static_at(ego, road_map, route, config, 0.0, 0.0)
    lines = LAYER_MARK_SOLID | LAYER_MARK_BROKEN
    for down in offsets:
        for right in offsets:
            if num > 1:
                more = _static_at(ego, road_map, route, config, float(down), float(right))
                bits |= more & jnp.uint8(lines)
    return bits.reshape(-1)


def _static_at(
    ego: EgoState,
    road_map: RoadMap,
    route: Route,
    config: RasterConfig,
    down: float,
    right: float,
) -> jax.Array:
    """(H, W) uint8: the atlas at each pixel's centre, or so many pixels down and right of it."""
    index, inside = atlas_index(ego, road_map, route, config, down, right)
    bits = road_map.layers.at[index].get(**GATHER)
    return jnp.where(inside, bits & jnp.uint8(ROUTE_BIT - 1), jnp.uint8(0))


def atlas_index(
    ego: EgoState,
    road_map: RoadMap,
    route: Route,
    config: RasterConfig,
    down: float,
    right: float,
) -> tuple[jax.Array, jax.Array]:
    """The atlas pixel under each pixel's centre, or so many pixels down and right of it.

    Places are fixed-point numbers, `_FRACTION_BITS` behind the point: whole steps along rows and
    columns are six times faster on a CPU than floats rounded at each pixel, and drift by less than
    a hundredth of an atlas pixel over the image.

    Args:
      ego: pose of the image.
      road_map: gives the place and size of the town's picture.
      route: names the town.
      config: size.
      down: pixels of the image.
      right: pixels of the image.

    Returns:
      (H, W) int32 index into an atlas, 0 outside the town's picture; (H, W) bool, inside it.
    """
    rows, columns = road_map.picture_size[route.town].astype(jnp.uint32)
    # Iota, not constants: with constants XLA's CPU code for this gather is eight times slower.
    row = jnp.arange(config.height, dtype=jnp.int32)[:, None]
    column = jnp.arange(config.width, dtype=jnp.int32)[None, :]
    ahead = np.float32(config.height - config.ego_from_bottom_px - 0.5 - down)
    left = np.float32(config.width / 2 - 0.5 - right)
    scale = np.float32(PIXELS_PER_METRE / config.pixels_per_metre)
    cos, sin = jnp.cos(ego.yaw) * scale, jnp.sin(ego.yaw) * scale
    # Atlas pixel under the image's first one; the half makes the shift below a rounding.
    at = (ego.xy - road_map.origin[route.town]) * PIXELS_PER_METRE + 0.5
    first = at + jnp.stack([cos * ahead - sin * left, sin * ahead + cos * left])
    x_first, y_first = _fixed_point(first[0]), _fixed_point(first[1])
    cos, sin = _fixed_point(cos), _fixed_point(sin)
    x = (x_first - cos * row + sin * column) >> _FRACTION_BITS
    y = (y_first - sin * row - cos * column) >> _FRACTION_BITS
    # Unsigned, a negative number is larger than any size.
    inside = (x.astype(jnp.uint32) < columns) & (y.astype(jnp.uint32) < rows)
    start = road_map.picture_start[route.town]
    return jnp.where(inside, start + y * columns.astype(jnp.int32) + x, 0), inside


def _fixed_point(number: jax.Array) -> jax.Array:
    """int32 in units of 2 ** -_FRACTION_BITS."""
    return jnp.round(number * (1 << _FRACTION_BITS)).astype(jnp.int32)


def route(
    ground: jax.Array, ego: EgoState, route: Route, route_idx: jax.Array, config: RasterConfig
) -> jax.Array:
    """Adds the route's bit in discs around the route points ahead."""
    num = config.num_route_points
    point = route_idx + jnp.arange(num, dtype=jnp.int32)
    shown = point < route.num_points
    point = jnp.minimum(point, route.xy.shape[0] - 1)
    if not config.route_everywhere:
        shown &= route.in_junction[point]
    row, column = pixel(route.xy[point], ego, config)
    radius = ROUTE_RADIUS * config.pixels_per_metre
    down, right = np.mgrid[-int(radius) : int(radius) + 1, -int(radius) : int(radius) + 1]
    disc = down**2 + right**2 <= radius**2
    one = jnp.ones(num)
    index = flat_index(
        spread((jnp.where(shown, jnp.floor(row), NOWHERE), one), (1.0, down[disc])),
        spread((jnp.floor(column), one), (1.0, right[disc])),
        config,
    )
    return ground.at[index].apply(lambda bits: bits | jnp.uint8(ROUTE_BIT), **SCATTER)


def lights(
    image: jax.Array,
    ego: EgoState,
    route: Route,
    route_idx: jax.Array,
    light_state: jax.Array,
    light_time_left: jax.Array,
    config: RasterConfig,
) -> jax.Array:
    """Draws the stop lines of the route's lights near the ego on the (H, W, 10) image."""
    ahead = route.stop_idx - route_idx
    near = (ahead > -LIGHTS_BEHIND) & (ahead < LIGHTS_AHEAD) & (route.stop_kind == STOP_LIGHT)
    value = jnp.where(light_state == LIGHT_RED, 255, GREEN_VALUE)
    value = jnp.where(light_state == LIGHT_YELLOW, yellow_value(light_time_left), value)
    index = box_pixels(
        poses(route.stop_xy, route.stop_yaw, ego, config),
        jnp.full_like(route.stop_width, STOP_LINE_THICKNESS),
        route.stop_width * STOP_LINE_FRAC,
        near,
        (STOP_LINE_THICKNESS, LANE_WIDTH_MAX * STOP_LINE_FRAC),
        config,
    )
    return draw_channel(image, index, LIGHTS, value)


def stop_sign(
    image: jax.Array,
    ego: EgoState,
    route: Route,
    route_idx: jax.Array,
    stop_satisfied: jax.Array,
    config: RasterConfig,
) -> jax.Array:
    """Draws the next stop sign that asks for a halt: a square as wide as its lane on the line."""
    asks, first = asking_stop_sign(route, route_idx, stop_satisfied)
    first = first[None]
    index = box_pixels(
        poses(route.stop_xy[first], route.stop_yaw[first], ego, config),
        route.stop_width[first],
        route.stop_width[first],
        asks[first],
        (LANE_WIDTH_MAX, LANE_WIDTH_MAX),
        config,
    )
    return draw_channel(image, index, STOP, jnp.full((1,), 255))


def asking_stop_sign(
    route: Route, route_idx: jax.Array, stop_satisfied: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Which stop signs near the ego ask for a halt, (Q,) bool, and the first of them, () int32."""
    ahead = route.stop_idx - route_idx
    asks = (ahead >= -STOP_SIGN_BEHIND) & (ahead <= STOP_SIGN_AHEAD)
    asks &= (route.stop_kind == STOP_SIGN) & ~stop_satisfied
    return asks, jnp.argmin(jnp.where(asks, ahead, STOP_SIGN_AHEAD + 1)).astype(jnp.int32)


def speed_signs(
    image: jax.Array, ego: EgoState, route: Route, route_idx: jax.Array, config: RasterConfig
) -> jax.Array:
    """Draws the route's speed signs near the ego as small squares that code the limit."""
    ahead = route.sign_idx - route_idx
    near = (ahead > -LIGHTS_BEHIND) & (ahead < LIGHTS_AHEAD) & (route.sign_idx != -1)
    yaw = route.yaw[jnp.clip(route.sign_idx, 0, route.yaw.shape[0] - 1)]
    side = jnp.full_like(route.sign_limit, SPEED_SIGN_SIDE)
    index = box_pixels(
        poses(route.sign_xy, yaw, ego, config),
        side,
        side,
        near,
        (SPEED_SIGN_SIDE, SPEED_SIGN_SIDE),
        config,
    )
    return draw_channel(image, index, SPEED_SIGNS, speed_value(route.sign_limit))


def yellow_value(time_left: jax.Array) -> jax.Array:
    """The byte of a yellow light, (...) int32: 170 until 3 s are left, rising to 255 at its end."""
    frac = jnp.clip(time_left / YELLOW_RAMP, 0.0, 1.0)
    return (255.0 * (1.0 - YELLOW_DIP * frac)).astype(jnp.int32)
