"""Pads the towns' tables to size classes, so that other towns are no other program. Host only.

Padding changes nothing that is driven or seen: tables are looked up by row, and no row of a town
names one of the padding.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from carljax.sim.road_map import WALK_PAVEMENT, RoadMap
from carljax.sim.size_class import SizeClass, repeat_last

# Rows of the tables of `RoadMap`, by how its fields begin. The least are those of a town of some
# kilometres of road. Tables are small beside the pixels, so classes of theirs are wide; of more
# than the least number of pixels (5 bytes each) at most a fifth is padding.
PIXELS, TOWNS = SizeClass(1 << 21, steps=4), SizeClass(4)
ROWS: Mapping[str, SizeClass] = {
    "lane_": SizeClass(512),
    "point_": SizeClass(16384),
    "junction_": SizeClass(32),
    "light_": SizeClass(64),
    "walk_": SizeClass(4096),
    "spawn_": SizeClass(2048),
    "layers": PIXELS,
    "nearest_": PIXELS,
    "origin": TOWNS,
    "picture_": TOWNS,
    "grid_": TOWNS,
}
# Columns of its tables, and what unused ones hold.
COLUMNS: Mapping[str, tuple[SizeClass, int]] = {
    "lane_successors": (SizeClass(4), -1),
    "lane_meeting": (SizeClass(16, steps=4), 0),
    "junction_arms": (SizeClass(8), -1),
    "walk_neighbours": (SizeClass(4), -1),
    "walk_yaw": (SizeClass(4), 0),
    "walk_kind": (SizeClass(4), WALK_PAVEMENT),
}
# What unused rows hold where that is not what the last one does: nothing belongs to them.
UNUSED: Mapping[str, int] = {"lane_town": -1, "picture_size": 0}


def pad(road_map: RoadMap) -> RoadMap:
    """Pads all tables.

    Args:
      road_map: exact, as `road_map_builder.build` makes it.

    Returns:
      The same towns. Unused rows repeat the last one, so that they hold sane numbers.
    """
    fields: dict[str, Any] = {}
    for name in RoadMap.__dataclass_fields__:
        values = np.asarray(getattr(road_map, name))
        if name in COLUMNS:
            columns, fill = COLUMNS[name]
            values = _filled(values, -1, columns.round_up(values.shape[-1]), fill)
        (rows,) = (rows for prefix, rows in ROWS.items() if name.startswith(prefix))
        num = rows.round_up(len(values))
        if name in UNUSED:
            fields[name] = _filled(values, 0, num, UNUSED[name])
        else:
            fields[name] = repeat_last(values, num)
    return jax.tree.map(jnp.asarray, RoadMap(**fields))


def _filled(values: np.ndarray, axis: int, num: int, fill: int) -> np.ndarray:
    """Pads an axis with a constant."""
    missing = [(0, 0)] * values.ndim
    missing[axis] = (0, num - values.shape[axis])
    return np.pad(values, missing, constant_values=fill)
