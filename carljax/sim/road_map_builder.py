"""Towns from the host to the device: one lane table for all, one atlas each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from carljax.sim import atlas, junctions, road_blocks, spawn, walk_graph
from carljax.sim.road_map import PIXELS_PER_METRE, WALK_PAVEMENT, RoadMap
from carljax.sim.town import Town, offsets
from carljax.sim.types import SIGNAL_LEFT, SIGNAL_RIGHT


def build(towns: Sequence[Town], seed: int = 0) -> RoadMap:
    """Puts towns side by side into one lane table and rasterises each once.

    Args:
      towns: at least one.
      seed: of the choice of respawn places.

    Returns:
      The map; `town.offsets(towns)` tells where the rows of each town begin.
    """
    arrays = {**_lane_arrays(towns), **_walk_arrays(towns), **_atlases(towns, seed)}
    return RoadMap(**{name: _on_device(value) for name, value in arrays.items()})


def _on_device(value: np.ndarray) -> jax.Array:
    wanted: Any = {"f": np.float32, "i": np.int32, "b": bool, "u": value.dtype}[value.dtype.kind]
    return jnp.asarray(value.astype(wanted))


def _shift(index: np.ndarray, offset: int) -> np.ndarray:
    """Moves indices to their place in the shared table; -1 stays what it is."""
    return np.where(index >= 0, index + offset, index)


def _widen(rows: np.ndarray, columns: int, fill: int) -> np.ndarray:
    """Pads rows on the right."""
    missing = [(0, 0)] * (rows.ndim - 1) + [(0, columns - rows.shape[-1])]
    return np.pad(rows, missing, constant_values=fill)


def _lane_arrays(towns: Sequence[Town]) -> dict[str, np.ndarray]:
    rows: dict[str, list[np.ndarray]] = {}
    slots = max(t.junctions.conflict.shape[1] for t in towns)
    arms = [spawn.arms(t.lanes, t.junctions.junction) for t in towns]
    most_arms = max(a.shape[1] for a in arms)
    forks = max(t.lanes.successors.shape[1] for t in towns)
    for town, first in zip(towns, offsets(towns), strict=True):
        table, cross, light = town.lanes, town.junctions, town.lights
        arrays = {
            "lane_start": table.start + first.point,
            "lane_num_points": table.num_points,
            "lane_length": table.length,
            "lane_end": table.end,
            "lane_speed_limit": table.speed_limit,
            "lane_curve_speed": table.curve_speed,
            "lane_successors": _widen(_shift(table.successors, first.lane), forks, -1),
            "lane_in_junction": cross.junction >= 0,
            "lane_junction": _shift(cross.junction, first.junction),
            "lane_slot": cross.slot,
            "lane_meeting": _widen(cross.meeting, slots, 0),
            "lane_yield_s": cross.yield_s,
            "lane_signal": _turn_signals(town),
            "lane_stop_s": table.stop_s,
            "lane_stop_kind": table.stop_kind,
            "lane_light": _shift(light.lane_light, first.light),
            "lane_town": np.full(len(table.length), first.town),
            "point_xy": table.point_xyz[:, :2],
            "point_z": table.point_xyz[:, 2],
            "point_yaw": table.point_yaw,
            "point_width": table.point_width,
            "point_speed": table.point_speed,
            "point_lane": table.point_lane + first.lane,
            "point_oncoming": _shift(
                spawn.oncoming(table, town.network.left_hand_traffic), first.point
            ),
            "point_block": road_blocks.of_points(town.network, table),
            "point_left": _shift(town.neighbours.left, first.point),
            "point_right": _shift(town.neighbours.right, first.point),
            "junction_arms": _widen(_shift(arms[first.town], first.lane), most_arms, -1),
            "light_cycle": light.cycle,
            "light_start": light.start,
            "light_junction": _shift(light.junction, first.junction),
        }
        for name, value in arrays.items():
            rows.setdefault(name, []).append(value)
    out = {name: np.concatenate(values) for name, values in rows.items()}
    if len(out["junction_arms"]) == 0:  # the table is never empty: look-ups need no special case
        out["junction_arms"] = np.full((1, most_arms), -1)
    return out


def _walk_arrays(towns: Sequence[Town]) -> dict[str, np.ndarray]:
    """Walk graphs, one after another and then one node without edges, so that there is a row."""
    most = max(t.walks.neighbours.shape[1] for t in towns)
    rows: dict[str, list[np.ndarray]] = {}
    for town, first in zip(towns, offsets(towns), strict=True):
        graph = town.walks
        arrays = {
            "walk_xyz": graph.xyz,
            "walk_neighbours": _widen(_shift(graph.neighbours, first.walk), most, -1),
            "walk_yaw": _widen(graph.yaw, most, 0),
            "walk_kind": _widen(graph.kind, most, WALK_PAVEMENT),
        }
        for name, value in arrays.items():
            rows.setdefault(name, []).append(value)
    nobody = {name: np.zeros((1, *values[0].shape[1:])) for name, values in rows.items()}
    nobody["walk_neighbours"] -= 1.0
    return {
        name: np.concatenate([*values, nobody[name].astype(values[0].dtype)])
        for name, values in rows.items()
    }


def _turn_signals(town: Town) -> np.ndarray:
    """(K,) what is shown on lanes of junctions that turn."""
    turn = np.array([junctions.turn(town.lanes, row) for row in range(len(town.lanes.length))])
    side = np.where(turn > 0.0, SIGNAL_LEFT, SIGNAL_RIGHT)
    turns = (np.abs(turn) > junctions.TURN_YAW) & (town.junctions.junction >= 0)
    return np.where(turns, side, 0)


def _atlases(towns: Sequence[Town], seed: int) -> dict[str, np.ndarray]:
    """Pixel atlases and respawn tables, town after town."""
    names = ("layers", "nearest_point", "spawn_lane", "spawn_s", "spawn_walk")
    rows: dict[str, list[np.ndarray]] = {name: [] for name in names}
    origins, pictures, grids = [], [], []
    for town, first in zip(towns, offsets(towns), strict=True):
        table = town.lanes
        origin, shape = atlas.frame(town.network)
        extent = (shape[1] / PIXELS_PER_METRE, shape[0] / PIXELS_PER_METRE)
        nearest = atlas.nearest_point(table.point_xyz[:, :2], origin, shape)
        lane, s = spawn.respawn_table(spawn.places(table), origin, extent, seed)
        walk = walk_graph.respawn_table(town.walks, origin, extent, seed)
        rows["layers"].append(atlas.layers(town.network, origin, shape).reshape(-1))
        rows["nearest_point"].append(_shift(nearest, first.point).reshape(-1))
        rows["spawn_lane"].append(_shift(lane, first.lane).reshape(-1, lane.shape[-1]))
        rows["spawn_s"].append(s.reshape(-1, s.shape[-1]))
        rows["spawn_walk"].append(_shift(walk, first.walk).reshape(-1, walk.shape[-1]))
        origins.append(origin)
        pictures.append(shape)
        grids.append(lane.shape[:2])
    out = {name: np.concatenate(values) for name, values in rows.items()}
    return out | {
        "origin": np.stack(origins),
        "picture_start": _starts(pictures),
        "picture_size": np.array(pictures),
        "grid_start": _starts(grids),
        "grid_size": np.array(grids),
    }


def _starts(sizes: Sequence[tuple[int, ...]]) -> np.ndarray:
    """(M,) where each town begins among tables of rows times columns."""
    return np.cumsum([0, *(rows * columns for rows, columns in sizes[:-1])])
