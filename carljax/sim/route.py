"""A route of about 1 km through the lane graph, as points 1 m apart."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from carljax.sim import geometry

# source: the authors' code draws lights from 20 points behind the ego to 150 ahead
WINDOW_BACK = 24  # points kept behind the ego
WINDOW_AHEAD = 152  # points kept ahead
WINDOW = WINDOW_BACK + WINDOW_AHEAD
LOOK_AHEAD = 6  # the current point and the next five. source: the authors' code


class Route(struct.PyTreeNode):
    """One route (the bank holds S of them with a leading axis).

    Attributes:
      xy: (R, 2) m, lane centre points about 1 m apart; the last valid point repeats to the end.
      yaw: (R,) rad, direction of travel.
      s: (R,) m, arc length.
      lane: (R,) int32, row in the lane table.
      lane_s: (R,) m, arc length on that lane.
      speed_limit: (R,) m/s in force at the point (last sign passed; 30 km/h at the start where the
        town has signs. source: paper, Soft Penalties).
      in_junction: (R,) bool.
      num_points: () int32.
      length: () m, of the whole route.
      z: () m, height of its first point.
      town: () int32.
      stop_idx: (Q,) int32, route index of each stop line.
      stop_xy: (Q, 2) m, its centre; stop_yaw: (Q,) rad, direction of travel; stop_s: (Q,) m on the
        route.
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
    length: jax.Array
    z: jax.Array
    town: jax.Array
    stop_idx: jax.Array
    stop_xy: jax.Array
    stop_yaw: jax.Array
    stop_s: jax.Array
    stop_kind: jax.Array
    stop_light: jax.Array
    stop_width: jax.Array
    sign_xy: jax.Array
    sign_idx: jax.Array
    sign_limit: jax.Array


# Arrays with one row a route point; the others describe the route as a whole.
_POINT_FIELDS = ("xy", "yaw", "s", "lane", "lane_s", "speed_limit", "in_junction")


def window(routes: Route, episode_idx: jax.Array, route_idx: jax.Array) -> tuple[Route, jax.Array]:
    """The stretch of a route around the ego, so that a step copies 200 points instead of 1,000.

    Args:
      routes: the bank's, leading axis S; R is at least WINDOW.
      episode_idx: () int32.
      route_idx: () int32, last passed point.

    Returns:
      The route with R = WINDOW and all indices counted from the window's start, and that start,
      () int32.
    """
    num = routes.s.shape[1]
    start = jnp.clip(route_idx - WINDOW_BACK, 0, num - WINDOW)

    def stretch(rows: jax.Array) -> jax.Array:
        begin: list[Any] = [episode_idx, start, *[0] * (rows.ndim - 2)]
        return jax.lax.dynamic_slice(rows, begin, (1, WINDOW, *rows.shape[2:]))[0]

    whole = jax.tree.map(lambda x: x[episode_idx], routes.replace(**dict.fromkeys(_POINT_FIELDS)))
    part = {name: stretch(getattr(routes, name)) for name in _POINT_FIELDS}
    # Padding stays negative, so that it is never taken for a point of the window.
    far = jnp.int32(-(1 << 20))
    return (
        whole.replace(
            **part,
            num_points=whole.num_points - start,
            stop_idx=jnp.where(whole.stop_idx >= 0, whole.stop_idx - start, far),
            sign_idx=jnp.where(whole.sign_idx >= 0, whole.sign_idx - start, far),
        ),
        start,
    )


def advance(route: Route, route_idx: jax.Array, xy: jax.Array) -> jax.Array:
    """The last passed point after a move.

    A point is passed once the ego is ahead of it; only the next two are looked at, which credits at
    most 2 m a step. source: the authors' code.

    Args:
      route: a route or a window of one.
      route_idx: () int32, before.
      xy: (2,) m, ego.

    Returns:
      () int32.
    """
    following = jnp.minimum(route_idx + jnp.arange(1, 3), route.num_points - 1)
    offset = xy - route.xy[following]
    yaw = route.yaw[following]
    passed = offset[:, 0] * jnp.cos(yaw) + offset[:, 1] * jnp.sin(yaw) > 0.0
    return jnp.where(passed[1], following[1], jnp.where(passed[0], following[0], route_idx))


def distance(route: Route, route_idx: jax.Array, xy: jax.Array) -> jax.Array:
    """() m, to the nearest of the current and the next five points."""
    near = _near(route, route_idx)
    return jnp.sqrt(geometry.squared_distance(route.xy[near], xy).min())


def nearest(route: Route, route_idx: jax.Array, xy: jax.Array) -> jax.Array:
    """() int32, the nearest of the current and the next five points."""
    near = _near(route, route_idx)
    return near[geometry.squared_distance(route.xy[near], xy).argmin()]


def _near(route: Route, route_idx: jax.Array) -> jax.Array:
    return jnp.minimum(route_idx + jnp.arange(LOOK_AHEAD), route.num_points - 1)
