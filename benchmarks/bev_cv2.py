"""CaRL's bird's-eye image for CARLA drawn with OpenCV, as renderers outside an accelerator do it.

Written from docs/observations.md alone. The roads are drawn once into an image of the map, which
each frame warps under the ego with `warpAffine`; users, lines and signs are then drawn upon it with
`fillConvexPoly`, `line` and `circle`, each into the plane of its channel. Corners of all boxes are
worked out together in NumPy. The result stays in planes: nobody has to interleave them.

This file knows neither JAX nor carljax.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import bev_scene
import cv2
import numpy as np
from bev_scene import (
    EGO_FROM_BOTTOM,
    HEIGHT,
    LANE_WIDTH,
    MARK_WIDTH,
    PIXELS_PER_METRE,
    ROUTE_IDX,
    SHOULDER_WIDTH,
    WIDTH,
    Road,
    Scene,
    Users,
)

(ROAD, ROUTE, MARKS, VEHICLES, PEDESTRIANS, LIGHTS, STOP_SIGN, SPEED_SIGNS, STATICS, SHOULDERS) = (
    range(10)
)

# OpenCV takes coordinates as whole numbers of 1/16 pixel.
_SHIFT = 4
# OpenCV's fills include their outline, so shapes are drawn half a pixel smaller on each side. The
# map is drawn so many times finer and every so manieth pixel is kept, which leaves exact edges.
_FINER, _BAND = 31, 64
_OUTLINE = 0.5 / PIXELS_PER_METRE
_LEAST_EXTENT = 1.6  # m, of vehicles and pedestrians
# Open doors and lamps of vehicles: bit, byte (None: the vehicle's own), middle ahead of and left of
# the vehicle's, length and width, m. Later ones come on top.
_PARTS: tuple[tuple[int, int | None, float, float, float, float], ...] = (
    (bev_scene.DOOR_FRONT_LEFT, None, 0.7, 1.8, 0.4, 2.0),
    (bev_scene.DOOR_REAR_RIGHT, None, -0.7, -1.8, 0.4, 2.0),
    (bev_scene.BRAKE, 111, -1.5, 0.0, 1.0, 1.0),
    (bev_scene.EMERGENCY, 22, 0.0, 0.0, 1.0, 1.0),
    (bev_scene.LEFT, 44, 0.5, 0.5, 1.0, 1.0),
    (bev_scene.RIGHT, 77, 0.5, -0.5, 1.0, 1.0),
)
_PART_BITS = np.array([part[0] for part in _PARTS])
_PART_BYTES = [part[1] for part in _PARTS]
_PART_PLACES = np.array([part[2:4] for part in _PARTS])
_PART_SIZES = np.array([part[4:6] for part in _PARTS])


class Boxes(NamedTuple):
    """Boxes: middles (K, 2) m, yaw (K,) rad, length and width (K, 2) m, and what is drawn of each.

    `channel` and `byte` are lists of K, in the order of drawing.
    """

    xy: np.ndarray
    yaw: np.ndarray
    size: np.ndarray
    channel: list[int]
    byte: list[int]


class Renderer:
    """Draws frames of one map into one image, again and again."""

    def __init__(self, roads: list[Road]) -> None:
        self.map_image = draw_map(roads)
        self.image = np.zeros((10, HEIGHT, WIDTH), np.uint8)

    def draw(self, scene: Scene, turned: float = 0.0) -> np.ndarray:
        """Draws one frame.

        Args:
          scene: what is there.
          turned: rad, added to the ego's yaw.

        Returns:
          (10, H, W) uint8, overwritten by the next call.
        """
        to_pixel = camera(scene.ego_xy, scene.ego_yaw + turned)
        self._static(to_pixel)
        self.image[ROUTE].fill(0)
        self.image[VEHICLES : STATICS + 1].fill(0)
        self._route(scene, to_pixel)
        self._lines(scene.users, to_pixel)
        self._boxes((bodies(scene.users), parts(scene.users), signals(scene)), to_pixel)
        return self.image

    def _static(self, to_pixel: np.ndarray) -> None:
        """The map under the ego: road, lines, shoulders."""
        from_map = to_pixel @ _MAP_TO_WORLD
        for channel, plane in self.map_image.items():
            cv2.warpAffine(
                plane,
                from_map[:2],
                (WIDTH, HEIGHT),
                dst=self.image[channel],
                flags=cv2.INTER_NEAREST,
            )

    def _route(self, scene: Scene, to_pixel: np.ndarray) -> None:
        """Discs of 3 px around the points ahead that lie in junctions."""
        plane = self.image[ROUTE]
        ahead = scene.route_xy[ROUTE_IDX : ROUTE_IDX + 150]
        ahead = ahead[scene.in_junction[ROUTE_IDX : ROUTE_IDX + 150]]
        for centre in np.rint(_apply(to_pixel, ahead)).astype(int).tolist():
            cv2.circle(plane, centre, 3, 255, cv2.FILLED)

    def _lines(self, users: Users, to_pixel: np.ndarray) -> None:
        """Lines of a second's way ahead of all that moves, in whole pixels, slow ones first."""
        ahead = np.stack([np.cos(users.yaw), np.sin(users.yaw)], axis=-1)
        front = users.xy + 0.5 * np.maximum(users.length, _LEAST_EXTENT)[:, None] * ahead
        reach = np.floor(np.maximum(users.speed, 0.5) * PIXELS_PER_METRE) / PIXELS_PER_METRE
        ends = np.stack([front, front + reach[:, None] * ahead], axis=1)
        lines = _fixed(_apply(to_pixel, ends)).tolist()
        channels, bytes_ = _channels(users), _speed_byte(users.speed).tolist()
        for i in np.argsort(users.speed).tolist():
            if channels[i] != STATICS:
                plane = self.image[channels[i]]
                begin, end = lines[i]
                cv2.line(plane, begin, end, bytes_[i], 1, cv2.LINE_4, _SHIFT)

    def _boxes(self, some: Sequence[Boxes], to_pixel: np.ndarray) -> None:
        """Boxes, one set after the other; all corners are worked out together."""
        xy, yaw, size = (np.concatenate([getattr(x, name) for x in some]) for name in _PLACED)
        half = np.maximum(0.5 * size - _OUTLINE, 0.0)[:, None] * _CORNERS
        cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        along, across = half[..., 0], half[..., 1]
        corners = np.stack([cos * along - sin * across, sin * along + cos * across], axis=-1)
        drawn = _fixed(_apply(to_pixel, corners + xy[:, None]))
        channels = [channel for boxes in some for channel in boxes.channel]
        bytes_ = [byte for boxes in some for byte in boxes.byte]
        for box, channel, byte in zip(drawn, channels, bytes_, strict=True):
            cv2.fillConvexPoly(self.image[channel], box, byte, cv2.LINE_8, _SHIFT)


_PLACED = ("xy", "yaw", "size")
_CORNERS = np.array([(1.0, 1.0), (1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0)])


def bodies(users: Users) -> Boxes:
    """Vehicles, pedestrians and obstacles, slow ones first."""
    order = np.argsort(users.speed)
    moves = users.kind != bev_scene.STATIC
    size = np.stack([users.length, users.width], axis=-1)
    size = np.maximum(size, np.where(moves, _LEAST_EXTENT, 0.0)[:, None])
    bytes_ = np.where(moves, _speed_byte(users.speed), 255)[order]
    channels = _channels(users)
    return Boxes(
        users.xy[order],
        users.yaw[order],
        size[order],
        [channels[i] for i in order.tolist()],
        bytes_.tolist(),
    )


def parts(users: Users) -> Boxes:
    """Open doors and lamps of vehicles."""
    part, who = np.nonzero(users.signals & _PART_BITS[:, None])
    yaw = users.yaw[who]
    ahead, left = _PART_PLACES[part].T
    cos, sin = np.cos(yaw), np.sin(yaw)
    offset = np.stack([cos * ahead - sin * left, sin * ahead + cos * left], axis=-1)
    own = _speed_byte(users.speed[who]).tolist()
    fixed = [_PART_BYTES[number] for number in part.tolist()]
    bytes_ = [a if b is None else b for a, b in zip(own, fixed, strict=True)]
    return Boxes(users.xy[who] + offset, yaw, _PART_SIZES[part], [VEHICLES] * len(who), bytes_)


def signals(scene: Scene) -> Boxes:
    """Stop lines of lights, the stop sign ahead, speed signs."""
    at = np.concatenate([scene.stop_idx, scene.sign_idx])
    xy = np.concatenate([scene.route_xy[scene.stop_idx], scene.sign_xy])
    is_light = (scene.stop_kind == bev_scene.LIGHT).tolist()
    yellow = int(255 * (1.0 - 0.33 * min(scene.yellow_left / 3.0, 1.0)))
    byte = {bev_scene.GREEN: 80, bev_scene.YELLOW: yellow, bev_scene.RED: 255}
    stops = [
        ((1.5, 0.8 * width), LIGHTS, byte[colour]) if light else ((width, width), STOP_SIGN, 255)
        for light, width, colour in zip(
            is_light, scene.stop_width.tolist(), scene.light.tolist(), strict=True
        )
    ]
    signs = [((2.0, 2.0), SPEED_SIGNS, b) for b in _speed_byte(scene.sign_limit).tolist()]
    size, channel, bytes_ = zip(*stops, *signs, strict=True)
    return Boxes(xy, scene.route_yaw[at], np.array(size), list(channel), list(bytes_))


def _channels(users: Users) -> list[int]:
    return np.choose(users.kind - 1, (VEHICLES, PEDESTRIANS, STATICS)).tolist()


def camera(ego_xy: np.ndarray, ego_yaw: float) -> np.ndarray:
    """(3, 3) from the world, m, to column and row, whole numbers at the pixels' centres."""
    cos, sin = PIXELS_PER_METRE * np.cos(ego_yaw), PIXELS_PER_METRE * np.sin(ego_yaw)
    turn = np.array([[sin, -cos], [-cos, -sin]])  # right, down
    middle = np.array([WIDTH / 2 - 0.5, HEIGHT - EGO_FROM_BOTTOM - 0.5])
    return np.vstack([np.column_stack([turn, middle - turn @ ego_xy]), [0.0, 0.0, 1.0]])


def draw_map(roads: list[Road]) -> dict[int, np.ndarray]:
    """The planes of the map: {channel: image at 2 px/m}; pixel [0, 0] is at `-REACH`."""
    strips: dict[int, list[tuple[np.ndarray, int]]] = {ROAD: [], MARKS: [], SHOULDERS: []}
    for road in roads:
        strips[ROAD].append((_strip(road, -LANE_WIDTH, LANE_WIDTH), 255))
        for side in (-1.0, 1.0):
            beyond = side * (LANE_WIDTH + SHOULDER_WIDTH)
            strips[SHOULDERS].append((_strip(road, side * LANE_WIDTH, beyond), 255))
    # Broken lines, in the middle, over solid ones.
    for road in roads:
        for aside in (-LANE_WIDTH, LANE_WIDTH):
            strip = _strip(road, aside - MARK_WIDTH / 2, aside + MARK_WIDTH / 2)
            strips[MARKS].append((strip, 255))
    for road in roads:
        strips[MARKS].append((_strip(road, -MARK_WIDTH / 2, MARK_WIDTH / 2), 127))
    return {channel: _draw_finely(those) for channel, those in strips.items()}


def _draw_finely(strips: list[tuple[np.ndarray, int]]) -> np.ndarray:
    """A plane of the map, a band of rows at a time so that the fine picture stays small."""
    side = int(2 * bev_scene.REACH * PIXELS_PER_METRE) + 1
    out = np.empty((side, side), np.uint8)
    middle = _FINER // 2
    for top in range(0, side, _BAND):
        band = out[top : top + _BAND]
        fine = np.zeros((len(band) * _FINER, side * _FINER), np.uint8)
        for xy, byte in strips:
            at = ((xy + bev_scene.REACH) * PIXELS_PER_METRE - (0, top)) * _FINER + middle
            cv2.fillPoly(fine, [_fixed(at)], byte, cv2.LINE_8, _SHIFT)
        band[:] = fine[middle::_FINER, middle::_FINER]
    return out


def _strip(road: Road, first: float, last: float) -> np.ndarray:
    """(2 P, 2) m, the outline of what lies between two lines beside a road."""
    inward = np.sign(last - first) * _OUTLINE / _FINER
    return np.concatenate([road.aside(first + inward), road.aside(last - inward)[::-1]])


# From column and row of the map image to the world.
_MAP_TO_WORLD = np.array(
    [
        [1.0 / PIXELS_PER_METRE, 0.0, -bev_scene.REACH],
        [0.0, 1.0 / PIXELS_PER_METRE, -bev_scene.REACH],
        [0.0, 0.0, 1.0],
    ]
)


def _apply(to_pixel: np.ndarray, xy: np.ndarray) -> np.ndarray:
    return xy @ to_pixel[:2, :2].T + to_pixel[:2, 2]


def _fixed(pixels: np.ndarray) -> np.ndarray:
    return np.rint(pixels * (1 << _SHIFT)).astype(np.int32)


def _speed_byte(speed: np.ndarray) -> np.ndarray:
    return 127 + (128.0 * np.clip(speed + 2.67, 0.0, 36.0) / 36.0).astype(int)


def work(seeds: list[int], turn: float, tasks: Any, results: Any, barrier: Any) -> None:
    """A process that draws: for each number it is given so many frames, then says how long.

    Args:
      seeds: of the scenes, which it draws in turn.
      turn: rad that the ego turns from one frame of a scene to the next.
      tasks: queue of numbers of frames; 0 ends it.
      results: queue for (begin, end), s on the clock that all processes share.
      barrier: at which all processes wait before each task.
    """
    cv2.setNumThreads(1)
    renderer = Renderer(bev_scene.roads())
    scenes = [bev_scene.make(seed) for seed in seeds]
    while num_frames := tasks.get():
        barrier.wait()
        begin = time.monotonic()
        for frame in range(num_frames):
            renderer.draw(scenes[frame % len(scenes)], turn * (frame // len(scenes) + 1))
        results.put((begin, time.monotonic()))
