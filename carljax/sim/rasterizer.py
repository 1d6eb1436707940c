"""The bird's-eye view image: ten byte channels around the ego, heading up.

Source: paper, "Observation", and the authors' code; `CHANNELS` gives the order. A pixel is put
together from two bytes. The first is what stands still: one rotated gather from the town's atlas,
and the route as a further bit. The second is the road user there: sample points, so close that no
box shows a hole, are scattered onto a canvas. A table turns both bytes into ten channels at once;
the few stop lines and signs are scattered onto the image itself. So the cost of road users does not
depend on the size of the image, and no image of floats is ever made.

Ours, not the paper's: the gather takes the nearest atlas pixel (the paper warps bilinearly); of
overlapping values of a channel the larger stays (there, the later one); a pixel shows one road
user, a pedestrian before an obstacle before a vehicle. Doors, blinkers and emergency lights are not
drawn, for agents have no such state; a brake light shows where a vehicle decelerates.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from carljax.sim.geometry import to_frame
from carljax.sim.road_map import (
    LAYER_MARK_BROKEN,
    LAYER_MARK_SOLID,
    LAYER_ROAD,
    LAYER_SHOULDER,
    PIXELS_PER_METRE,
    RoadMap,
)
from carljax.sim.route import Route
from carljax.sim.types import (
    KIND_STATIC,
    KIND_VEHICLE,
    LIGHT_RED,
    LIGHT_YELLOW,
    STOP_LIGHT,
    STOP_SIGN,
    Agents,
    EgoState,
)

# source: the authors' code, CARLA bird's-eye view
CHANNELS = (
    "road",
    "route",
    "markings",
    "vehicles",
    "pedestrians",
    "lights",
    "stop_sign",
    "speed_signs",
    "static",
    "shoulder",
)
NUM_CHANNELS = len(CHANNELS)
LIGHTS, STOP, SPEED_SIGNS = 5, 6, 7

# source: the authors' code
SOLID_VALUE, BROKEN_VALUE = 255, 127
GREEN_VALUE, YELLOW_DIP, YELLOW_RAMP = 80, 0.33, 3.0  # byte, fraction of 255, s
LIGHTS_BEHIND, LIGHTS_AHEAD = 20, 150  # route points of about 1 m
ROUTE_AHEAD = 150  # route points
ROUTE_RADIUS = 1.5  # m: 3 px at 2 px/m
STOP_LINE_THICKNESS, STOP_LINE_FRAC = 1.5, 0.8  # m: 3 px at 2 px/m; of the lane's width
SPEED_SIGN_SIDE = 2.0  # m
HEIGHT_REACH = 8.0  # m, road users farther above or below are not drawn
# source: the authors' code, speed coding
SPEED_OFFSET, SPEED_RANGE = 2.67, 36.0  # m/s
FORECAST_S, FORECAST_MIN = 1.0, 0.5  # s, m
HALF_EXTENT_MIN = 0.8  # m
BRAKE_LIGHT_VALUE, BRAKE_LIGHT_X, BRAKE_LIGHT_SIDE = 111, -1.5, 1.0  # byte, m, m
# source: the authors' code looks for it 20 m ahead; ours: it holds until the car's rear is over it
STOP_SIGN_BEHIND, STOP_SIGN_AHEAD = 3, 20  # route points

# Ours: agents have no pedals, so this much deceleration shows as a brake light.
BRAKE_LIGHT_ACCEL = -1.0  # m/s^2
LANE_WIDTH_MAX = 6.0  # m; wider stop lines show gaps

# The first byte of a pixel: the atlas uses the bits below.
_BIT_ROUTE = 64
_NUM_BITS = 7
# The second byte of a pixel; of two road users the larger code stays.
_CODE_VEHICLE, _CODE_BRAKE, _CODE_STATIC, _CODE_PEDESTRIAN = 1, 130, 131, 132
# Farther apart and a pixel, whatever its rotation, could slip between samples (a square of side 1
# holds a circle of diameter 1, and that is the diagonal of the sample grid's cell).
_SAMPLE_STEP = 0.7  # px

# No index here is negative, and saying so makes the gather over the atlas a fifth faster.
# Leaves 15 bits before the point: 16 km of atlas.
_FRACTION_BITS = 16
_GATHER: dict[str, Any] = {"mode": "promise_in_bounds", "wrap_negative_indices": False}
_SCATTER: dict[str, Any] = {"mode": "drop", "wrap_negative_indices": False}


@dataclasses.dataclass(frozen=True)
class RasterConfig:
    """Size and content of the image.

    Attributes:
      height: px.
      width: px.
      pixels_per_metre: resolution.
      ego_from_bottom_px: rows behind the ego's centre, which lies where four pixels meet.
      route_everywhere: draw the whole route ahead; otherwise only its parts in junctions (paper).
      agent_length_max: m; longer boxes show gaps.
      agent_width_max: m; wider boxes show gaps.
    """

    height: int = 256
    width: int = 256
    pixels_per_metre: float = 2.0
    ego_from_bottom_px: int = 100
    route_everywhere: bool = False
    agent_length_max: float = 6.0
    agent_width_max: float = 2.4

    @property
    def shape(self) -> tuple[int, int, int]:
        """Rows, columns, channels."""
        return self.height, self.width, NUM_CHANNELS

    @property
    def num_route_points(self) -> int:
        """Route points looked at: 150 (paper), or all that a route reaches in a smaller image.

        A route may wind, so half as much again as the distance to the farthest corner is taken.
        """
        ahead = max(self.height - self.ego_from_bottom_px, self.ego_from_bottom_px)
        reach = math.hypot(ahead, self.width / 2) / self.pixels_per_metre
        return min(ROUTE_AHEAD, math.ceil(1.5 * reach))


def render(
    ego: EgoState,
    agents: Agents,
    road_map: RoadMap,
    route: Route,
    route_idx: jax.Array,
    light_state: jax.Array,
    light_time_left: jax.Array,
    stop_satisfied: jax.Array,
    config: RasterConfig,
) -> jax.Array:
    """Draws what the ego sees; the ego itself is not drawn.

    Args:
      ego: pose of the image, heading up.
      agents: the other road users.
      road_map: its layers are the static world.
      route: of this episode; names the town.
      route_idx: () int32, last passed route point.
      light_state: (Q,) int32, LIGHT_* of each stop line of the route.
      light_time_left: (Q,) s until a yellow light turns red.
      stop_satisfied: (Q,) bool, the ego has halted at this stop sign.
      config: size and content.

    Returns:
      (H, W, 10) uint8; row 0 is farthest ahead, column 0 farthest to the left.
    """
    ground = _route(_static(ego, road_map, route, config), ego, route, route_idx, config)
    users = _road_users(ego, agents, config)
    index = users.astype(jnp.int32) << _NUM_BITS | ground.astype(jnp.int32)
    image = jnp.asarray(_TABLE).at[index].get(**_GATHER)
    image = _lights(image, ego, route, route_idx, light_state, light_time_left, config)
    image = _stop_sign(image, ego, route, route_idx, stop_satisfied, config)
    image = _speed_signs(image, ego, route, route_idx, config)
    return image.reshape(config.shape)


def speed_value(speed: jax.Array) -> jax.Array:
    """The byte that stands for a speed: 136 at rest, 255 from 33.3 m/s on.

    Source: the authors' code: 127 + int(128 clip(v + 2.67, 0, 36) / 36).

    Args:
      speed: (...) m/s.

    Returns:
      (...) int32 in 127 ... 255.
    """
    frac = jnp.clip(speed + SPEED_OFFSET, 0.0, SPEED_RANGE) / SPEED_RANGE
    return 127 + (128.0 * frac).astype(jnp.int32)


def yellow_value(time_left: jax.Array) -> jax.Array:
    """The byte of a yellow light, (...) int32: 170 until 3 s are left, rising to 255 at its end."""
    frac = jnp.clip(time_left / YELLOW_RAMP, 0.0, 1.0)
    return (255.0 * (1.0 - YELLOW_DIP * frac)).astype(jnp.int32)


def _channel_table() -> np.ndarray:
    """(256 * 128, 10) uint8: the channels of each pair of bytes, row = second * 128 + first."""
    code, bits = np.divmod(np.arange(256 << _NUM_BITS), 1 << _NUM_BITS)
    vehicle = (code >= _CODE_VEHICLE) & (code < _CODE_BRAKE)
    columns = {
        "road": 255 * (bits & LAYER_ROAD > 0),
        "route": 255 * (bits & _BIT_ROUTE > 0),
        "markings": np.where(
            bits & LAYER_MARK_BROKEN, BROKEN_VALUE, SOLID_VALUE * (bits & LAYER_MARK_SOLID > 0)
        ),
        "vehicles": np.where(
            vehicle, code - _CODE_VEHICLE + 127, BRAKE_LIGHT_VALUE * (code == _CODE_BRAKE)
        ),
        "pedestrians": np.where(code >= _CODE_PEDESTRIAN, code - _CODE_PEDESTRIAN + 127, 0),
        "static": 255 * (code == _CODE_STATIC),
        "shoulder": 255 * (bits & LAYER_SHOULDER > 0),
    }
    table = np.zeros((len(code), NUM_CHANNELS), np.uint8)
    for name, values in columns.items():
        table[:, CHANNELS.index(name)] = values
    return table


_TABLE = _channel_table()


def _static(ego: EgoState, road_map: RoadMap, route: Route, config: RasterConfig) -> jax.Array:
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
    """(H, W) uint8: the atlas at each pixel's centre, or so many pixels down and right of it.

    Places are fixed-point numbers, `_FRACTION_BITS` behind the point: whole steps along rows and
    columns are six times faster on a CPU than floats rounded at each pixel, and drift by less than
    a hundredth of an atlas pixel over the image.
    """
    _, rows, columns = road_map.layers.shape
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
    index = jnp.where(inside, (route.town * rows + y) * columns + x, 0)
    bits = road_map.layers.reshape(-1).at[index].get(**_GATHER)
    return jnp.where(inside, bits & jnp.uint8(_BIT_ROUTE - 1), jnp.uint8(0))


def _fixed_point(number: jax.Array) -> jax.Array:
    """int32 in units of 2 ** -_FRACTION_BITS."""
    return jnp.round(number * (1 << _FRACTION_BITS)).astype(jnp.int32)


def _route(
    ground: jax.Array, ego: EgoState, route: Route, route_idx: jax.Array, config: RasterConfig
) -> jax.Array:
    """Adds the route's bit in discs around the route points ahead."""
    num = config.num_route_points
    point = route_idx + jnp.arange(num, dtype=jnp.int32)
    shown = point < route.num_points
    point = jnp.minimum(point, route.xy.shape[0] - 1)
    if not config.route_everywhere:
        shown &= route.in_junction[point]
    row, column = _pixel(route.xy[point], ego, config)
    radius = ROUTE_RADIUS * config.pixels_per_metre
    down, right = np.mgrid[-int(radius) : int(radius) + 1, -int(radius) : int(radius) + 1]
    disc = down**2 + right**2 <= radius**2
    index = _index(
        jnp.floor(row)[:, None] + down[disc].astype(np.float32),
        jnp.floor(column)[:, None] + right[disc].astype(np.float32),
        shown[:, None],
        config,
    )
    return ground.at[index].apply(lambda bits: bits | jnp.uint8(_BIT_ROUTE), **_SCATTER)


def _road_users(ego: EgoState, agents: Agents, config: RasterConfig) -> jax.Array:
    """(H * W,) uint8 codes of the road users: boxes, forecast lines, brake lights."""
    px = config.pixels_per_metre
    is_vehicle, is_static = agents.kind == KIND_VEHICLE, agents.kind == KIND_STATIC
    shown = agents.valid & (jnp.abs(agents.z - ego.z) < HEIGHT_REACH)
    code = speed_value(agents.speed) - 127
    code = jnp.where(
        is_vehicle,
        code + _CODE_VEHICLE,
        jnp.where(is_static, _CODE_STATIC, jnp.minimum(code + _CODE_PEDESTRIAN, 255)),
    ).astype(jnp.uint8)
    least = jnp.where(is_static, 0.0, 2 * HALF_EXTENT_MIN)
    length, width = jnp.maximum(agents.length, least), jnp.maximum(agents.width, least)
    turn = agents.yaw - ego.yaw
    canvas = jnp.zeros(config.height * config.width, jnp.uint8)
    limits = (config.agent_length_max, config.agent_width_max)
    index = _box(agents.xy, turn, length, width, shown, limits, ego, config)
    canvas = canvas.at[index].max(code[:, None], **_SCATTER)

    row, column = _pixel(agents.xy, ego, config)
    farthest = (SPEED_RANGE - SPEED_OFFSET) * FORECAST_S * px
    step = np.arange(math.ceil(farthest) + 1, dtype=np.float32)
    reach = jnp.clip(agents.speed * FORECAST_S, FORECAST_MIN) * px
    out = 0.5 * length[:, None] * px + step
    drawn = (shown & ~is_static)[:, None] & (step <= reach[:, None])
    index = _index(
        row[:, None] - jnp.cos(turn)[:, None] * out,
        column[:, None] - jnp.sin(turn)[:, None] * out,
        drawn,
        config,
    )
    canvas = canvas.at[index].max(code[:, None], **_SCATTER)

    rear = jnp.stack([jnp.cos(agents.yaw), jnp.sin(agents.yaw)], axis=-1) * BRAKE_LIGHT_X
    side = jnp.full_like(length, BRAKE_LIGHT_SIDE)
    brakes = shown & is_vehicle & (agents.accel < BRAKE_LIGHT_ACCEL)
    limits = (BRAKE_LIGHT_SIDE, BRAKE_LIGHT_SIDE)
    index = _box(agents.xy + rear, turn, side, side, brakes, limits, ego, config)
    return canvas.at[index].max(jnp.uint8(_CODE_BRAKE), **_SCATTER)


def _lights(
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
    index = _box(
        route.stop_xy,
        route.stop_yaw - ego.yaw,
        jnp.full_like(route.stop_width, STOP_LINE_THICKNESS),
        route.stop_width * STOP_LINE_FRAC,
        near,
        (STOP_LINE_THICKNESS, LANE_WIDTH_MAX * STOP_LINE_FRAC),
        ego,
        config,
    )
    return _draw(image, index, LIGHTS, value)


def _stop_sign(
    image: jax.Array,
    ego: EgoState,
    route: Route,
    route_idx: jax.Array,
    stop_satisfied: jax.Array,
    config: RasterConfig,
) -> jax.Array:
    """Draws the next stop sign that asks for a halt: a square as wide as its lane on the line."""
    ahead = route.stop_idx - route_idx
    asks = (ahead >= -STOP_SIGN_BEHIND) & (ahead <= STOP_SIGN_AHEAD)
    asks &= (route.stop_kind == STOP_SIGN) & ~stop_satisfied
    first = jnp.argmin(jnp.where(asks, ahead, STOP_SIGN_AHEAD + 1))[None]
    index = _box(
        route.stop_xy[first],
        route.stop_yaw[first] - ego.yaw,
        route.stop_width[first],
        route.stop_width[first],
        asks[first],
        (LANE_WIDTH_MAX, LANE_WIDTH_MAX),
        ego,
        config,
    )
    return _draw(image, index, STOP, jnp.full((1,), 255))


def _speed_signs(
    image: jax.Array, ego: EgoState, route: Route, route_idx: jax.Array, config: RasterConfig
) -> jax.Array:
    """Draws the route's speed signs near the ego as small squares that code the limit."""
    ahead = route.sign_idx - route_idx
    near = (ahead > -LIGHTS_BEHIND) & (ahead < LIGHTS_AHEAD) & (route.sign_idx != -1)
    yaw = route.yaw[jnp.clip(route.sign_idx, 0, route.yaw.shape[0] - 1)]
    side = jnp.full_like(route.sign_limit, SPEED_SIGN_SIDE)
    index = _box(
        route.sign_xy,
        yaw - ego.yaw,
        side,
        side,
        near,
        (SPEED_SIGN_SIDE, SPEED_SIGN_SIDE),
        ego,
        config,
    )
    return _draw(image, index, SPEED_SIGNS, speed_value(route.sign_limit))


def _draw(image: jax.Array, index: jax.Array, channel: int, value: jax.Array) -> jax.Array:
    """Scatters values (K,) to pixels (K, S) of one channel of the (H * W, 10) image."""
    value = value.astype(jnp.uint8)[:, None]
    return image.at[index, channel].max(value, **_SCATTER)


def _pixel(xy: jax.Array, ego: EgoState, config: RasterConfig) -> tuple[jax.Array, jax.Array]:
    """Row and column, not rounded, of world points (..., 2) m; whole numbers are pixel borders."""
    ahead_left = to_frame(xy, ego.xy, ego.yaw) * config.pixels_per_metre
    row = config.height - config.ego_from_bottom_px - ahead_left[..., 0]
    return row, config.width / 2 - ahead_left[..., 1]


def _index(row: jax.Array, column: jax.Array, shown: jax.Array, config: RasterConfig) -> jax.Array:
    """Flat pixel index, int32; one past the image for what is outside or not shown."""
    row, column = jnp.floor(row).astype(jnp.int32), jnp.floor(column).astype(jnp.int32)
    shown = shown & (row.astype(jnp.uint32) < config.height)
    shown &= column.astype(jnp.uint32) < config.width
    return jnp.where(shown, row * config.width + column, config.height * config.width)


def _box(
    xy: jax.Array,
    turn: jax.Array,
    length: jax.Array,
    width: jax.Array,
    shown: jax.Array,
    limits: tuple[float, float],
    ego: EgoState,
    config: RasterConfig,
) -> jax.Array:
    """Pixels of boxes, by a grid of sample points in each.

    The outermost samples lie half a pixel inside the border, so that a box along the axes covers
    just the pixels whose centres it holds.

    Args:
      xy: (K, 2) m, centres.
      turn: (K,) rad, direction of their length relative to the ego's.
      length: (K,) m.
      width: (K,) m.
      shown: (K,) bool.
      limits: m, length and width up to which no gap shows; they fix the number of samples.
      ego: pose of the image.
      config: size and content.

    Returns:
      (K, S) int32 flat pixel indices.
    """
    px = config.pixels_per_metre
    steps = [math.ceil(max(limit * px - 1.0, 0.0) / _SAMPLE_STEP) for limit in limits]
    lines = [np.linspace(-1.0, 1.0, n + 1) if n else np.zeros(1) for n in steps]
    along, across = np.stack(np.meshgrid(*lines), axis=0).reshape(2, -1).astype(np.float32)
    half_length = jnp.maximum(0.5 * length * px - 0.5, 0.0)
    half_width = jnp.maximum(0.5 * width * px - 0.5, 0.0)
    cos, sin = jnp.cos(turn), jnp.sin(turn)
    row, column = _pixel(xy, ego, config)
    row = row[:, None] - (cos * half_length)[:, None] * along
    column = column[:, None] - (sin * half_length)[:, None] * along
    return _index(
        row + (sin * half_width)[:, None] * across,
        column - (cos * half_width)[:, None] * across,
        shown[:, None],
        config,
    )
