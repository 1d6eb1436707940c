"""The bird's-eye view image: ten byte channels around the ego, heading up.

Source: paper, "Observation", and the authors' code; `CHANNELS` gives the order. A pixel is put
together from two bytes. The first is what stands still (`raster_road`): one rotated gather from the
town's atlas, and the route as a further bit. The second is the road user there (`raster_users`). A
table turns both bytes into ten channels at once; the few stop lines and signs are scattered onto
the image itself. So the cost of road users does not depend on the size of the image, and no image
of floats is ever made.

Ours, not the paper's: the gather takes the nearest atlas pixel (the paper warps bilinearly); of
overlapping values of a channel the larger stays (there, the later one); a pixel shows one road
user, a pedestrian before an obstacle before a vehicle's light before a vehicle.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from carljax.sim import raster_road, raster_users
from carljax.sim.raster_canvas import CHANNELS, GATHER, NUM_CHANNELS, RasterConfig
from carljax.sim.raster_road import NUM_BITS, ROUTE_BIT
from carljax.sim.road_map import (
    LAYER_MARK_BROKEN,
    LAYER_MARK_SOLID,
    LAYER_ROAD,
    LAYER_SHOULDER,
    RoadMap,
)
from carljax.sim.route import Route
from carljax.sim.types import Agents, EgoState

SOLID_VALUE, BROKEN_VALUE = 255, 127  # source: the authors' code


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
    ground = raster_road.static(ego, road_map, route, config)
    ground = raster_road.route(ground, ego, route, route_idx, config)
    users = raster_users.road_users(ego, agents, config)
    index = users.astype(jnp.int32) << NUM_BITS | ground.astype(jnp.int32)
    image = jnp.asarray(_TABLE).at[index].get(**GATHER)
    image = raster_road.lights(image, ego, route, route_idx, light_state, light_time_left, config)
    image = raster_road.stop_sign(image, ego, route, route_idx, stop_satisfied, config)
    image = raster_road.speed_signs(image, ego, route, route_idx, config)
    return image.reshape(config.shape)


def _channel_table() -> np.ndarray:
    """(256 * 128, 10) uint8: the channels of each pair of bytes, row = second * 128 + first."""
    code, bits = np.divmod(np.arange(256 << NUM_BITS), 1 << NUM_BITS)
    columns = {
        "road": 255 * (bits & LAYER_ROAD > 0),
        "route": 255 * (bits & ROUTE_BIT > 0),
        "markings": np.where(
            bits & LAYER_MARK_BROKEN, BROKEN_VALUE, SOLID_VALUE * (bits & LAYER_MARK_SOLID > 0)
        ),
        "shoulder": 255 * (bits & LAYER_SHOULDER > 0),
        **raster_users.channels(code),
    }
    table = np.zeros((len(code), NUM_CHANNELS), np.uint8)
    for name, values in columns.items():
        table[:, CHANNELS.index(name)] = values
    return table


_TABLE = _channel_table()
