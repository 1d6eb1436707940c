"""Roach's bird's-eye view: fifteen byte channels, road users and signals at four moments.

Source: Roach (Zhang et al. 2021) as CaRL's authors reproduce it. All moments are drawn in the ego's
present frame. A pixel is put together from two bytes, as in `rasterizer`: what stands still, with
the route as a further bit; and one bit for each moment's vehicles and walkers. A table turns both
into channels, and the few stop lines are scattered onto the image.

Ours, not Roach's: the gather takes the nearest pixel of an atlas of 2 px/m, so that at 5 px/m edges
show its steps and painted lines are 1 m wide; lights are those of the route; of overlapping values
of a channel the larger stays; in crowds only the nearest road users are drawn (`num_nearest`).
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np

from carljax.sim import raster_road, raster_spans
from carljax.sim.geometry import from_frame
from carljax.sim.raster_canvas import GATHER, RasterConfig, box_pixels, poses
from carljax.sim.raster_marks import SCATTER
from carljax.sim.raster_road import LANE_WIDTH_MAX, LIGHTS_BEHIND, STOP_LINE_FRAC
from carljax.sim.road_map import LAYER_MARK_BROKEN, LAYER_MARK_SOLID, LAYER_ROAD, RoadMap
from carljax.sim.route import Route
from carljax.sim.types import (
    KIND_PEDESTRIAN,
    KIND_VEHICLE,
    LIGHT_RED,
    LIGHT_YELLOW,
    STOP_LIGHT,
    EgoState,
    Trail,
)

# source: Roach
RASTER = RasterConfig(height=192, width=192, pixels_per_metre=5.0, ego_from_bottom_px=40)
TRAIL_STEPS = 16
MOMENTS = (0, 5, 10, 15)  # rows of the trail: indices -16, -11, -6, -1
SECONDS = ("1.5 s ago", "1 s ago", "0.5 s ago", "now")  # at 10 Hz
CHANNELS = (
    *("road", "route", "markings"),
    *(f"{name} {when}" for name in ("vehicles", "walkers", "signals") for when in SECONDS),
)
SOLID_VALUE, BROKEN_VALUE = 255, 120
GREEN_VALUE, YELLOW_VALUE, RED_VALUE, STOP_VALUE = 80, 170, 255, 255
# The values other than 0 of each channel.
LEVELS = {
    **dict.fromkeys(CHANNELS, (255,)),
    "markings": (BROKEN_VALUE, SOLID_VALUE),
    **{f"signals {when}": (GREEN_VALUE, YELLOW_VALUE, RED_VALUE) for when in SECONDS},
}
ROUTE_AHEAD = 80  # route points of about 1 m
ROUTE_WIDTH = 3.2  # m: 16 px at 5 px/m
STOP_LINE_THICKNESS = 1.2  # m: 6 px at 5 px/m
HALF_EXTENT_MIN = 0.8  # m
WALKER_SCALE = 2.0  # of half extents

# Ours. The largest box, a bus of 10.4 x 2.6 m; a route that changes lanes; walkers; m, diagonals.
_LONGEST_VEHICLE, _LONGEST_STRETCH, _LONGEST_WALKER = 10.8, 5.2, 2.9
_AREA_EACH = 60.0  # m^2 of image for each road user of a kind that is drawn
_ROUTE_OVERLAP = 0.3  # m that a stretch of the route is longer at both ends, so that bends close
_MOST_LINES = 6  # stop lines drawn, the nearest; a crossing of two lanes each way has fewer ahead

_NUM_MOMENTS = len(MOMENTS)
_SIGNALS = CHANNELS.index(f"signals {SECONDS[0]}")
_NUM_BITS, _ROUTE_BIT = 4, 8  # of the first byte: road, solid, broken, route
_ROUTE_PLANE = 2 * _NUM_MOMENTS


def num_nearest(config: RasterConfig, num_agents: int) -> int:
    """How many vehicles, and how many walkers, are drawn of each moment: the nearest ones."""
    area = config.height * config.width / config.pixels_per_metre**2
    return min(num_agents, math.ceil(area / _AREA_EACH), raster_spans.MOST_BOXES)


def render(
    ego: EgoState,
    trail: Trail,
    road_map: RoadMap,
    route: Route,
    route_idx: jax.Array,
    config: RasterConfig,
) -> jax.Array:
    """Draws what the ego sees; the ego itself is not drawn.

    Args:
      ego: pose of the image, heading up.
      trail: the others and the signals of the last steps.
      road_map: its layers are the static world.
      route: of this episode; names the town.
      route_idx: () int32, last passed route point.
      config: size.

    Returns:
      (H, W, 15) uint8; row 0 is farthest ahead, column 0 farthest to the left.
    """
    counts = _counts(ego, trail, route, route_idx, config)
    index = _ground(raster_road.static(ego, road_map, route, config)).astype(jnp.int32)
    index |= raster_spans.covered(counts, _ROUTE_PLANE) * _ROUTE_BIT
    for plane in range(_ROUTE_PLANE):
        index |= raster_spans.covered(counts, plane).astype(jnp.int32) << (_NUM_BITS + plane)
    image = jnp.asarray(_TABLE).at[index].get(**GATHER)
    image = _signals(image, ego, trail, route, route_idx, config)
    return image.reshape(config.height, config.width, len(CHANNELS))


def _ground(bits: jax.Array) -> jax.Array:
    """The atlas's bits of road, solid and broken lines, side by side: 1, 2, 4."""
    road = (bits & LAYER_ROAD > 0).astype(jnp.uint8)
    solid = (bits & LAYER_MARK_SOLID > 0).astype(jnp.uint8)
    return road | solid << 1 | (bits & LAYER_MARK_BROKEN > 0).astype(jnp.uint8) << 2


def _counts(
    ego: EgoState, trail: Trail, route: Route, route_idx: jax.Array, config: RasterConfig
) -> jax.Array:
    """Vehicles and walkers of each moment, and the route, as planes of `raster_spans.fill`."""
    past: Trail = jax.tree.map(lambda x: x[np.array(MOMENTS)], trail)
    vehicles = _users(ego, past, KIND_VEHICLE, 1.0, 0, _LONGEST_VEHICLE, config)
    walkers = _users(
        ego, past, KIND_PEDESTRIAN, WALKER_SCALE, _NUM_MOMENTS, _LONGEST_WALKER, config
    )
    way = _route(ego, route, route_idx, config)
    return raster_spans.fill([vehicles, walkers, way], _ROUTE_PLANE + 1, config)


def _users(
    ego: EgoState,
    past: Trail,
    kind: int,
    scale: float,
    first_plane: int,
    longest: float,
    config: RasterConfig,
) -> tuple[jax.Array, jax.Array]:
    """Marks of the nearest road users of a kind at each moment, as `raster_spans.marks`."""
    num = num_nearest(config, past.kind.shape[1])
    ahead = (0.5 * config.height - config.ego_from_bottom_px) / config.pixels_per_metre
    middle = from_frame(jnp.array([ahead, 0.0], jnp.float32), ego.xy, ego.yaw)
    distance = jnp.sum((past.xy - middle) ** 2, axis=-1)
    closeness, near = jax.lax.top_k(jnp.where(past.kind == kind, -distance, -jnp.inf), num)

    def of_those(values: jax.Array) -> jax.Array:
        return jnp.take_along_axis(values, near, axis=1).reshape(-1)

    least = 2.0 * HALF_EXTENT_MIN
    x, y = of_those(past.xy[..., 0]), of_those(past.xy[..., 1])
    return raster_spans.marks(
        jnp.stack([x, y], axis=-1),
        of_those(past.yaw) - ego.yaw,
        jnp.maximum(scale * of_those(past.length), least),
        jnp.maximum(scale * of_those(past.width), least),
        (closeness > -jnp.inf).reshape(-1),
        jnp.repeat(first_plane + jnp.arange(_NUM_MOMENTS, dtype=jnp.int32), num),
        longest,
        ego,
        config,
    )


def _route(
    ego: EgoState, route: Route, route_idx: jax.Array, config: RasterConfig
) -> tuple[jax.Array, jax.Array]:
    """Marks of the broad line through the route points ahead, as `raster_spans.marks`."""
    num = min(ROUTE_AHEAD, config.reach_points)
    point = route_idx + jnp.arange(num, dtype=jnp.int32)
    xy = route.xy[jnp.minimum(point, route.xy.shape[0] - 1)]
    step = xy[1:] - xy[:-1]
    return raster_spans.marks(
        0.5 * (xy[1:] + xy[:-1]),
        jnp.arctan2(step[:, 1], step[:, 0]) - ego.yaw,
        jnp.hypot(step[:, 0], step[:, 1]) + 2.0 * _ROUTE_OVERLAP,
        jnp.full(num - 1, ROUTE_WIDTH, jnp.float32),
        point[1:] < route.num_points,
        jnp.full(num - 1, _ROUTE_PLANE, jnp.int32),
        _LONGEST_STRETCH,
        ego,
        config,
    )


def _signals(
    image: jax.Array,
    ego: EgoState,
    trail: Trail,
    route: Route,
    route_idx: jax.Array,
    config: RasterConfig,
) -> jax.Array:
    """Scatters the lights' stop lines and the stop sign of each moment onto the (H * W, 15) image.

    A place is the same at all moments, so each pixel takes the values of all four at once.
    """
    light, stop = (x[np.array(MOMENTS)] for x in (trail.light, trail.stop))
    ahead = route.stop_idx - route_idx
    near = (ahead > -LIGHTS_BEHIND) & (ahead < ROUTE_AHEAD) & (route.stop_kind == STOP_LIGHT)
    far = jnp.int32(1 << 20)
    most = min(_MOST_LINES, len(near))
    _, line = jax.lax.top_k(jnp.where(near, -jnp.abs(ahead), -far), most)
    colour = light[:, line].T
    value = jnp.where(colour == LIGHT_YELLOW, YELLOW_VALUE, GREEN_VALUE)
    value = jnp.where(colour == LIGHT_RED, RED_VALUE, value)  # (most, 4)
    width = route.stop_width
    at = box_pixels(
        poses(route.stop_xy[line], route.stop_yaw[line], ego, config),
        jnp.full(most, STOP_LINE_THICKNESS, jnp.float32),
        width[line] * STOP_LINE_FRAC,
        near[line],
        (STOP_LINE_THICKNESS, LANE_WIDTH_MAX * STOP_LINE_FRAC),
        config,
    )
    image = _scatter(image, at, value)
    for moment in range(_NUM_MOMENTS):
        sign = jnp.maximum(stop[moment], 0)[None]
        # The same sign at a later moment has been drawn with it.
        seen = (stop[moment] >= 0) & jnp.all(stop[:moment] != stop[moment])
        at = box_pixels(
            poses(route.stop_xy[sign], route.stop_yaw[sign], ego, config),
            width[sign],
            width[sign],
            seen[None],
            (LANE_WIDTH_MAX, LANE_WIDTH_MAX),
            config,
        )
        image = _scatter(image, at, jnp.where(stop == stop[moment], STOP_VALUE, 0)[None])
    return image


def _scatter(image: jax.Array, at: jax.Array, value: jax.Array) -> jax.Array:
    """Scatters (K, 4) values of the signals' channels to (K, S) pixels of the (H * W, 15) image."""
    value = value.astype(jnp.uint8)[:, None, :]
    return image.at[at, _SIGNALS : _SIGNALS + _NUM_MOMENTS].max(value, **SCATTER)


def _channel_table() -> np.ndarray:
    """(256 * 16, 15) uint8: the channels of each pair of bytes, row = second * 16 + first."""
    users, ground = np.divmod(np.arange(256 << _NUM_BITS), 1 << _NUM_BITS)
    lines = np.where(ground & 4, BROKEN_VALUE, SOLID_VALUE * (ground & 2 > 0))
    bits = [255 * (users >> bit & 1) for bit in range(_ROUTE_PLANE)]
    none = [np.zeros_like(users)] * _NUM_MOMENTS
    columns = [255 * (ground & 1), 255 * (ground & _ROUTE_BIT > 0), lines, *bits, *none]
    return np.stack(columns, axis=-1).astype(np.uint8)


_TABLE = _channel_table()
