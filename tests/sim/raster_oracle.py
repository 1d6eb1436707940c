"""The bird's-eye view again, in float64 with loops over pixels: slow, and written apart."""

from __future__ import annotations

import math

import numpy as np

from carljax.sim.road_map import (
    LAYER_MARK_BROKEN,
    LAYER_MARK_SOLID,
    LAYER_ROAD,
    LAYER_SHOULDER,
)
from carljax.sim.types import (
    KIND_NONE,
    KIND_PEDESTRIAN,
    KIND_STATIC,
    KIND_VEHICLE,
    LIGHT_GREEN,
    LIGHT_YELLOW,
    STOP_LIGHT,
    STOP_SIGN,
)


def code(speed):
    return 127 + int(128 * min(max(speed + 2.67, 0.0), 36.0) / 36.0)


class Oracle:
    """One image; pixels are asked one by one where in the world they lie."""

    def __init__(self, ego, config):
        self.x, self.y = (float(v) for v in ego.xy)
        self.yaw, self.z = float(ego.yaw), float(ego.z)
        self.config = config
        self.image = np.zeros((config.height, config.width, 10), int)

    def world(self, row, column):
        """Where in the world a pixel's centre lies."""
        c = self.config
        ahead = (c.height - c.ego_from_bottom_px - row - 0.5) / c.pixels_per_metre
        left = (c.width / 2 - column - 0.5) / c.pixels_per_metre
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return self.x + cos * ahead - sin * left, self.y + sin * ahead + cos * left

    def pixel(self, x, y):
        """Row and column of the pixel that holds a place."""
        c, dx, dy = self.config, x - self.x, y - self.y
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        row = c.height - c.ego_from_bottom_px - (cos * dx + sin * dy) * c.pixels_per_metre
        column = c.width / 2 - (cos * dy - sin * dx) * c.pixels_per_metre
        return math.floor(row), math.floor(column)

    def pixels(self):
        """Every pixel."""
        for row in range(self.config.height):
            for column in range(self.config.width):
                yield row, column

    def put(self, row, column, channel, value):
        """Draws a pixel, if it is inside."""
        if 0 <= row < self.config.height and 0 <= column < self.config.width:
            self.image[row, column, channel] = max(self.image[row, column, channel], value)

    def static(self, layers, origin):
        """The nearest atlas pixel of each pixel."""
        for row, column in self.pixels():
            x, y = self.world(row, column)
            i, j = round((y - float(origin[1])) * 2), round((x - float(origin[0])) * 2)
            if not (0 <= i < layers.shape[0] and 0 <= j < layers.shape[1]):
                continue
            bits = int(layers[i, j])
            line = 127 if bits & LAYER_MARK_BROKEN else 255 * bool(bits & LAYER_MARK_SOLID)
            self.image[row, column, 0] = 255 * bool(bits & LAYER_ROAD)
            self.image[row, column, 2] = line
            self.image[row, column, 9] = 255 * bool(bits & LAYER_SHOULDER)

    def box(self, x, y, yaw, length, width, channel, value):
        """Pixels whose centre lies in the box."""
        reach = math.ceil((length + width) * self.config.pixels_per_metre)
        middle = self.pixel(x, y)
        for row in range(middle[0] - reach, middle[0] + reach + 1):
            for column in range(middle[1] - reach, middle[1] + reach + 1):
                px, py = self.world(row, column)
                along = math.cos(yaw) * (px - x) + math.sin(yaw) * (py - y)
                across = math.cos(yaw) * (py - y) - math.sin(yaw) * (px - x)
                if abs(along) <= length / 2 and abs(across) <= width / 2:
                    self.put(row, column, channel, value)

    def road_users(self, agents):
        """Pedestrians hide obstacles, which hide vehicles, of which lights show on top."""
        layers = []
        for kind, channel in ((KIND_VEHICLE, 3), (KIND_STATIC, 8), (KIND_PEDESTRIAN, 4)):
            drawn, shine = Oracle._like(self), Oracle._like(self)
            for n in range(len(agents.kind)):
                near = abs(float(agents.z[n]) - self.z) < 8.0
                if int(agents.kind[n]) == kind != KIND_NONE and near:
                    drawn.road_user(agents, n, kind, channel, shine)
            for rank, value in enumerate((111, 22, 44, 77), start=1):
                drawn.image[shine.image == rank] = value
            layers.append((channel, drawn.image[..., channel]))
        for row, column in self.pixels():
            for channel, image in layers:
                if image[row, column]:
                    self.image[row, column, [3, 4, 8]] = 0
                    self.image[row, column, channel] = image[row, column]

    def _like(self):
        other = Oracle.__new__(Oracle)
        other.__dict__ |= self.__dict__ | {"image": np.zeros_like(self.image)}
        return other

    def road_user(self, agents, n, kind, channel, shine):
        """One box with its line, its doors and its lights."""
        (x, y), yaw, speed = map(float, agents.xy[n]), float(agents.yaw[n]), float(agents.speed[n])
        length, width = float(agents.length[n]), float(agents.width[n])
        if kind == KIND_STATIC:
            self.box(x, y, yaw, length, width, channel, 255)
            return
        length, width = max(length, 1.6), max(width, 1.6)
        self.box(x, y, yaw, length, width, channel, code(speed))
        line, step = max(speed, 0.5), 1 / self.config.pixels_per_metre
        for k in range(int(line / step + 1e-6) + 1):
            out = length / 2 + k * step
            place = self.pixel(x + out * math.cos(yaw), y + out * math.sin(yaw))
            self.put(*place, channel, code(speed))
        if kind != KIND_VEHICLE:
            return
        signals, cos, sin = int(agents.signals[n]), math.cos(yaw), math.sin(yaw)
        for bit, ahead, left in ((4, 0.7, 1.8), (5, 0.7, -1.8), (6, -0.7, 1.8), (7, -0.7, -1.8)):
            if signals >> bit & 1:
                door = x + ahead * cos - left * sin, y + ahead * sin + left * cos
                self.box(*door, yaw, 0.4, 2.0, channel, code(speed))
        lights = ((2, -1.5, 0.0), (3, 0.0, 0.0), (0, 0.5, 0.5), (1, 0.5, -0.5))
        for rank, (bit, ahead, left) in enumerate(lights, start=1):
            if signals >> bit & 1:
                light = x + ahead * cos - left * sin, y + ahead * sin + left * cos
                shine.box(*light, yaw, 1.0, 1.0, channel, rank)

    def route(self, route, idx):
        """Discs around the route points ahead."""
        radius = 1.5 * self.config.pixels_per_metre
        for k in range(idx, min(idx + 150, int(route.num_points))):
            if self.config.route_everywhere or bool(route.in_junction[k]):
                row, column = self.pixel(*map(float, route.xy[k]))
                for i in range(-9, 10):
                    for j in range(-9, 10):
                        if math.hypot(i, j) <= radius:
                            self.put(row + i, column + j, 1, 255)

    def signals(self, route, idx, colour, time_left, satisfied):
        """Stop lines of lights, the stop sign, speed signs."""
        asking = []
        for q in range(len(route.stop_kind)):
            ahead, kind = int(route.stop_idx[q]) - idx, int(route.stop_kind[q])
            (x, y), yaw = map(float, route.stop_xy[q]), float(route.stop_yaw[q])
            width = float(route.stop_width[q])
            if kind == STOP_LIGHT and -20 < ahead < 150:
                value = 80 if int(colour[q]) == LIGHT_GREEN else 255
                if int(colour[q]) == LIGHT_YELLOW:
                    value = int(255 * (1 - 0.33 * min(float(time_left[q]) / 3, 1)))
                self.box(x, y, yaw, 1.5, 0.8 * width, 5, value)
            if kind == STOP_SIGN and -3 <= ahead <= 20 and not bool(satisfied[q]):
                asking.append((ahead, x, y, yaw, width))
        if asking:
            _, x, y, yaw, width = min(asking)
            self.box(x, y, yaw, width, width, 6, 255)
        for g in range(len(route.sign_idx)):
            sign = int(route.sign_idx[g])
            if sign >= 0 and -20 < sign - idx < 150:
                place = [*map(float, route.sign_xy[g]), float(route.yaw[sign])]
                self.box(*place, 2.0, 2.0, 7, code(float(route.sign_limit[g])))


def render(ego, agents, layers, origin, route, idx, colour, time_left, satisfied, config):
    """The whole image, (H, W, 10) int."""
    oracle = Oracle(ego, config)
    oracle.static(layers, origin)
    oracle.route(route, idx)
    oracle.road_users(agents)
    oracle.signals(route, idx, colour, time_left, satisfied)
    return oracle.image
