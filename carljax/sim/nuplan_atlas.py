"""What nuPlan's bird's-eye view shows of a town, as pixels made once; host only.

Pixels of the atlas are of kinds: whether they are drivable, on a lane's border or on a stop line,
whose centre line crosses them, and which road blocks cover them (in junctions several may, and a
set of blocks that occurs is a cell). A town has some thousand kinds. So an image is a gather of
kinds and a gather from a table of what each kind shows now; and whether a cell is on a route is
found once for every route.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from carljax.sim import atlas
from carljax.sim.atlas import MARK_WIDTH
from carljax.sim.road_map import LAYER_ROAD, PIXELS_PER_METRE, RoadMap, picture
from carljax.sim.route import Route
from carljax.sim.size_class import SizeClass
from carljax.sim.types import STOP_NONE

DRIVABLE, BORDER, STOP_LINE = 1, 2, 4  # bits of `NuplanAtlas.kind_bits`
# Kinds and cells of a town. A table of the kinds is made for every image: little of it is padding.
KINDS, CELLS = SizeClass(1024, steps=8), SizeClass(1024)
_PIECES = 4  # most lanes, one behind the other, that a way through a junction is cut into


class NuplanAtlas(struct.PyTreeNode):
    """The pixels of M towns and the routes' cells in them; kinds and cells count within a town.

    Attributes:
      pixels: (X,) int32, kind of each pixel, in the order of `RoadMap.layers`; 0 shows nothing.
      kind_bits: (M, Q) uint8, of the constants above.
      kind_lane: (M, Q) int32, row in the lane table of the centre line there, -1 for none.
      kind_cell: (M, Q) int32, 0 where there is no block.
      cell_on_route: (S, C) bool, for each route of the bank the cells that it covers.
      lane_light: (K,) int32, row of the light table that governs a junction's lane; -1 elsewhere.
    """

    pixels: jax.Array
    kind_bits: jax.Array
    kind_lane: jax.Array
    kind_cell: jax.Array
    cell_on_route: jax.Array
    lane_light: jax.Array


def build(road_map: RoadMap, routes: Route) -> NuplanAtlas:
    """Makes the pixels of all towns and finds the cells of all routes.

    Args:
      road_map: the towns.
      routes: the bank's, leading axis S.

    Returns:
      The atlas.
    """
    world: Any = jax.tree.map(np.asarray, road_map)
    made = [_town(world, town) for town, size in enumerate(world.picture_size) if size.all()]
    pixels = np.concatenate([pixels.reshape(-1) for pixels, _, _ in made])
    # Padding, and kinds that a town lacks, show nothing.
    pixels = np.pad(pixels, (0, len(world.layers) - len(pixels)))
    kinds = np.zeros((len(world.origin), KINDS.round_up(max(len(k) for _, k, _ in made)), 3), int)
    for town, (_, own, _) in enumerate(made):
        kinds[town, : len(own)] = own
    bits, lane, cell = np.moveaxis(kinds, -1, 0)
    blocks = [b for _, _, b in made]
    route_blocks = _route_blocks(world, jax.tree.map(np.asarray, routes))
    return NuplanAtlas(
        pixels=jnp.asarray(pixels, jnp.int32),
        kind_bits=jnp.asarray(bits, jnp.uint8),
        kind_lane=jnp.asarray(lane - 1, jnp.int32),
        kind_cell=jnp.asarray(cell, jnp.int32),
        cell_on_route=jnp.asarray(_on_route(blocks, route_blocks, np.asarray(routes.town))),
        lane_light=jnp.asarray(_connector_lights(world), jnp.int32),
    )


def _town(world: Any, town: int) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """A town's pixels (H, W); its kinds (Q, 3): bits, lane + 1, cell; the blocks of each cell."""
    layers, origin = picture(world, town, world.layers), world.origin[town].astype(float)
    shape = layers.shape
    left, right, row = _quads_of(world, town)
    cell, blocks = _cells(left, right, world.point_block[row], origin, shape)
    bits = np.where(layers & LAYER_ROAD, DRIVABLE, 0)
    outside = ~world.lane_in_junction[world.point_lane[row]]
    borders = np.concatenate([line[outside] for line in (left, right)])
    bits |= _filled(_thick(borders), origin, shape) * BORDER
    bits |= _filled(_stop_lines(world, town), origin, shape) * STOP_LINE
    lane = _centre_lines(world, town, origin) + 1
    # One number for all three, the first pixel's left over for what shows nothing.
    number = (cell.astype(np.int64) * (lane.max() + 1) + lane) * 8 + bits
    values, pixels = np.unique(np.append(number, 0), return_inverse=True)
    rest = values // 8
    kinds = np.stack([values % 8, rest % (lane.max() + 1), rest // (lane.max() + 1)], axis=-1)
    return pixels[:-1].reshape(shape), kinds, blocks


def _quads_of(world: Any, town: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The left and the right border of each piece of the town's lanes, (n, 2, 2) m, and its row."""
    lanes = np.flatnonzero(world.lane_town == town)
    pieces = world.lane_num_points[lanes] - 1
    row = np.repeat(world.lane_start[lanes] - np.cumsum(pieces) + pieces, pieces)
    row += np.arange(len(row))
    yaw, half = world.point_yaw.astype(float), world.point_width.astype(float)[:, None] / 2
    offset = half * np.stack([-np.sin(yaw), np.cos(yaw)], axis=-1)
    xy = world.point_xy.astype(float)
    left, right = xy + offset, xy - offset
    return left[row[:, None] + [0, 1]], right[row[:, None] + [0, 1]], row


def _cells(
    left: np.ndarray, right: np.ndarray, block: np.ndarray, origin: np.ndarray, shape: Any
) -> tuple[np.ndarray, list[np.ndarray]]:
    """The cell of each pixel, (H, W), 0 where there is no block; the blocks of each cell."""
    quads = np.stack([left[:, 0], left[:, 1], right[:, 1], right[:, 0]], axis=1)
    piece, pixel = atlas.covered_pixels((quads - origin) * PIXELS_PER_METRE, shape)
    pairs = np.unique(np.stack([pixel, block[piece]], axis=1), axis=0)
    pixel, begin, num = np.unique(pairs[:, 0], return_index=True, return_counts=True)
    sets = np.full((len(pixel), num.max(initial=1)), -1)
    place = np.arange(len(pairs)) - np.repeat(begin, num)
    sets[np.repeat(np.arange(len(pixel)), num), place] = pairs[:, 1]
    kinds, kind = np.unique(sets, axis=0, return_inverse=True)
    cell = np.zeros(shape[0] * shape[1], int)
    cell[pixel] = kind.reshape(-1) + 1
    return cell.reshape(shape), [np.zeros(0, int), *(x[x >= 0] for x in kinds)]


def _thick(lines: np.ndarray) -> np.ndarray:
    """Line pieces (n, 2, 2) m as quads (n, 4, 2) m, half their width longer at either end."""
    ahead = lines[:, 1] - lines[:, 0]
    ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9) * MARK_WIDTH / 2
    side = np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1)
    begin, end = lines[:, 0] - ahead, lines[:, 1] + ahead
    return np.stack([begin + side, end + side, end - side, begin - side], axis=1)


def _stop_lines(world: Any, town: int) -> np.ndarray:
    """The stop lines of all lanes, as wide as the lane, (n, 4, 2) m."""
    lane = np.flatnonzero((world.lane_stop_kind != STOP_NONE) & (world.lane_town == town))
    last = world.lane_num_points[lane] - 1
    at = np.clip(world.lane_stop_s[lane] / world.lane_length[lane], 0.0, 1.0) * last
    first = np.minimum(at.astype(int), last - 1)
    row, frac = world.lane_start[lane] + first, (at - first)[:, None]
    xy = (1.0 - frac) * world.point_xy[row] + frac * world.point_xy[row + 1]
    yaw, half = world.point_yaw[row], (world.point_width[row] - MARK_WIDTH)[:, None] / 2
    side = half * np.stack([-np.sin(yaw), np.cos(yaw)], axis=-1)
    return _thick(np.stack([xy - side, xy + side], axis=1))


def _filled(quads: np.ndarray, origin: np.ndarray, shape: Any) -> np.ndarray:
    return atlas.fill_polygons((quads - origin) * PIXELS_PER_METRE, shape)


def _centre_lines(world: Any, town: int, origin: np.ndarray) -> np.ndarray:
    """(H, W) row of the lane whose centre line covers a pixel, the nearest one; -1 elsewhere."""
    point = picture(world, town, world.nearest_point)
    row, column = np.nonzero(point >= 0)
    at = point[row, column]
    offset = np.stack([column, row], axis=-1) / PIXELS_PER_METRE + origin - world.point_xy[at]
    cos, sin = np.cos(world.point_yaw[at]), np.sin(world.point_yaw[at])
    along = cos * offset[:, 0] + sin * offset[:, 1]
    across = cos * offset[:, 1] - sin * offset[:, 0]
    # Points are a metre apart or less, so within half a metre along there is one.
    on = (np.abs(across) <= MARK_WIDTH / 2) & (np.abs(along) <= MARK_WIDTH / 2 + 0.1)
    out = np.full(point.shape, -1)
    out[row[on], column[on]] = world.point_lane[at[on]]
    return out


def _connector_lights(world: Any) -> np.ndarray:
    """(K,) light of each lane inside a junction: its own, or that of a lane that leads into it."""
    light = world.lane_light.copy()
    lane, place = np.nonzero(world.lane_successors >= 0)
    after = world.lane_successors[lane, place]
    for _ in range(_PIECES):
        same = world.light_junction[np.maximum(light[lane], 0)] == world.lane_junction[after]
        new = world.lane_in_junction[after] & (light[after] < 0) & (light[lane] >= 0) & same
        light[after[new]] = light[lane[new]]
    return np.where(world.lane_in_junction, light, -1)


def _route_blocks(world: Any, routes: Any) -> list[np.ndarray]:
    """The road blocks that each route passes."""
    lane = routes.lane
    last = world.lane_num_points[lane] - 1
    number = np.round(routes.lane_s * last / world.lane_length[lane]).astype(int)
    block = world.point_block[world.lane_start[lane] + np.clip(number, 0, last)]
    return [np.unique(block[i, :num]) for i, num in enumerate(routes.num_points)]


def _on_route(cells: Any, route_blocks: list[np.ndarray], towns: np.ndarray) -> np.ndarray:
    """(S, C) bool, whether one of the route's blocks covers a cell of its town."""
    out = np.zeros((len(towns), CELLS.round_up(max(len(blocks) for blocks in cells))), bool)
    num_blocks = 1 + max(int(b.max(initial=0)) for blocks in cells for b in blocks)
    for town, blocks in enumerate(cells):
        member = np.concatenate(blocks)
        cell = np.repeat(np.arange(len(blocks)), [len(b) for b in blocks])
        for route in np.flatnonzero(towns == town):
            is_on = np.zeros(num_blocks, bool)
            is_on[route_blocks[route][route_blocks[route] < num_blocks]] = True
            out[route, cell[is_on[member]]] = True
    return out
