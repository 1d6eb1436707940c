"""One full scene of each kind of image, and the pictures that were looked at and approved.

`python tests/sim/golden_scenes.py` writes the pictures in `golden/` anew. Look at each before it is
committed: channels side by side from left to right and top to bottom, the ego upwards.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
from PIL import Image

sys.path.append(str(Path(__file__).resolve().parent))
import test_raster_nuplan  # noqa: E402
import test_raster_roach  # noqa: E402
import test_rasterizer  # noqa: E402
from crossing_world import agents_of, ego_at, road_map, route_east  # noqa: E402

from carljax.sim import raster_nuplan, town, towns  # noqa: E402
from carljax.sim.types import (  # noqa: E402
    DOOR_FRONT_LEFT,
    KIND_PEDESTRIAN,
    KIND_STATIC,
    KIND_VEHICLE,
    LIGHT_GREEN,
    LIGHT_RED,
    SIGNAL_BRAKE,
    SIGNAL_EMERGENCY,
    SIGNAL_LEFT,
    STOP_LIGHT,
    STOP_SIGN,
)

FOLDER = Path(__file__).resolve().parent / "golden"
COLUMNS = {"carla": 5, "roach": 5, "nuplan": 3}
CAR = {"length": 4.6, "width": 1.9, "kind": KIND_VEHICLE}
BUS = CAR | {"length": 10.3, "width": 2.6}
WALKER = {"length": 0.5, "width": 0.5, "kind": KIND_PEDESTRIAN, "speed": 1.3}
CRATE = {"length": 1.2, "width": 0.8, "kind": KIND_STATIC}
# Beside and before an ego at (-35, -1.75) that drives towards a crossing, see `crossing_world`.
USERS = (
    CAR | {"x": -24.0, "y": -1.6, "speed": 5.0, "signals": SIGNAL_BRAKE},
    CAR | {"x": -20.0, "y": 1.9, "yaw": math.pi, "speed": 9.0, "signals": SIGNAL_LEFT},
    CAR | {"x": -45.0, "y": 1.8, "yaw": 3.0, "speed": 12.0, "signals": SIGNAL_EMERGENCY},
    CAR | {"x": -30.0, "y": -4.6, "yaw": 0.05, "signals": DOOR_FRONT_LEFT},
    BUS | {"x": 1.5, "y": -14.0, "yaw": 1.4, "speed": 6.0},
    WALKER | {"x": -12.5, "y": 5.0, "yaw": -1.5},
    WALKER | {"x": -26.0, "y": 5.2, "yaw": 0.3},
    CRATE | {"x": -16.0, "y": -4.4, "yaw": 0.6},
)
EGO = {"x": -35.0, "y": -1.75, "yaw": 0.2, "speed": 7.0}


def _route():
    """Through the crossing, with a light before it, a stop sign and two speed signs."""
    kinds, places = np.array([STOP_SIGN, STOP_LIGHT, STOP_LIGHT, STOP_LIGHT]), [72, 90, 170, 180]
    return route_east(
        stop_idx=np.array(places, np.int32),
        stop_xy=np.stack([np.array(places) - 100.0, np.full(4, -1.75)], axis=-1),
        stop_s=np.array(places, float),
        stop_kind=kinds.astype(np.int32),
        stop_light=np.zeros(4, np.int32),
        stop_width=np.full(4, 3.5),
        sign_xy=np.array([[-22.0, -6.0], [-8.0, -6.0], [0.0, 0.0]]),
        sign_idx=np.array([78, 92, -1], np.int32),
        sign_limit=np.array([50 / 3.6, 30 / 3.6, 0.0]),
    )


def carla() -> np.ndarray:
    """(256, 256, 10), the light red."""
    return test_rasterizer.draw(
        road_map(), ego_at(**EGO), agents_of(*USERS), _route(), 65, colour=4 * [LIGHT_RED]
    )


def roach() -> np.ndarray:
    """(192, 192, 15), everybody half a second further at each moment, the light red at last."""

    def moved(seconds):
        ways = [user.get("speed", 0.0) * seconds for user in USERS]
        yaws = [user.get("yaw", 0.0) for user in USERS]
        return agents_of(
            *(
                user | {"x": user["x"] + way * math.cos(yaw), "y": user["y"] + way * math.sin(yaw)}
                for user, way, yaw in zip(USERS, ways, yaws, strict=True)
            )
        )

    colours = 3 * [4 * [LIGHT_GREEN]] + [4 * [LIGHT_RED]]
    moments = [(moved(0.5 * k - 1.5), colour, 0) for k, colour in enumerate(colours)]
    return test_raster_roach.draw(road_map(), ego_at(**EGO), moments, _route(), 65)


def nuplan(bundled: dict[str, town.Town]) -> np.ndarray:
    """(256, 256, 9), before a light of the grid, with everything that can be drawn."""
    env = test_raster_nuplan.environment(bundled)
    sim = test_raster_nuplan.place(
        env, 0, test_raster_nuplan.before_light(env, 0), turn=0.2, speed=7.0
    )
    users = [
        test_raster_nuplan.at(
            sim, user["x"] - EGO["x"], user["y"] - EGO["y"],
            **{k: v for k, v in user.items() if k not in ("x", "y", "yaw", "signals")},
            yaw=float(sim.ego.yaw) + user.get("yaw", 0.0),
        )
        for user in USERS
    ]  # fmt: skip
    options = raster_nuplan.NuplanOptions(stop_lines=True, speed_line=True)
    agents = agents_of(*users)
    return test_raster_nuplan.draw(env, sim, agents, raster_nuplan.RASTER, options)


def sheet(image: np.ndarray, columns: int) -> np.ndarray:
    """Channels of an image (H, W, C) side by side, as bytes (rows * H, columns * W)."""
    height, width, channels = image.shape
    rows = -(-channels // columns)
    padded = np.zeros((height, width, rows * columns), np.uint8)
    padded[..., :channels] = image
    tiles = padded.transpose(2, 0, 1).reshape(rows, columns, height, width)
    return tiles.transpose(0, 2, 1, 3).reshape(rows * height, columns * width)


def golden(kind: str) -> np.ndarray:
    """The approved sheet of a kind."""
    with Image.open(FOLDER / f"{kind}.png") as picture:
        return np.asarray(picture)


def main() -> None:
    """Writes all pictures."""
    bundled = {name: town.load(towns.path(name)) for name in towns.names()}
    FOLDER.mkdir(exist_ok=True)
    for kind, image in (("carla", carla()), ("roach", roach()), ("nuplan", nuplan(bundled))):
        picture = Image.fromarray(sheet(image, COLUMNS[kind]))
        picture.save(FOLDER / f"{kind}.png", optimize=True)


if __name__ == "__main__":
    main()
