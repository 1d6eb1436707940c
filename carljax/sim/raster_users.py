"""The road users on the bird's-eye view: boxes, forecast lines, doors and lights.

One byte a pixel says who is there: sample points, so close that no box shows a hole, are scattered
onto a canvas, and of two road users the larger code stays.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from carljax.sim.raster_canvas import (
    Poses,
    RasterConfig,
    box_pixels,
    moved,
    poses,
    ray_pixels,
)
from carljax.sim.raster_marks import draw
from carljax.sim.types import (
    DOOR_FRONT_LEFT,
    DOOR_FRONT_RIGHT,
    DOOR_REAR_LEFT,
    DOOR_REAR_RIGHT,
    KIND_STATIC,
    KIND_VEHICLE,
    SIGNAL_BRAKE,
    SIGNAL_EMERGENCY,
    SIGNAL_LEFT,
    SIGNAL_RIGHT,
    Agents,
    EgoState,
)

# source: the authors' code
HEIGHT_REACH = 8.0  # m, road users farther above or below are not drawn
SPEED_OFFSET, SPEED_RANGE = 2.67, 36.0  # m/s
FORECAST_S, FORECAST_MIN = 1.0, 0.5  # s, m
HALF_EXTENT_MIN = 0.8  # m
LIGHT_SIDE = 1.0  # m
# Of each light its byte and its middle in the vehicle's frame, m ahead and to the left.
LIGHTS = {
    SIGNAL_BRAKE: (111, -1.5, 0.0),
    SIGNAL_EMERGENCY: (22, 0.0, 0.0),
    SIGNAL_LEFT: (44, 0.5, 0.5),
    SIGNAL_RIGHT: (77, 0.5, -0.5),
}
DOOR_LENGTH, DOOR_WIDTH = 0.4, 2.0  # m, an open door along and across the vehicle
DOORS = {
    DOOR_FRONT_LEFT: (0.7, 1.8),
    DOOR_FRONT_RIGHT: (0.7, -1.8),
    DOOR_REAR_LEFT: (-0.7, 1.8),
    DOOR_REAR_RIGHT: (-0.7, -1.8),
}

# Samples of a box are as many as the largest box needs, so only a few rows get enough for a bus,
# and only a few may have doors open. Ours.
CAR_SIZE, BUS_SIZE = (6.0, 2.4), (10.4, 2.6)  # m; larger boxes show gaps
NUM_LARGE, NUM_OPEN = 8, 4

# Codes of the canvas.
_VEHICLE, _LIGHT, _STATIC, _PEDESTRIAN = 1, 130, 134, 135


def channels(code: np.ndarray) -> dict[str, np.ndarray]:
    """What each code of the canvas is in the image: {name of CHANNELS: bytes}.

    Args:
      code: (n,) int.

    Returns:
      (n,) int each.
    """
    vehicle = np.where((code >= _VEHICLE) & (code < _LIGHT), code - _VEHICLE + 127, 0)
    for place, (value, _, _) in enumerate(LIGHTS.values()):
        vehicle = np.where(code == _LIGHT + place, value, vehicle)
    pedestrian = np.where(code >= _PEDESTRIAN, code - _PEDESTRIAN + 127, 0)
    return {
        "vehicles": vehicle,
        "pedestrians": pedestrian,
        "static": np.where(code == _STATIC, 255, 0),
    }


def speed_value(speed: jax.Array) -> jax.Array:
    """The byte that stands for a speed: 136 at rest, 255 from 33.3 m/s on.

    Source: the authors' code: 127 + int(128 clip(v + 2.67, 0, 36) / 36).

    Args:
      speed: (...) m/s.

    Returns:
      (...) int32 in 127 ... 255.
    """
    frac = jnp.clip(speed + SPEED_OFFSET, 0.0, SPEED_RANGE) / SPEED_RANGE
    return 127 + (128.0 * frac).astype(jnp.int32)


def road_users(ego: EgoState, agents: Agents, config: RasterConfig) -> jax.Array:
    """Draws all road users near the ego's height.

    Args:
      ego: pose of the image.
      agents: (N,) road users.
      config: size and content.

    Returns:
      (H * W,) uint8 codes, see `channels`; 0 where nobody is.
    """
    shown = agents.valid & (jnp.abs(agents.z - ego.z) < HEIGHT_REACH)
    at = poses(agents.xy, agents.yaw, ego, config)
    code = _codes(agents)
    canvas = jnp.zeros(config.height * config.width, jnp.uint8)
    canvas = _boxes(canvas, at, agents, shown, code, config)
    canvas = _forecast_lines(canvas, at, agents, shown, code, config)
    is_vehicle = shown & (agents.kind == KIND_VEHICLE)
    canvas = _doors(canvas, at, agents, is_vehicle, code, config)
    return _lights(canvas, at, agents, is_vehicle, config)


def _codes(agents: Agents) -> jax.Array:
    """(N,) uint8, the code of each one's box."""
    speed = speed_value(agents.speed) - 127
    pedestrian = jnp.minimum(speed + _PEDESTRIAN, 255)
    other = jnp.where(agents.kind == KIND_STATIC, _STATIC, pedestrian)
    return jnp.where(agents.kind == KIND_VEHICLE, speed + _VEHICLE, other).astype(jnp.uint8)


def _boxes(
    canvas: jax.Array,
    at: Poses,
    agents: Agents,
    shown: jax.Array,
    code: jax.Array,
    config: RasterConfig,
) -> jax.Array:
    """Bodies: all as if they were no larger than cars, then the few large ones again."""
    least = jnp.where(agents.kind == KIND_STATIC, 0.0, 2 * HALF_EXTENT_MIN)
    length, width = jnp.maximum(agents.length, least), jnp.maximum(agents.width, least)
    size = jnp.minimum(length, CAR_SIZE[0]), jnp.minimum(width, CAR_SIZE[1])
    canvas = draw(canvas, box_pixels(at, *size, shown, CAR_SIZE, config), code)
    excess = jnp.maximum(length - CAR_SIZE[0], width - CAR_SIZE[1])
    excess, large = jax.lax.top_k(jnp.where(shown, excess, -1.0), min(NUM_LARGE, len(shown)))
    at, length, width, code = jax.tree.map(lambda x: x[large], (at, length, width, code))
    return draw(canvas, box_pixels(at, length, width, excess > 0.0, BUS_SIZE, config), code)


def _forecast_lines(
    canvas: jax.Array,
    at: Poses,
    agents: Agents,
    shown: jax.Array,
    code: jax.Array,
    config: RasterConfig,
) -> jax.Array:
    """Lines of a second's way ahead of whoever can move."""
    moves = shown & (agents.kind != KIND_STATIC)
    front = 0.5 * jnp.maximum(agents.length, 2 * HALF_EXTENT_MIN) * config.pixels_per_metre
    reach = jnp.where(moves, jnp.maximum(agents.speed * FORECAST_S, FORECAST_MIN), -1.0)
    longest = (SPEED_RANGE - SPEED_OFFSET) * FORECAST_S
    return draw(canvas, ray_pixels(moved(at, front, 0.0), reach, longest, config), code)


def _doors(
    canvas: jax.Array,
    at: Poses,
    agents: Agents,
    shown: jax.Array,
    code: jax.Array,
    config: RasterConfig,
) -> jax.Array:
    """Open doors, coded as the vehicle is."""
    is_open = shown & (agents.signals >= min(DOORS))
    # Of float32, since XLA:CPU sorts integers whole.
    is_open, row = jax.lax.top_k(is_open.astype(jnp.float32), min(NUM_OPEN, len(shown)))
    at, signals, code = jax.tree.map(lambda x: x[row], (at, agents.signals, code))
    pixels = _parts(at, signals, is_open > 0, DOORS, (DOOR_LENGTH, DOOR_WIDTH), config)
    return draw(canvas, pixels, jnp.tile(code, len(DOORS)))


def _lights(
    canvas: jax.Array, at: Poses, agents: Agents, shown: jax.Array, config: RasterConfig
) -> jax.Array:
    """Brake, emergency and indicator lights, each with a byte of its own."""
    places = {bit: (ahead, left) for bit, (_, ahead, left) in LIGHTS.items()}
    pixels = _parts(at, agents.signals, shown, places, (LIGHT_SIDE, LIGHT_SIDE), config)
    code = _LIGHT + np.repeat(np.arange(len(LIGHTS)), shown.shape[0])
    return draw(canvas, pixels, jnp.asarray(code, jnp.uint8))


def _parts(
    at: Poses,
    signals: jax.Array,
    shown: jax.Array,
    places: dict[int, tuple[float, float]],
    size: tuple[float, float],
    config: RasterConfig,
) -> jax.Array:
    """Pixels of boxes of one size fixed to vehicles that show some bits of `Agents.signals`.

    Args:
      at: (N,) middles of the vehicles.
      signals: (N,) int32.
      shown: (N,) bool.
      places: {bit: m ahead of and to the left of the vehicle's middle}.
      size: m, along and across the vehicle.
      config: size and content.

    Returns:
      (len(places) * N, S) int32 flat pixel indices, bit by bit.
    """
    px = config.pixels_per_metre
    middles = [moved(at, ahead * px, left * px) for ahead, left in places.values()]
    lit = jnp.concatenate([shown & ((signals & bit) > 0) for bit in places])
    middle = jax.tree.map(lambda *x: jnp.concatenate(x), *middles)
    along, across = (jnp.full(lit.shape, extent) for extent in size)
    return box_pixels(middle, along, across, lit, size, config)
