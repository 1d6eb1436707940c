"""The way ahead: the ego's route from where it is, sampled every metre, fit to be driven.

A route jumps from lane to lane where it changes lane. Its points are shifted here, so that the jump
becomes a smooth change over some tens of metres, there or later; elsewhere they stay where they
are.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from carljax.sim import geometry, route
from carljax.sim.env import DrivingEnv
from carljax.sim.route import Route
from carljax.sim.types import SimState

SAMPLES = 96  # m that are looked ahead: 4.5 s at 80 km/h, and room to brake for a bend
NEAR_BACK, NEAR_AHEAD = 6, 24  # route points around the last passed one that the ego may be at
JUMP = 1.0  # m sideways between two route points: no bend is so tight, no lane so narrow
# m before and after the jump over which a lane is changed. source: ours; at 0.72 * 80 km/h it takes
# 2.5 s and a lateral acceleration of 3.5 m/s^2
CHANGE_LENGTH = 20
# Points of the route kept behind the ego, beyond those of `route.WINDOW_BACK`: changes that are put
# off lie there.
MORE_BACK = 48
_HUMP = 1.0 + np.cos(np.linspace(-np.pi, np.pi, 2 * CHANGE_LENGTH + 1))
_HUMP = (_HUMP / _HUMP.sum()).astype(np.float32)


class Way(struct.PyTreeNode):
    """K = SAMPLES places on the route, 1 m apart, the first beside the ego's centre.

    Attributes:
      xy: (K, 2) m.
      yaw: (K,) rad, direction of travel.
      curvature: (K,) 1/m, positive to the left.
      speed_limit: (K,) m/s in force.
      in_junction: (K,) bool.
      lane: (K,) int32, row in the lane table.
      lane_s: (K,) m on it.
      stop_distance: (Q,) m from the ego's centre along the way to each stop line of the route.
    """

    xy: jax.Array
    yaw: jax.Array
    curvature: jax.Array
    speed_limit: jax.Array
    in_junction: jax.Array
    lane: jax.Array
    lane_s: jax.Array
    stop_distance: jax.Array


class Stretch(struct.PyTreeNode):
    """The route around the ego.

    Attributes:
      route: a window of it.
      xy: (W, 2) m, its points with lane changes drawn out.
      at: () where the ego is, in points from the window's start.
      sideways: (W,) m to the left by which the route jumps to each point, 0 where it does not.
    """

    route: Route
    xy: jax.Array
    at: jax.Array
    sideways: jax.Array


def stretch(env: DrivingEnv, sim: SimState, delay: jax.Array | float = 0.0) -> Stretch:
    """Finds the ego on its route.

    Args:
      env: the environment.
      sim: its state.
      delay: () m by which changes of lane are put off.

    Returns:
      The route around the ego.
    """
    window, first = route.window(env.bank.routes, sim.episode_idx, sim.route_idx - MORE_BACK)
    sideways = jumps(window)
    xy = smooth(window, sideways, delay)
    near = sim.route_idx - first + jnp.arange(-NEAR_BACK, NEAR_AHEAD)
    near = jnp.clip(near, 0, window.num_points - 1)
    offset = sim.ego.xy - xy[near]
    nearest = near[jnp.argmin((offset**2).sum(axis=1))]
    along = geometry.to_frame(sim.ego.xy, xy[nearest], window.yaw[nearest])[0]
    return Stretch(window, xy, jnp.maximum(nearest + along, 0.0), sideways)


def ahead(found: Stretch) -> Way:
    """Samples the way; points of a route lie 1 m apart, so that an index is a distance.

    Args:
      found: the ego on its route.

    Returns:
      The way from there.
    """
    window = found.route
    at = found.at + jnp.arange(-1, SAMPLES + 1, dtype=jnp.float32)
    last = window.num_points - 1
    base = jnp.clip(at.astype(jnp.int32), 0, last - 1)
    frac = (at - base)[:, None]
    xy = found.xy[base] + frac * (found.xy[base + 1] - found.xy[base])
    step = xy[2:] - xy[:-2]
    yaw = jnp.arctan2(step[:, 1], step[:, 0])
    turn = geometry.wrap_angle(yaw[2:] - yaw[:-2]) * jnp.float32(0.5)
    row = jnp.clip(jnp.round(at[1:-1]).astype(jnp.int32), 0, last)
    line = jnp.clip(window.stop_idx, 0, last)
    to_line = window.stop_idx - (window.s[line] - window.stop_s) - found.at
    is_known = (window.stop_idx >= 0) & (window.stop_idx <= last)
    return Way(
        xy=xy[1:-1],
        yaw=yaw,
        curvature=jnp.concatenate([turn[:1], turn, turn[-1:]]),
        speed_limit=window.speed_limit[row],
        in_junction=window.in_junction[row],
        lane=window.lane[row],
        lane_s=window.lane_s[row] + (at[1:-1] - row),
        stop_distance=jnp.where(is_known, to_line, jnp.inf),
    )


def jumps(window: Route) -> jax.Array:
    """(W,) m, see `Stretch.sideways`."""
    num = window.xy.shape[0]
    sideways = geometry.to_frame(window.xy[1:], window.xy[:-1], window.yaw[:-1])[:, 1]
    is_jump = (jnp.abs(sideways) > JUMP) & (jnp.arange(1, num) < window.num_points)
    return jnp.pad(jnp.where(is_jump, sideways, 0.0), (1, 0))


def smooth(window: Route, sideways: jax.Array, delay: jax.Array | float = 0.0) -> jax.Array:
    """(W, 2) m, route points with lane changes drawn out.

    What lies to the left of where the route began is a staircase along it; the points are moved by
    the difference between that staircase, averaged under a hump and put off, and the staircase
    itself.

    Args:
      window: of the route.
      sideways: (W,) m, its `jumps`.
      delay: () m by which changes are put off.
    """
    num = window.xy.shape[0]
    stairs = jnp.cumsum(sideways)
    padded = jnp.pad(stairs, CHANGE_LENGTH, mode="edge")
    averaged = jnp.stack([w * padded[k : k + num] for k, w in enumerate(_HUMP)]).sum(axis=0)
    at = jnp.clip(jnp.arange(num, dtype=jnp.float32) - delay, 0.0, num - 1.0)
    base = jnp.minimum(at.astype(jnp.int32), num - 2)
    put_off = averaged[base] + (at - base) * (averaged[base + 1] - averaged[base])
    left = jnp.stack([-jnp.sin(window.yaw), jnp.cos(window.yaw)], axis=-1)
    return window.xy + (put_off - stairs)[:, None] * left


def pose(way: Way, distance: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Places on the way: xy (..., 2) m and yaw (...) rad at distances (...) m, cut to the way."""
    along = jnp.clip(distance, 0.0, SAMPLES - 1.0)
    base = jnp.minimum(along.astype(jnp.int32), SAMPLES - 2)
    frac = along - base
    xy = way.xy[base] + frac[..., None] * (way.xy[base + 1] - way.xy[base])
    turn = geometry.wrap_angle(way.yaw[base + 1] - way.yaw[base])
    return xy, way.yaw[base] + frac * turn
