"""The static world as pixels, made once per town: layer bits and each pixel's nearest lane point.

Areas are filled by a rasterizer in `jax.numpy`. As graphics hardware does, it snaps corners to a
grid of 1/256 pixel and tests pixel centres in whole numbers, so that neighbours which share an edge
leave neither a gap nor a doubly covered pixel. Pixel [row, column] of an atlas covers the square of
one pixel around `origin + (column, row) / PIXELS_PER_METRE`.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

from carljax.sim.road_map import (
    LAYER_JUNCTION,
    LAYER_MARK_BROKEN,
    LAYER_MARK_SOLID,
    LAYER_PARKING,
    LAYER_ROAD,
    LAYER_SHOULDER,
    PIXELS_PER_METRE,
)
from carljax.sim.road_network import MARK_BROKEN, MARK_SOLID, Lane, RoadNetwork
from carljax.sim.size_class import SizeClass

# Lane types of OpenDRIVE 1.8 (table "e_laneType") on which a car travels.
DRIVING_KINDS = frozenset(
    {
        "driving",
        "bidirectional",
        "bus",
        "taxi",
        "HOV",
        "entry",
        "exit",
        "onRamp",
        "offRamp",
        "connectingRamp",
        "slipLane",
    }
)
SHOULDER_KINDS = frozenset({"shoulder", "stop"})  # "stop" is the hard shoulder of a motorway
PARKING_KINDS = frozenset({"parking"})

# Painted lines are drawn 1 m wide: CaRL draws 1 px (0.5 m) and its bilinear warp spreads that to
# about two pixels. It is also the thinnest line that a gather at 1 px/m can't miss.
MARK_WIDTH = 1.0

_SUBPIXELS = 256
_CHUNK = 2048  # polygons filled by one call of the compiled kernel
_WINDOWS = (8, 16, 32, 64)  # px; 64 keeps the whole-number edge test inside 32 bits
_CANVAS = SizeClass(1 << 21, steps=4)  # px, so that pictures of other sizes are no other program
_MAX_STEP = 8.0  # m, longest piece of a strip; keeps every piece inside the largest window


def frame(network: RoadNetwork, margin: float = 80.0) -> tuple[np.ndarray, tuple[int, int]]:
    """The pixel grid that covers a town.

    Args:
      network: the town.
      margin: m beyond the outermost lane on every side, so that a crop seldom leaves the atlas.

    Returns:
      (2,) float64 world position of the centre of pixel [0, 0], whole metres; (rows, columns).
    """
    kinds = DRIVING_KINDS | SHOULDER_KINDS | PARKING_KINDS
    lanes = [lane for lane in network.lanes if lane.kind in kinds]
    edges = [edge for lane in lanes for edge in _lane_edges(lane)]
    points = np.concatenate(edges)
    origin = np.floor(points.min(axis=0) - margin)
    extent = points.max(axis=0) + margin - origin
    columns, rows = np.ceil(extent * PIXELS_PER_METRE).astype(int) + 1
    return origin, (int(rows), int(columns))


def layers(network: RoadNetwork, origin: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The town's areas and lines as bits.

    Args:
      network: the town.
      origin: (2,) m, world position of the centre of pixel [0, 0].
      shape: rows and columns.

    Returns:
      `shape` uint8 of LAYER_* bits; row = y, column = x. Road is every driving and parking lane,
      junction the driving lanes inside junctions; of overlapping lines both bits are set.
    """
    driving = [lane for lane in network.lanes if lane.kind in DRIVING_KINDS]
    parking = [lane for lane in network.lanes if lane.kind in PARKING_KINDS]
    areas = {
        LAYER_ROAD: driving + parking,
        LAYER_SHOULDER: [lane for lane in network.lanes if lane.kind in SHOULDER_KINDS],
        LAYER_JUNCTION: [lane for lane in driving if lane.junction is not None],
        LAYER_PARKING: parking,
    }
    quads = {bit: [strip(*_lane_edges(lane)) for lane in lanes] for bit, lanes in areas.items()}
    for bit, kind in ((LAYER_MARK_SOLID, MARK_SOLID), (LAYER_MARK_BROKEN, MARK_BROKEN)):
        lines = [mark.xy[:, :2] for mark in network.marks if mark.kind == kind]
        quads[bit] = [line_quads(xy, MARK_WIDTH) for xy in lines]
    bits = np.zeros(shape, np.uint8)
    for bit, pieces in quads.items():
        if pieces:
            corners = (np.concatenate(pieces) - origin) * PIXELS_PER_METRE
            bits |= np.where(fill_polygons(corners, shape), np.uint8(bit), np.uint8(0))
    return bits


def nearest_point(
    points_xy: np.ndarray,
    origin: np.ndarray,
    shape: tuple[int, int],
    max_distance: float = 30.0,
) -> np.ndarray:
    """For each pixel the nearest of some points, exactly.

    Args:
      points_xy: (P, 2) m.
      origin: (2,) m, world position of the centre of pixel [0, 0].
      shape: rows and columns.
      max_distance: m.

    Returns:
      `shape` int32, row in `points_xy`; -1 where all are farther than `max_distance`.
    """
    tree = cKDTree(points_xy)
    # Blocks of pixels without any point in reach are left out first: most of a town is empty.
    block = 16
    rows, columns = (-(-size // block) for size in shape)
    centre = (np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1) + 0.5) * block
    reach = max_distance + block / PIXELS_PER_METRE  # more than half a block's diagonal
    distance, _ = tree.query(
        centre.reshape(-1, 2) / PIXELS_PER_METRE + origin, distance_upper_bound=reach, workers=-1
    )
    near = np.isfinite(distance).reshape(rows, columns)
    near = np.kron(near, np.ones((block, block), bool))[: shape[0], : shape[1]]
    row, column = np.nonzero(near)
    places = np.stack([column, row], axis=-1) / PIXELS_PER_METRE + origin
    _, index = tree.query(places, distance_upper_bound=max_distance, workers=-1)
    out = np.full(shape, -1, np.int32)
    out[row, column] = np.where(index < len(points_xy), index, -1)
    return out


def strip(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The quads between two borders, long ones cut into pieces.

    Args:
      left: (P, 2) m.
      right: (P, 2) m, the points opposite.

    Returns:
      (S, 4, 2) m.
    """
    length = np.linalg.norm(np.diff([left, right], axis=1), axis=-1).max(axis=0, initial=0.0)
    pieces = np.maximum(np.ceil(length / _MAX_STEP), 1).astype(int)
    at = np.concatenate(
        [i + np.arange(n) / n for i, n in enumerate(pieces)] + [[float(len(pieces))]]
    )
    index = np.arange(len(left))
    left = np.stack([np.interp(at, index, left[:, axis]) for axis in range(2)], axis=-1)
    right = np.stack([np.interp(at, index, right[:, axis]) for axis in range(2)], axis=-1)
    return np.stack([left[:-1], left[1:], right[1:], right[:-1]], axis=1)


def line_quads(xy: np.ndarray, width: float) -> np.ndarray:
    """A line of some width as quads, (S, 4, 2) m, half a width longer at either end.

    Args:
      xy: (P, 2) m, at least two different points.
      width: m.
    """
    step = np.diff(xy, axis=0)
    length = np.linalg.norm(step, axis=-1)
    xy = xy[np.concatenate([[True], length > 0.0])]
    step, length = step[length > 0.0], length[length > 0.0]
    if not len(step):
        return np.zeros((0, 4, 2))
    ahead = step / length[:, None]
    xy = xy.copy()
    xy[0] -= ahead[0] * width / 2
    xy[-1] += ahead[-1] * width / 2
    normal = np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1)
    normal = np.concatenate([normal[:1], normal[:-1] + normal[1:], normal[-1:]])
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    return strip(xy + normal * width / 2, xy - normal * width / 2)


def fill_polygons(corners: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Pixels whose centre lies inside any of some polygons, by the even-odd rule.

    Args:
      corners: (S, V, 2) column and row of each corner, in pixels from the first pixel's centre.
      shape: rows and columns.

    Returns:
      `shape` bool.

    Raises:
      ValueError: a polygon spans more than 64 pixels; cut it first.
    """
    num = shape[0] * shape[1]
    canvas = jnp.zeros(_CANVAS.round_up(num), jnp.bool_)
    size = np.array(shape, np.int32)
    for _, local, first, window in _chunks(corners):
        canvas = _fill_chunk(canvas, local, first, size, window)
    return np.asarray(canvas)[:num].reshape(shape)


def covered_pixels(corners: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Which polygons cover which pixels, by the rule of `fill_polygons`.

    Args:
      corners: as there.
      shape: rows and columns.

    Returns:
      Polygon (n,) and flat pixel (n,) of each pair.
    """
    polygons, pixels = [np.zeros(0, int)], [np.zeros(0, int)]
    for chosen, local, first, window in _chunks(corners):
        inside = np.asarray(_inside(local, window))
        polygon, row, column = np.nonzero(inside[: len(chosen)])
        column, row = column + first[polygon, 0], row + first[polygon, 1]
        kept = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
        polygons.append(chosen[polygon[kept]])
        pixels.append((row * shape[1] + column)[kept])
    return np.concatenate(polygons), np.concatenate(pixels)


def _chunks(corners: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, int]]:
    """Parts of polygons that fit into windows of one size.

    Yields:
      Their places, and the arguments of `_fill_chunk`: corners, first pixels, window.

    Raises:
      ValueError: a polygon spans more than 64 pixels.
    """
    snapped = np.round(np.asarray(corners, np.float64) * _SUBPIXELS).astype(np.int64)
    first = snapped.min(axis=1) // _SUBPIXELS  # (S, 2)
    size = (snapped.max(axis=1) // _SUBPIXELS - first + 1).max(axis=-1, initial=0)
    if size.max(initial=0) > _WINDOWS[-1]:
        raise ValueError(
            f"a polygon of {size.max()} pixels is too large to fill (at most {_WINDOWS[-1]})"
        )
    local = (snapped - first[:, None] * _SUBPIXELS).astype(np.int32)
    smaller = 0
    for window in _WINDOWS:
        chosen = np.flatnonzero((size > smaller) & (size <= window))
        smaller = window
        for start in range(0, len(chosen), _CHUNK):
            part = chosen[start : start + _CHUNK]
            pad = ((0, _CHUNK - len(part)), (0, 0))
            yield (
                part,
                np.pad(local[part], (*pad, (0, 0))),
                np.pad(first[part].astype(np.int32), pad),
                window,
            )


@functools.partial(jax.jit, static_argnames="window", donate_argnums=0)
def _fill_chunk(
    canvas: jax.Array,
    corners: jax.Array,
    first: jax.Array,
    shape: jax.Array,
    window: int,
) -> jax.Array:
    """Adds polygons to a flat canvas.

    Args:
      canvas: bool, at least rows * columns.
      corners: (S, V, 2) int32 column and row in 1/256 pixel from the pixel `first`; equal corners
        make an empty polygon.
      first: (S, 2) int32 column and row.
      shape: (2,) int32 rows and columns.
      window: px, side of the square in which every polygon lies.
    """
    inside = _inside(corners, window)
    column = first[:, 0, None, None] + jnp.arange(window, dtype=jnp.int32)[None, None, :]
    row = first[:, 1, None, None] + jnp.arange(window, dtype=jnp.int32)[None, :, None]
    on_canvas = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    index = jnp.where(inside & on_canvas, row * shape[1] + column, canvas.shape[0])
    return canvas.at[index].set(True, mode="drop")


@functools.partial(jax.jit, static_argnames="window")
def _inside(corners: jax.Array, window: int) -> jax.Array:
    """(S, window, window) bool: pixels inside polygons; arguments as of `_fill_chunk`."""
    pixel = jnp.arange(window, dtype=jnp.int32) * _SUBPIXELS
    x, y = pixel[None, None, :], pixel[None, :, None]
    inside = jnp.zeros((corners.shape[0], window, window), jnp.bool_)
    for v in range(corners.shape[1]):
        a, b = corners[:, v - 1, :, None, None], corners[:, v, :, None, None]  # (S, 2, 1, 1)
        spans = (a[:, 1] <= y) != (b[:, 1] <= y)
        cross = (b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (x - a[:, 0]) * (b[:, 1] - a[:, 1])
        # The edge lies to the right of the pixel: half open, so a shared edge counts once.
        inside ^= spans & jnp.where(b[:, 1] > a[:, 1], cross > 0, cross < 0)
    return inside


def _lane_edges(lane: Lane) -> tuple[np.ndarray, np.ndarray]:
    """Left and right border of a lane, (P, 2) m each."""
    normal = np.stack([-np.sin(lane.yaw), np.cos(lane.yaw)], axis=-1)
    offset = normal * lane.width[:, None] / 2
    return lane.xyz[:, :2] + offset, lane.xyz[:, :2] - offset
