"""Pictures for people: the bird's-eye view in colour, and a piece of a town's atlas."""

from __future__ import annotations

import jax
import numpy as np

from carljax.sim import observation, raster_roach
from carljax.sim.raster_canvas import RasterConfig
from carljax.sim.raster_nuplan import STATIC_VALUE
from carljax.sim.raster_road import GREEN_VALUE
from carljax.sim.raster_users import LIGHTS
from carljax.sim.road_map import (
    LAYER_JUNCTION,
    LAYER_MARK_BROKEN,
    LAYER_MARK_SOLID,
    LAYER_PARKING,
    LAYER_ROAD,
    LAYER_SHOULDER,
)
from carljax.sim.types import SIGNAL_BRAKE, SIGNAL_EMERGENCY, SIGNAL_LEFT, SIGNAL_RIGHT

Colour = tuple[int, int, int]

GROUND: Colour = (24, 27, 33)
ROAD: Colour = (66, 70, 79)
JUNCTION: Colour = (74, 78, 88)
PARKING: Colour = (56, 62, 76)
SHOULDER: Colour = (47, 47, 52)
ROUTE: Colour = (148, 153, 163)
SOLID: Colour = (232, 130, 178)
BROKEN: Colour = (164, 92, 128)
# Ends of a scale over 127 ... 255, at rest to 33 m/s.
VEHICLE: tuple[Colour, Colour] = ((38, 92, 190), (150, 226, 255))
PEDESTRIAN: tuple[Colour, Colour] = ((236, 150, 40), (255, 236, 120))
SPEED_SIGN: tuple[Colour, Colour] = ((122, 80, 190), (216, 190, 255))
VEHICLE_LIGHT: dict[int, Colour] = {
    SIGNAL_BRAKE: (255, 84, 56),
    SIGNAL_EMERGENCY: (96, 96, 255),
    SIGNAL_LEFT: (255, 178, 40),
    SIGNAL_RIGHT: (255, 178, 41),
}
STATIC: Colour = (158, 116, 78)
STOP_SIGN: Colour = (198, 44, 64)
GREEN: Colour = (52, 208, 104)
YELLOW: Colour = (255, 204, 48)
RED: Colour = (255, 48, 48)
EGO: Colour = (255, 255, 255)

EGO_SIZE = (4.892, 1.836)  # m; source: `bicycle.VehicleParams`, CARLA's saloon


def bev_image(
    raster: np.ndarray | jax.Array,
    config: RasterConfig,
    scale: int = 1,
    ego_size: tuple[float, float] = EGO_SIZE,
    kind: str = "carla",
) -> np.ndarray:
    """Colours the policy's image and puts the ego in.

    Args:
      raster: (H, W, C) uint8, the image of an observation.
      config: what it was rendered with.
      scale: side of a pixel in the picture.
      ego_size: length and width, m.
      kind: of `observation.KINDS`.

    Returns:
      (H * scale, W * scale, 3) uint8 RGB.

    Raises:
      ValueError: the image hasn't the shape that the configuration says.
    """
    raster = np.asarray(raster)
    channels = observation.KINDS[kind].channels
    shape = (config.height, config.width, len(channels))
    if raster.shape != shape:
        raise ValueError(f"image of shape {raster.shape}, but the configuration says {shape}")
    picture = np.empty((*raster.shape[:2], 3), np.uint8)
    picture[:] = GROUND
    _PAINTERS[kind](picture, {name: raster[..., i] for i, name in enumerate(channels)})
    picture = picture.repeat(scale, axis=0).repeat(scale, axis=1)
    _paint_ego(picture, config, scale, ego_size)
    return picture


def _paint_carla(picture: np.ndarray, channel: dict[str, np.ndarray]) -> None:
    """CaRL's channels in CARLA."""
    picture[channel["shoulder"] > 0] = SHOULDER
    picture[channel["road"] > 0] = ROAD
    picture[channel["route"] > 0] = ROUTE
    picture[channel["markings"] > 0] = BROKEN
    picture[channel["markings"] == 255] = SOLID
    picture[channel["stop_sign"] > 0] = STOP_SIGN
    _paint_scale(picture, channel["speed_signs"], SPEED_SIGN)
    _paint_lights(picture, channel["lights"])
    picture[channel["static"] > 0] = STATIC
    _paint_scale(picture, channel["vehicles"], VEHICLE)
    for bit, (value, _, _) in LIGHTS.items():
        picture[channel["vehicles"] == value] = VEHICLE_LIGHT[bit]
    _paint_scale(picture, channel["pedestrians"], PEDESTRIAN)


def _paint_roach(picture: np.ndarray, channel: dict[str, np.ndarray]) -> None:
    """Roach's channels: the older a moment the darker; of the signals the present ones."""
    picture[channel["road"] > 0] = ROAD
    picture[channel["route"] > 0] = ROUTE
    picture[channel["markings"] > 0] = BROKEN
    picture[channel["markings"] == 255] = SOLID
    moments = raster_roach.SECONDS
    _paint_lights(picture, channel[f"signals {moments[-1]}"])
    for name, ends in (("vehicles", VEHICLE), ("walkers", PEDESTRIAN)):
        low, high = np.array(ends, float)
        for age, when in enumerate(moments, start=1):
            colour = low + (high - low) * age / len(moments)
            picture[channel[f"{name} {when}"] > 0] = np.round(colour * (0.4 + 0.15 * age))


def _paint_nuplan(picture: np.ndarray, channel: dict[str, np.ndarray]) -> None:
    """CaRL's channels in nuPlan; what stands among pedestrians is shown as an obstacle."""
    picture[channel["drivable"] > 0] = ROAD
    picture[channel["route"] > 0] = ROUTE
    picture[channel["lane_borders"] > 0] = SOLID
    _paint_scale(picture, channel["speed_limits"], SPEED_SIGN)
    _paint_lights(picture, channel["lights"])
    picture[channel["stop_lines"] > 0] = STOP_SIGN
    _paint_scale(picture, channel["vehicles"], VEHICLE)
    _paint_scale(picture, channel["pedestrians"], PEDESTRIAN)
    picture[channel["pedestrians"] == STATIC_VALUE] = STATIC
    picture[channel["ego"] > 0] = EGO


_PAINTERS = {"carla": _paint_carla, "roach": _paint_roach, "nuplan": _paint_nuplan}


def map_image(layers: np.ndarray | jax.Array, scale: int = 1) -> np.ndarray:
    """Colours a town's atlas or a piece of it, north up.

    Args:
      layers: (H, W) uint8, LAYER_* bits; row = y.
      scale: side of an atlas pixel in the picture.

    Returns:
      (H * scale, W * scale, 3) uint8 RGB.
    """
    table = np.empty((256, 3), np.uint8)
    table[:] = GROUND
    bits = np.arange(256)
    for layer, colour in (
        (LAYER_SHOULDER, SHOULDER),
        (LAYER_ROAD, ROAD),
        (LAYER_PARKING, PARKING),
        (LAYER_JUNCTION, JUNCTION),
        (LAYER_MARK_SOLID, SOLID),
        (LAYER_MARK_BROKEN, BROKEN),
    ):
        table[bits & layer > 0] = colour
    return table[np.asarray(layers)[::-1]].repeat(scale, axis=0).repeat(scale, axis=1)


def _paint_lights(picture: np.ndarray, channel: np.ndarray) -> None:
    """Colours lights (and Roach's stop signs) by their value."""
    picture[channel == GREEN_VALUE] = GREEN
    picture[(channel > GREEN_VALUE) & (channel < 255)] = YELLOW
    picture[channel == 255] = RED


def _paint_scale(picture: np.ndarray, channel: np.ndarray, ends: tuple[Colour, Colour]) -> None:
    """Colours what is drawn in a channel by its speed code, 127 ... 255."""
    drawn = channel > 0
    frac = np.clip((channel[drawn].astype(float) - 127.0) / 128.0, 0.0, 1.0)[:, None]
    low, high = np.array(ends, float)
    picture[drawn] = np.round(low + frac * (high - low))


def _paint_ego(
    picture: np.ndarray, config: RasterConfig, scale: int, size: tuple[float, float]
) -> None:
    """Draws the ego's box, with a dark windscreen so that its front shows."""
    px = config.pixels_per_metre * scale
    row = (config.height - config.ego_from_bottom_px) * scale
    column = config.width * scale / 2
    half_length, half_width = 0.5 * px * size[0], 0.5 * px * size[1]
    down = np.arange(picture.shape[0])[:, None] + 0.5 - row
    right = np.arange(picture.shape[1])[None, :] + 0.5 - column
    inside = (np.abs(down) < half_length) & (np.abs(right) < half_width)
    picture[inside] = EGO
    windscreen = (down < -0.15 * half_length) & (down > -0.5 * half_length)
    picture[windscreen & (np.abs(right) < 0.75 * half_width)] = ROAD
