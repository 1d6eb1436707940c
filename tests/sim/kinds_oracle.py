"""Roach's and nuPlan's images again, in float64 NumPy, every pixel tested: written apart.

What stands still is looked up at the atlas's pixel nearest to each pixel's centre, as the images
promise; all else is tested at the pixel's centre itself.
"""

from __future__ import annotations

import math

import numpy as np

from carljax.sim.types import (
    KIND_PEDESTRIAN,
    KIND_STATIC,
    KIND_VEHICLE,
    LIGHT_GREEN,
    LIGHT_YELLOW,
    STOP_LIGHT,
)


class Canvas:
    """Centres of all pixels in the world, (H, W, 2) m."""

    def __init__(self, ego, config, num_channels):
        self.xy, self.yaw, self.z = np.float64(ego.xy), float(ego.yaw), float(ego.z)
        self.px = config.pixels_per_metre
        rows, columns = np.mgrid[: config.height, : config.width] + 0.5
        ahead = (config.height - config.ego_from_bottom_px - rows) / self.px
        left = (config.width / 2 - columns) / self.px
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        self.places = self.xy + np.stack([cos * ahead - sin * left, sin * ahead + cos * left], -1)
        self.image = np.zeros((config.height, config.width, num_channels), int)

    def put(self, mask, channel, value):
        """Draws where the mask is, unless something larger is there."""
        at = self.image[..., channel]
        self.image[..., channel] = np.where(mask, np.maximum(at, value), at)

    def in_box(self, xy, yaw, length, width):
        """Pixels whose centre lies in a box."""
        offset = self.places - np.float64(xy)
        along = math.cos(yaw) * offset[..., 0] + math.sin(yaw) * offset[..., 1]
        across = math.cos(yaw) * offset[..., 1] - math.sin(yaw) * offset[..., 0]
        return (np.abs(along) <= length / 2) & (np.abs(across) <= width / 2)

    def snapped(self, origin):
        """Centres of the atlas pixels, 0.5 m apart, nearest to the pixels'."""
        return np.float64(origin) + np.round((self.places - np.float64(origin)) * 2) / 2


def segment_distance(places, a, b):
    """Distance of places (..., 2) to a segment, m."""
    a, b = np.float64(a), np.float64(b)
    along = np.clip(((places - a) @ (b - a)) / max((b - a) @ (b - a), 1e-12), 0, 1)
    return np.linalg.norm(places - a - along[..., None] * (b - a), axis=-1)


def roach(ego, moments, layers, origin, route, idx, config):
    """(H, W, 15). Each moment: agents, the colours of the stop lines, the sign that asks or -1."""
    canvas = Canvas(ego, config, 15)
    index = np.round((canvas.snapped(origin) - np.float64(origin)) * 2).astype(int)
    shape = np.array(layers.shape)[::-1]
    inside = ((index >= 0) & (index < shape)).all(-1)
    index = np.where(inside[..., None], index, 0)
    bits = np.where(inside, layers[index[..., 1], index[..., 0]], 0)
    canvas.put(bits & 1 > 0, 0, 255)
    canvas.put(bits & 4 > 0, 2, 255)
    canvas.image[..., 2][bits & 8 > 0] = 120
    last = min(idx + 80, int(route.num_points)) - 1
    for k in range(idx, last):
        canvas.put(segment_distance(canvas.places, route.xy[k], route.xy[k + 1]) <= 1.6, 1, 255)
    for m, (agents, colour, sign) in enumerate(moments):
        for n in range(len(agents.kind)):
            kind = int(agents.kind[n])
            if kind in (KIND_VEHICLE, KIND_PEDESTRIAN) and abs(float(agents.z[n]) - canvas.z) < 8:
                scale = 2.0 if kind == KIND_PEDESTRIAN else 1.0
                size = [max(scale * float(x[n]), 1.6) for x in (agents.length, agents.width)]
                box = canvas.in_box(agents.xy[n], float(agents.yaw[n]), *size)
                canvas.put(box, (3 if kind == KIND_VEHICLE else 7) + m, 255)
        for q in range(len(route.stop_kind)):
            ahead = int(route.stop_idx[q]) - idx
            yaw, width = float(route.stop_yaw[q]), float(route.stop_width[q])
            if int(route.stop_kind[q]) == STOP_LIGHT and -20 < ahead < 80:
                value = {LIGHT_GREEN: 80, LIGHT_YELLOW: 170}.get(int(colour[q]), 255)
                line = canvas.in_box(route.stop_xy[q], yaw, 1.2, 0.8 * width)
                canvas.put(line, 11 + m, value)
            if q == sign:
                canvas.put(canvas.in_box(route.stop_xy[q], yaw, width, width), 11 + m, 255)
    return canvas.image


def in_strip(places, left, right):
    """Places between two borders, piece by piece: convex quads, all on one side of each edge."""
    out = np.zeros(places.shape[:-1], bool)
    low, high = places.reshape(-1, 2).min(0) - 3, places.reshape(-1, 2).max(0) + 3
    for i in range(len(left) - 1):
        quad = np.array([left[i], left[i + 1], right[i + 1], right[i]])
        if (quad.max(0) < low).any() or (quad.min(0) > high).any():
            continue
        edge = np.roll(quad, -1, axis=0) - quad
        cross = [
            e[0] * (places[..., 1] - c[1]) - e[1] * (places[..., 0] - c[0])
            for e, c in zip(edge, quad, strict=True)
        ]
        out |= np.all(np.array(cross) <= 0, axis=0) | np.all(np.array(cross) >= 0, axis=0)
    return out


def sides(lane):
    """Both borders of a lane of the file."""
    normal = np.stack([-np.sin(lane.yaw), np.cos(lane.yaw)], -1) * lane.width[:, None] / 2
    return lane.xyz[:, :2] + normal, lane.xyz[:, :2] - normal


def byte(speed, most):
    """The authors' colour of a speed."""
    return int(127.5 * min(max(speed / most, 0.0), 1.0) + 127.5)


def nuplan(ego, ego_size, agents, town, origin, on_route, light_of, config):
    """(H, W, 9).

    Args:
      ego: the ego.
      ego_size: m.
      agents: the others.
      town: the town, as read.
      origin: of its atlas, m.
      on_route: (raw lane's index) whether the route's road blocks hold it.
      light_of: (raw lane's index) what its light shows, None where it has none.
      config: size.
    """
    canvas = Canvas(ego, config, 9)
    _nuplan_lanes(canvas, town, origin, on_route, light_of)
    _nuplan_users(canvas, agents, config)
    canvas.put(canvas.in_box(canvas.xy, canvas.yaw, *ego_size), 8, byte(float(ego.speed), 30.0))
    return canvas.image


def _nuplan_lanes(canvas, town, origin, on_route, light_of):
    static, lanes = canvas.snapped(origin), town.network.lanes
    # A millimetre on, so that places on an edge fall as in the atlas, which snaps corners to 2 mm.
    beside = static + 1e-3
    nearest = np.full(static.shape[:-1], np.inf)
    reach = 0.75 * sum(canvas.image.shape[:2]) / canvas.px
    for i, lane in enumerate(lanes):
        if lane.kind not in ("driving", "parking"):
            continue
        if np.linalg.norm(lane.xyz[:, :2] - canvas.xy, axis=1).min() > reach:
            continue
        inside = in_strip(beside, *sides(lane))
        canvas.put(inside, 0, 255)
        if lane.kind != "driving":
            continue
        if on_route(i):
            canvas.put(inside, 1, 255)
        distance = np.full(static.shape[:-1], np.inf)
        for k in range(len(lane.s) - 1):
            ends = lane.xyz[k, :2], lane.xyz[k + 1, :2]
            distance = np.minimum(distance, segment_distance(static, *ends))
            if lane.junction is None:
                for side in sides(lane):
                    border = segment_distance(beside, side[k], side[k + 1]) <= 0.5
                    canvas.put(border, 2, 255)
        wins = (distance < nearest) & (distance <= 0.5)
        nearest = np.minimum(nearest, distance)
        light = light_of(i) if lane.junction is not None else None
        value = {None: 0, LIGHT_GREEN: 80, LIGHT_YELLOW: 170}.get(light, 255)
        canvas.image[wins, 3] = value
        row = town.lanes.raw_lane[i]
        canvas.image[wins, 5] = byte(float(town.lanes.speed_limit[row]), 30.0)


def _nuplan_users(canvas, agents, config):
    users = [(6, 30.0, KIND_VEHICLE), (7, 4.0, KIND_PEDESTRIAN), (7, None, KIND_STATIC)]
    for channel, most, kind in users:
        for n in np.flatnonzero(np.asarray(agents.kind) == kind):
            offset = np.float64(agents.xy[n]) - canvas.xy
            cos, sin = math.cos(canvas.yaw), math.sin(canvas.yaw)
            ahead, left = cos * offset[0] + sin * offset[1], cos * offset[1] - sin * offset[0]
            back = config.ego_from_bottom_px / canvas.px
            front, half = config.height / canvas.px - back, config.width / canvas.px / 2
            near = abs(float(agents.z[n]) - canvas.z) < 8
            if not (near and -back < ahead < front and -half < left < half):
                continue
            yaw, length = float(agents.yaw[n]), float(agents.length[n])
            value = 127 if most is None else byte(float(agents.speed[n]), most)
            box = canvas.in_box(agents.xy[n], yaw, length, float(agents.width[n]))
            canvas.put(box, channel, value)
