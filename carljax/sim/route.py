"""A route of about 1 km through the lane graph, as points 1 m apart."""

from __future__ import annotations

import jax
from flax import struct


@struct.dataclass
class Route:
    """One route (the bank holds S of them with a leading axis).

    Attributes:
      xy: (R, 2) m, lane centre points about 1 m apart; the last valid point repeats to the end.
      yaw: (R,) rad, direction of travel.
      s: (R,) m, arc length.
      lane: (R,) int32, row in the lane table.
      lane_s: (R,) m, arc length on that lane.
      speed_limit: (R,) m/s in force at the point (last sign passed; 30 km/h at the start where the town has
        signs. source: paper, Soft Penalties).
      in_junction: (R,) bool.
      num_points: () int32.
      town: () int32.
      stop_idx: (Q,) int32, route index of each stop line.
      stop_kind: (Q,) int32, STOP_*; STOP_NONE pads.
      stop_light: (Q,) int32, row in the light table or -1.
      stop_width: (Q,) m, lane width there.
      sign_xy: (G, 2) m, where each speed sign of the route stands.
      sign_idx: (G,) int32, its route index; -1 pads.
      sign_limit: (G,) m/s.
    """

    xy: jax.Array
    yaw: jax.Array
    s: jax.Array
    lane: jax.Array
    lane_s: jax.Array
    speed_limit: jax.Array
    in_junction: jax.Array
    num_points: jax.Array
    town: jax.Array
    stop_idx: jax.Array
    stop_kind: jax.Array
    stop_light: jax.Array
    stop_width: jax.Array
    sign_xy: jax.Array
    sign_idx: jax.Array
    sign_limit: jax.Array
