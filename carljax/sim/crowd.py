"""Who walks where at the start of an episode. Host only."""

from __future__ import annotations

from typing import Any

import numpy as np

from carljax.sim.road_map import WALK_PAVEMENT
from carljax.sim.types import Walkers
from carljax.sim.walk_graph import WalkGraph

RADIUS = 110.0  # m around the start
# m/s. source: measured walking speeds of adults, mean 1.34, standard deviation 0.26 (Weidmann,
# Transporttechnik der Fussgaenger, 1993), within the range of CARLA's walkers
PACE, PACE_SPREAD, PACE_RANGE = 1.34, 0.26, (0.9, 1.9)
RUNNERS, RUN_PACE = 0.06, (2.2, 2.8)  # share, and m/s of an easy run. source: ours
RECKLESS = 0.05  # share of those who don't look. source: ours
MOST_OFFSET = 0.45  # m to either side of a pavement's middle: on a pavement of 2 m nobody leaves it


def draw(
    graph: WalkGraph, first: int, start_xy: np.ndarray, num: int, rng: np.random.Generator
) -> Walkers:
    """Draws pedestrians around the start, from quiet streets to as many as there is room for.

    Args:
      graph: the town's walk graph.
      first: its first row in the table that towns share.
      start_xy: (2,) m.
      num: W.
      rng: of all that is drawn.

    Returns:
      Walkers, NumPy, (W,). Rows with a pace but no node are people who appear later.
    """
    most = int(rng.integers(num // 4, num + 1))
    away = np.hypot(*(graph.xyz[:, :2] - start_xy).T)
    near = rng.permutation(np.flatnonzero((away < RADIUS) & ~graph.is_kerb))[:most]
    node, target = np.full(num, -1), np.full(num, -1)
    for row, place in enumerate(near):
        ways = graph.neighbours[place][graph.kind[place] == WALK_PAVEMENT]
        node[row] = place + first
        target[row] = rng.choice(ways[ways >= 0]) + first
    pace = np.clip(rng.normal(PACE, PACE_SPREAD, num), *PACE_RANGE)
    pace = np.where(rng.uniform(size=num) < RUNNERS, rng.uniform(*RUN_PACE, num), pace)
    rows: dict[str, Any] = {
        "node": node.astype(np.int32),
        "target": target.astype(np.int32),
        "pace": np.where(np.arange(num) < most, pace, 0.0).astype(np.float32),
        "offset": rng.uniform(-MOST_OFFSET, MOST_OFFSET, num).astype(np.float32),
        "is_reckless": rng.uniform(size=num) < RECKLESS,
    }
    return Walkers(**rows)
