"""Scenes for `bev_opencv.py`, in plain NumPy: what both sides are given to draw.

Ten roads cross, each with two lanes, a shoulder on either side and three painted lines: 30
polylines. Around the ego are 50 vehicles, 50 pedestrians, 10 bicycles and 10 obstacles, and it has
a route with lights, a stop sign and speed signs.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

HEIGHT, WIDTH, EGO_FROM_BOTTOM, PIXELS_PER_METRE = 256, 256, 100, 2.0
NUM_VEHICLES, NUM_PEDESTRIANS, NUM_BICYCLES, NUM_STATICS = 50, 50, 10, 10
NUM_ROADS = 10
LANE_WIDTH, SHOULDER_WIDTH, MARK_WIDTH = 3.5, 2.0, 1.0  # m
REACH = 200.0  # m from the middle to the roads' ends and to the map's
SPACING, BEND = 24.0, 3.0  # m between parallel roads, and that they swing to the sides
ROUTE_POINTS, ROUTE_IDX = 176, 24
CLEARANCE = 3.0  # m between the middles of two road users

VEHICLE, PEDESTRIAN, STATIC = 1, 2, 3
LIGHT, STOP = 1, 2
GREEN, YELLOW, RED = 0, 1, 2
# Bits of what a vehicle shows, and of its open doors.
LEFT, RIGHT, BRAKE, EMERGENCY, DOOR_FRONT_LEFT, DOOR_REAR_RIGHT = 1, 2, 4, 8, 16, 128


class Road(NamedTuple):
    """A road: its middle, (P, 2) m, and the direction along it, (P,) rad."""

    xy: np.ndarray
    yaw: np.ndarray

    def aside(self, offset: float) -> np.ndarray:
        """(P, 2) m, the line so many metres to the left of the middle."""
        normal = np.stack([-np.sin(self.yaw), np.cos(self.yaw)], axis=-1)
        return self.xy + offset * normal


class Users(NamedTuple):
    """Road users, (N,) each: kind, xy (N, 2) m, yaw rad, length, width m, speed m/s, signals."""

    kind: np.ndarray
    xy: np.ndarray
    yaw: np.ndarray
    length: np.ndarray
    width: np.ndarray
    speed: np.ndarray
    signals: np.ndarray


@dataclasses.dataclass(frozen=True)
class Scene:
    """One moment.

    Attributes:
      ego_xy, ego_yaw: (2,) m, rad.
      users: everybody else.
      route_xy, route_yaw, in_junction: (R, 2) m, (R,) rad, (R,) bool; the ego is at `ROUTE_IDX`.
      stop_idx, stop_kind, light, stop_width: (Q,) stop lines: route point, LIGHT or STOP, colour of
        the light, lane width m; they lie on their route point.
      yellow_left: s until a yellow light turns red.
      sign_idx, sign_limit: (G,) speed signs: route point, m/s.
      sign_xy: (G, 2) m.
    """

    ego_xy: np.ndarray
    ego_yaw: float
    users: Users
    route_xy: np.ndarray
    route_yaw: np.ndarray
    in_junction: np.ndarray
    stop_idx: np.ndarray
    stop_kind: np.ndarray
    light: np.ndarray
    stop_width: np.ndarray
    yellow_left: float
    sign_idx: np.ndarray
    sign_limit: np.ndarray
    sign_xy: np.ndarray


def roads() -> list[Road]:
    """Half of them along x and half along y, each swinging a little, points a metre apart."""
    along = np.arange(-REACH, REACH + 1.0)
    out = []
    for number in range(NUM_ROADS):
        aside = SPACING * (number // 2 - (NUM_ROADS // 2 - 1) / 2)
        swing = aside + BEND * np.sin(along / 25.0 + number)
        slope = BEND / 25.0 * np.cos(along / 25.0 + number)
        if number % 2 == 0:
            out.append(Road(np.stack([along, swing], axis=-1), np.arctan2(slope, 1.0)))
        else:
            out.append(Road(np.stack([swing, along], axis=-1), np.arctan2(1.0, slope)))
    return out


def make(seed: int) -> Scene:
    """Draws a scene.

    Args:
      seed: of everything but the roads.
    """
    rng = np.random.default_rng(seed)
    road = roads()[2 * int(rng.integers(NUM_ROADS // 2))]
    begin = int(rng.integers(100, 180))
    points = slice(begin, begin + ROUTE_POINTS)
    route_xy, route_yaw = road.aside(-LANE_WIDTH / 2)[points], road.yaw[points]
    sign_idx = np.array([ROUTE_IDX + 10, ROUTE_IDX + 45])
    right = np.stack([np.sin(route_yaw), -np.cos(route_yaw)], axis=-1)[sign_idx]
    ego_xy = route_xy[ROUTE_IDX] + rng.uniform(-0.5, 0.5, 2)
    return Scene(
        ego_xy=ego_xy,
        ego_yaw=float(route_yaw[ROUTE_IDX] + rng.uniform(-0.2, 0.2)),
        users=_users(ego_xy, rng),
        route_xy=route_xy,
        route_yaw=route_yaw,
        in_junction=np.arange(ROUTE_POINTS) % 48 > 24,
        stop_idx=np.array([ROUTE_IDX + 15, ROUTE_IDX + 35, ROUTE_IDX + 8, ROUTE_IDX + 60]),
        stop_kind=np.array([LIGHT, LIGHT, STOP, LIGHT]),
        light=np.array([RED, YELLOW, GREEN, GREEN]),
        stop_width=np.full(4, LANE_WIDTH),
        yellow_left=1.7,
        sign_idx=sign_idx,
        sign_limit=np.array([8.3, 13.9]),
        sign_xy=route_xy[sign_idx] + 4.0 * right,
    )


def _users(ego_xy: np.ndarray, rng: np.random.Generator) -> Users:
    """Everybody in the ego's sight, no two in one place."""
    nums = (NUM_VEHICLES, NUM_PEDESTRIANS, NUM_BICYCLES, NUM_STATICS)
    total = sum(nums)
    kind = np.repeat([VEHICLE, PEDESTRIAN, VEHICLE, STATIC], nums)
    least = np.repeat([(3.6, 1.8), (0.4, 0.4), (1.6, 0.5), (0.6, 0.6)], nums, axis=0)
    most = np.repeat([(5.4, 2.2), (0.8, 0.8), (1.9, 0.8), (2.5, 2.0)], nums, axis=0)
    size = rng.uniform(least, most)
    size[:2] = (10.3, 2.6), (8.0, 2.5)  # a bus and a lorry
    fastest = np.repeat([14.0, 1.8, 6.0, 0.0], nums)
    shown = (0, 0, BRAKE, BRAKE, LEFT, RIGHT, BRAKE | LEFT, EMERGENCY, DOOR_FRONT_LEFT, 0)
    signals = np.where(np.arange(total) < NUM_VEHICLES, np.resize(shown, total), 0)
    signals[NUM_VEHICLES - 1] = DOOR_REAR_RIGHT
    signals[10:NUM_VEHICLES] &= ~DOOR_FRONT_LEFT  # one open door of each kind at most
    return Users(
        kind=kind,
        xy=ego_xy + _places(total, rng),
        yaw=rng.uniform(-np.pi, np.pi, total),
        length=size[:, 0],
        width=size[:, 1],
        speed=fastest * rng.uniform(0.0, 1.0, total),
        signals=signals,
    )


def _places(num: int, rng: np.random.Generator) -> np.ndarray:
    """(num, 2) m, apart from one another and from the ego, most of them within the image."""
    found = np.zeros((1, 2))
    while len(found) <= num:
        place = rng.uniform(-60.0, 60.0, 2)
        if np.hypot(*(found - place).T).min() > CLEARANCE:
            found = np.concatenate([found, place[None]])
    return found[1:]
