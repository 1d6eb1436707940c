"""The road world on the device: one lane table for all towns, and an atlas of pixels for each."""

from __future__ import annotations

import jax
from flax import struct

# Bits of `RoadMap.layers`.
LAYER_ROAD, LAYER_SHOULDER, LAYER_MARK_SOLID, LAYER_MARK_BROKEN, LAYER_JUNCTION, LAYER_PARKING = (
    1,
    2,
    4,
    8,
    16,
    32,
)


@struct.dataclass
class RoadMap:
    """Lanes, lights and pixel atlases of M towns.

    All towns share one table of driving lanes; a lane's index says which town it belongs to. Consecutive
    OpenDRIVE lane sections with a single way on are joined into one lane here. Towns keep their own
    coordinates, so points of different towns may coincide; lane indices never do.

    Attributes:
      lane_start: (K,) int32, first row of the lane in the point table.
      lane_num_points: (K,) int32, at least 2.
      lane_length: (K,) m; points are evenly spaced, about 1 m apart.
      lane_speed_limit: (K,) m/s.
      lane_curve_speed: (K,) m/s, speed at which the lane's sharpest bend is comfortable.
      lane_successors: (K, 4) int32, -1 pads.
      lane_in_junction: (K,) bool.
      lane_junction: (K,) int32, running index of its junction, -1 outside.
      lane_slot: (K,) int32, place among the lanes of its junction, 0 outside.
      lane_conflict: (K, J) uint8 over the slots of the same junction: 0 none, CONFLICT, CONFLICT_YIELD.
      lane_fork: (K,) int32, equal for lanes that leave the same lane.
      lane_stop_s: (K,) m, where its stop line lies.
      lane_stop_kind: (K,) int32, STOP_*.
      lane_light: (K,) int32, row in the light table or -1.
      lane_town: (K,) int32.
      point_xy: (P, 2) m; point_z: (P,) m; point_yaw: (P,) rad; point_width: (P,) m.
      point_lane: (P,) int32.
      light_cycle: (L,) s, period of the junction's programme.
      light_start: (L,) s, when within it this light turns green.
      layers: (M, H, W) uint8, LAYER_* bits at `PIXELS_PER_METRE`; row = y, column = x.
      nearest_point: (M, H, W) int32, row in the point table of the nearest driving-lane point, -1 beyond 30 m.
      origin: (M, 2) m, world position of the centre of pixel [0, 0].
      spawn_lane: (M, Gy, Gx, C) int32, places for traffic to appear when the ego is in that grid cell; -1 pads.
      spawn_s: (M, Gy, Gx, C) m.
    """

    lane_start: jax.Array
    lane_num_points: jax.Array
    lane_length: jax.Array
    lane_speed_limit: jax.Array
    lane_curve_speed: jax.Array
    lane_successors: jax.Array
    lane_in_junction: jax.Array
    lane_junction: jax.Array
    lane_slot: jax.Array
    lane_conflict: jax.Array
    lane_fork: jax.Array
    lane_stop_s: jax.Array
    lane_stop_kind: jax.Array
    lane_light: jax.Array
    lane_town: jax.Array
    point_xy: jax.Array
    point_z: jax.Array
    point_yaw: jax.Array
    point_width: jax.Array
    point_lane: jax.Array
    light_cycle: jax.Array
    light_start: jax.Array
    layers: jax.Array
    nearest_point: jax.Array
    origin: jax.Array
    spawn_lane: jax.Array
    spawn_s: jax.Array


PIXELS_PER_METRE = 2.0
