"""The road world on the device: one lane table for all towns, and an atlas of pixels for each."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from carljax.sim import geometry

# Bits of `RoadMap.layers`.
LAYER_ROAD, LAYER_SHOULDER, LAYER_MARK_SOLID, LAYER_MARK_BROKEN, LAYER_JUNCTION, LAYER_PARKING = (
    1,
    2,
    4,
    8,
    16,
    32,
)
# Values of `RoadMap.walk_kind`: along pavements, over a crosswalk, over the road where there is
# none, and from a pavement to the kerb before either.
WALK_PAVEMENT, WALK_CROSSING, WALK_JAYWALK, WALK_TO_CROSSING, WALK_TO_JAYWALK = 0, 1, 2, 3, 4


class RoadMap(struct.PyTreeNode):
    """Lanes, lights and pixel atlases of M towns.

    All towns share one table of driving lanes; a lane's index says which town it belongs to.
    Consecutive OpenDRIVE lane sections with a single way on are joined into one lane here. Towns
    keep their own coordinates, so points of different towns may coincide; lane indices never do.

    Attributes:
      lane_start: (K,) int32, first row of the lane in the point table.
      lane_num_points: (K,) int32, at least 2.
      lane_length: (K,) m; points are evenly spaced, about 1 m apart.
      lane_end: (K,) m, to where it is wide enough to drive on; its length but where it tapers to an
        end.
      lane_speed_limit: (K,) m/s.
      lane_curve_speed: (K,) m/s, speed at which the lane's sharpest bend is comfortable.
      lane_successors: (K, F) int32, F the most ways on from any lane; -1 pads.
      lane_in_junction: (K,) bool.
      lane_junction: (K,) int32, running index of its junction, -1 outside.
      lane_slot: (K,) int32, place among the lanes of its junction, 0 outside.
      lane_meeting: (K, 2, J) over the slots of the same junction: who goes first, and where on both
        lanes the other one is too near, as whole numbers (`junctions.MEETING_STEPS`).
      lane_yield_s: (K,) m along it where it comes near the first lane that it has to mind at its
        junction: one it owes, or an equal one without lights; infinity where there is none.
      lane_signal: (K,) int32, SIGNAL_* bit shown by those who turn on it, 0 where it does not turn.
      lane_stop_s: (K,) m, where its stop line lies.
      lane_stop_kind: (K,) int32, STOP_*.
      lane_light: (K,) int32, row in the light table or -1.
      lane_town: (K,) int32.
      point_xy: (P, 2) m; point_z: (P,) m; point_yaw: (P,) rad; point_width: (P,) m.
      point_speed: (P,) m/s, comfortable there in view of all bends of the lane from there on.
      point_lane: (P,) int32.
      point_block: (P,) int32, the road block it lies in, counted within its town (`road_blocks`).
      point_left, point_right: (P,) int32, the point of the lane beside to which traffic may change;
        -1 where there is none, in junctions and across solid lines.
      point_oncoming: (P,) int32, the nearest point of oncoming traffic beside it where a car may
        appear, -1 for none.
      junction_arms: (Jn, A) int32 by `lane_junction`, lanes that lead into each junction, -1 pads.
      light_cycle: (L,) s, period of the junction's programme.
      light_start: (L,) s, when within it this light turns green.
      light_junction: (L,) int32, running index of its junction, -1 for a light on the open road.
      layers: (X,) uint8, LAYER_* bits at `PIXELS_PER_METRE`: the towns' pictures one after another,
        each row by row; row = y, column = x.
      nearest_point: (X,) int32, likewise; row in the point table of the nearest driving-lane point,
        -1 beyond 30 m.
      picture_start: (M,) int32, first pixel of each town.
      picture_size: (M, 2) int32, rows and columns of its picture.
      origin: (M, 2) m, world position of the centre of pixel [0, 0].
      spawn_lane: (Y, C) int32, places for traffic to appear when the ego is in that grid cell; -1
        pads. The towns' grids lie one after another, each row by row.
      spawn_s: (Y, C) m.
      grid_start: (M,) int32, first cell of each town.
      grid_size: (M, 2) int32, rows and columns of its grid, which covers its picture.
      walk_xyz: (Wn, 3) m, nodes of the towns' walk graphs; the last row belongs to none.
      walk_neighbours: (Wn, D) int32, D the most edges from any node; -1 pads.
      walk_yaw: (Wn, D) rad, direction of each edge.
      walk_kind: (Wn, D) int32, WALK_* of each edge.
      spawn_walk: (Y, C) int32, nodes for pedestrians to appear at, likewise.
    """

    lane_start: jax.Array
    lane_num_points: jax.Array
    lane_length: jax.Array
    lane_end: jax.Array
    lane_speed_limit: jax.Array
    lane_curve_speed: jax.Array
    lane_successors: jax.Array
    lane_in_junction: jax.Array
    lane_junction: jax.Array
    lane_slot: jax.Array
    lane_meeting: jax.Array
    lane_yield_s: jax.Array
    lane_signal: jax.Array
    lane_stop_s: jax.Array
    lane_stop_kind: jax.Array
    lane_light: jax.Array
    lane_town: jax.Array
    point_xy: jax.Array
    point_z: jax.Array
    point_yaw: jax.Array
    point_width: jax.Array
    point_speed: jax.Array
    point_lane: jax.Array
    point_block: jax.Array
    point_left: jax.Array
    point_right: jax.Array
    point_oncoming: jax.Array
    junction_arms: jax.Array
    light_cycle: jax.Array
    light_start: jax.Array
    light_junction: jax.Array
    layers: jax.Array
    nearest_point: jax.Array
    picture_start: jax.Array
    picture_size: jax.Array
    origin: jax.Array
    spawn_lane: jax.Array
    spawn_s: jax.Array
    grid_start: jax.Array
    grid_size: jax.Array
    walk_xyz: jax.Array
    walk_neighbours: jax.Array
    walk_yaw: jax.Array
    walk_kind: jax.Array
    spawn_walk: jax.Array


PIXELS_PER_METRE = 2.0


class LaneQuery(struct.PyTreeNode):
    """The nearest driving lane to a place.

    Attributes:
      lane: () int32, row in the lane table, -1 where no lane is within 30 m.
      s: () m along it.
      lateral: () m, positive to the left of its centre.
      yaw: () rad, its direction of travel.
      width: () m.
      z: () m.
      in_junction: () bool.
    """

    lane: jax.Array
    s: jax.Array
    lateral: jax.Array
    yaw: jax.Array
    width: jax.Array
    z: jax.Array
    in_junction: jax.Array


def pixel(road_map: RoadMap, town: jax.Array, xy: jax.Array) -> jax.Array:
    """Index into the atlases, () int32; -1 outside the town's picture.

    Args:
      road_map: the map.
      town: () int32.
      xy: (..., 2) m; the result has its leading shape.
    """
    height, width = road_map.picture_size[town]
    at = jnp.round((xy - road_map.origin[town]) * PIXELS_PER_METRE).astype(jnp.int32)
    column, row = at[..., 0], at[..., 1]
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return jnp.where(inside, road_map.picture_start[town] + row * width + column, -1)


def grid_cell(road_map: RoadMap, town: jax.Array, xy: jax.Array, cell_size: float) -> jax.Array:
    """Row of the spawn tables, () int32, of the grid cell around a place, or of the nearest one.

    Args:
      road_map: the map.
      town: () int32.
      xy: (2,) m.
      cell_size: m, side of a cell.
    """
    rows, columns = road_map.grid_size[town]
    at = ((xy - road_map.origin[town]) / cell_size).astype(jnp.int32)
    column, row = jnp.clip(at[0], 0, columns - 1), jnp.clip(at[1], 0, rows - 1)
    return road_map.grid_start[town] + row * columns + column


def picture(road_map: RoadMap, town: int, atlas: jax.Array | np.ndarray) -> np.ndarray:
    """One town's part of an atlas, on the host.

    Args:
      road_map: the map.
      town: its index.
      atlas: (X,) one value for each pixel of all towns.

    Returns:
      (rows, columns) of the town's picture.
    """
    start, (rows, columns) = road_map.picture_start[town], np.asarray(road_map.picture_size[town])
    return np.asarray(atlas)[int(start) :][: rows * columns].reshape(rows, columns)


def layer_bits(road_map: RoadMap, town: jax.Array, xy: jax.Array) -> jax.Array:
    """LAYER_* bits under each place, uint8 of xy's leading shape; 0 outside the picture."""
    index = pixel(road_map, town, xy)
    bits = road_map.layers[jnp.maximum(index, 0)]
    return jnp.where(index >= 0, bits, jnp.uint8(0))


def nearest_lane(road_map: RoadMap, town: jax.Array, xy: jax.Array) -> LaneQuery:
    """Projects a place onto the nearest driving lane.

    Args:
      road_map: the map.
      town: () int32.
      xy: (2,) m.

    Returns:
      The query; beyond 30 m of any lane `lane` is -1 and `lateral` is 30 m.
    """
    index = pixel(road_map, town, xy)
    point = road_map.nearest_point[jnp.maximum(index, 0)]
    found = (index >= 0) & (point >= 0)
    point = jnp.maximum(point, 0)
    yaw = road_map.point_yaw[point]
    offset = geometry.to_frame(xy, road_map.point_xy[point], yaw)
    lane = road_map.point_lane[point]
    spacing = road_map.lane_length[lane] / (road_map.lane_num_points[lane] - 1)
    s = (point - road_map.lane_start[lane]) * spacing + offset[0]
    return LaneQuery(
        lane=jnp.where(found, lane, -1),
        s=jnp.clip(s, 0.0, road_map.lane_length[lane]),
        lateral=jnp.where(found, offset[1], jnp.float32(30.0)),
        yaw=yaw,
        width=road_map.point_width[point],
        z=road_map.point_z[point],
        in_junction=road_map.lane_in_junction[lane] & found,
    )


def row_at(road_map: RoadMap, lane: jax.Array, s: jax.Array) -> jax.Array:
    """(...) int32, row in the point table of the point nearest to places on lanes.

    Args:
      road_map: the map.
      lane: (...) int32, rows of the lane table, not negative.
      s: (...) m; clipped to the lane.
    """
    last = road_map.lane_num_points[lane] - 1
    number = jnp.round(s * last / road_map.lane_length[lane]).astype(jnp.int32)
    return road_map.lane_start[lane] + jnp.clip(number, 0, last)


class Pose(struct.PyTreeNode):
    """A place on a lane in the world: xy (..., 2) m, z m, yaw rad, curvature 1/m."""

    xy: jax.Array
    z: jax.Array
    yaw: jax.Array
    curvature: jax.Array


def pose_at(road_map: RoadMap, lane: jax.Array, s: jax.Array) -> Pose:
    """World pose of places on lanes, linear between lane points.

    Args:
      road_map: the map.
      lane: (...) int32, rows of the lane table.
      s: (...) m; clipped to the lane.

    Returns:
      Poses of the same leading shape.
    """
    gaps = road_map.lane_num_points[lane] - 1
    spacing = road_map.lane_length[lane] / gaps
    along = jnp.clip(s / spacing, 0.0, gaps.astype(jnp.float32))
    first = jnp.minimum(along.astype(jnp.int32), gaps - 1)
    frac = along - first
    row = road_map.lane_start[lane] + first
    xy = road_map.point_xy[row]
    xy_next = road_map.point_xy[row + 1]
    yaw = road_map.point_yaw[row]
    turn = geometry.wrap_angle(road_map.point_yaw[row + 1] - yaw)
    z = road_map.point_z[row]
    return Pose(
        xy=xy + frac[..., None] * (xy_next - xy),
        z=z + frac * (road_map.point_z[row + 1] - z),
        yaw=geometry.wrap_angle(yaw + frac * turn),
        curvature=turn / spacing,
    )
