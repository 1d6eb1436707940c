"""Plane geometry: angles, frames and oriented boxes.

Everything is elementwise and broadcasts, so one function serves a point and a batch of points.
There is no matrix product here on purpose: accelerators may round its inputs to TF32 or bfloat16,
which is decimetres on a coordinate of some hundred metres.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

TWO_PI = np.float32(2.0 * np.pi)
PI = np.float32(np.pi)


def wrap_angle(angle: jax.Array) -> jax.Array:
    """The same angle in [-pi, pi).

    Args:
      angle: any shape, rad.

    Returns:
      Same shape, rad.
    """
    # No remainder, which is a call for each number on a CPU.
    return angle - TWO_PI * jnp.floor((angle + PI) / TWO_PI)


def rotate(xy: jax.Array, yaw: jax.Array) -> jax.Array:
    """Turns vectors counter-clockwise.

    Args:
      xy: (..., 2), any unit.
      yaw: (...) rad, broadcasts against the leading axes of `xy`.

    Returns:
      (..., 2) in the unit of `xy`.
    """
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    x, y = xy[..., 0], xy[..., 1]
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def to_frame(xy: jax.Array, origin_xy: jax.Array, origin_yaw: jax.Array) -> jax.Array:
    """World points as seen from a pose (x forward, y left).

    Args:
      xy: (..., 2) m, world.
      origin_xy: (..., 2) m, world position of the pose.
      origin_yaw: (...) rad.

    Returns:
      (..., 2) m in the frame of the pose.
    """
    return rotate(xy - origin_xy, -origin_yaw)


def from_frame(xy: jax.Array, origin_xy: jax.Array, origin_yaw: jax.Array) -> jax.Array:
    """World points from points in the frame of a pose: the inverse of `to_frame`.

    Args:
      xy: (..., 2) m in the frame of the pose.
      origin_xy: (..., 2) m, world position of the pose.
      origin_yaw: (...) rad.

    Returns:
      (..., 2) m, world.
    """
    return rotate(xy, origin_yaw) + origin_xy


def squared_distance(a: jax.Array, b: jax.Array) -> jax.Array:
    """Squared distances of points, written out: a sum over an axis of two stays a loop on a CPU.

    Args:
      a: (..., 2) m.
      b: (..., 2) m; the leading axes of both broadcast.

    Returns:
      (...) m^2.
    """
    dx, dy = a[..., 0] - b[..., 0], a[..., 1] - b[..., 1]
    return dx * dx + dy * dy


def box_corners(xy: jax.Array, yaw: jax.Array, length: ArrayLike, width: ArrayLike) -> jax.Array:
    """Corners of an oriented box, counter-clockwise from its front left.

    Args:
      xy: (..., 2) m, box centre.
      yaw: (...) rad, direction of its length.
      length: (...) m.
      width: (...) m.

    Returns:
      (..., 4, 2) m: front left, rear left, rear right, front right.
    """
    half_length, half_width = 0.5 * jnp.asarray(length), 0.5 * jnp.asarray(width)
    along = jnp.stack([half_length, -half_length, -half_length, half_length], axis=-1)
    left = jnp.stack([half_width, half_width, -half_width, -half_width], axis=-1)
    offsets = jnp.stack(jnp.broadcast_arrays(along, left), axis=-1)  # (..., 4, 2)
    return rotate(offsets, jnp.asarray(yaw)[..., None]) + jnp.asarray(xy)[..., None, :]


def boxes_overlap(
    xy_a: jax.Array,
    yaw_a: jax.Array,
    length_a: ArrayLike,
    width_a: ArrayLike,
    xy_b: jax.Array,
    yaw_b: jax.Array,
    length_b: ArrayLike,
    width_b: ArrayLike,
) -> jax.Array:
    """Whether oriented boxes share area; boxes that only touch do not.

    Separating axes: two rectangles are apart exactly if their shadows are apart on one of the four
    directions of their sides. Source: Gottschalk, Lin, Manocha, OBBTree (1996), in the plane.
    All arguments broadcast, so one ego (no leading axis) goes against (N,) others.

    Args:
      xy_a: (..., 2) m, box centre.
      yaw_a: (...) rad.
      length_a: (...) m.
      width_a: (...) m.
      xy_b: (..., 2) m, box centre.
      yaw_b: (...) rad.
      length_b: (...) m.
      width_b: (...) m.

    Returns:
      (...) bool.
    """
    cos_a, sin_a = jnp.cos(yaw_a), jnp.sin(yaw_a)
    cos_b, sin_b = jnp.cos(yaw_b), jnp.sin(yaw_b)
    # Cosine and sine of the turn from a to b without two more calls: trigonometry is the cost here.
    cos = jnp.abs(cos_a * cos_b + sin_a * sin_b)
    sin = jnp.abs(cos_a * sin_b - sin_a * cos_b)
    dx, dy = xy_b[..., 0] - xy_a[..., 0], xy_b[..., 1] - xy_a[..., 1]
    along_a, left_a = jnp.abs(cos_a * dx + sin_a * dy), jnp.abs(cos_a * dy - sin_a * dx)
    along_b, left_b = jnp.abs(cos_b * dx + sin_b * dy), jnp.abs(cos_b * dy - sin_b * dx)
    return (
        (2.0 * along_a < length_a + length_b * cos + width_b * sin)
        & (2.0 * left_a < width_a + length_b * sin + width_b * cos)
        & (2.0 * along_b < length_b + length_a * cos + width_a * sin)
        & (2.0 * left_b < width_b + length_a * sin + width_a * cos)
    )
