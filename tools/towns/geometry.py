"""Reference lines: lines, arcs, clothoids and cubics that join two poses with one tangent.

Curvature is positive to the left. The clothoid fits are made by pyclothoids, which comes with
scenariogeneration.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import pyclothoids
from scenariogeneration import xodr

# Two directions closer than this count as the same, rad and m.
SAME = 1e-7


class Pose(NamedTuple):
    """A place and a direction: x, y in m, yaw in rad."""

    x: float
    y: float
    yaw: float

    def ahead(self, distance: float) -> Pose:
        """The pose `distance` m further on."""
        return Pose(
            self.x + distance * math.cos(self.yaw), self.y + distance * math.sin(self.yaw), self.yaw
        )

    def aside(self, offset: float) -> Pose:
        """The pose `offset` m to the left, same direction."""
        return Pose(
            self.x - offset * math.sin(self.yaw), self.y + offset * math.cos(self.yaw), self.yaw
        )

    def turned(self, angle: float) -> Pose:
        """The same place, turned left by `angle` rad."""
        return Pose(self.x, self.y, wrap(self.yaw + angle))

    def seen_from(self, origin: Pose) -> tuple[float, float, float]:
        """(ahead, left, yaw) of this pose in the frame of `origin`."""
        dx, dy = self.x - origin.x, self.y - origin.y
        c, s = math.cos(origin.yaw), math.sin(origin.yaw)
        return c * dx + s * dy, c * dy - s * dx, wrap(self.yaw - origin.yaw)


def wrap(angle: float) -> float:
    """The angle in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


@dataclasses.dataclass(frozen=True)
class Piece:
    """A stretch of linearly changing curvature, or a sideways shift by a cubic.

    Attributes:
      start: first pose.
      length: m.
      k0, k1: curvature at both ends, 1/m. Both 0 is a line, equal an arc, else a clothoid.
      shift: (ahead, left) of the end seen from the start, m, for a cubic with equal end directions.
    """

    start: Pose
    length: float
    k0: float = 0.0
    k1: float = 0.0
    shift: tuple[float, float] | None = None

    def element(self) -> xodr.Line | xodr.Arc | xodr.Spiral | xodr.ParamPoly3:
        """The scenariogeneration object of this piece."""
        if self.shift is not None:
            u, v = self.shift
            return xodr.ParamPoly3(0, u, 0, 0, 0, 0, 3 * v, -2 * v)
        if abs(self.k0) < SAME and abs(self.k1) < SAME:
            return xodr.Line(self.length)
        if abs(self.k0 - self.k1) < SAME:
            return xodr.Arc(self.k0, length=self.length)
        return xodr.Spiral(self.k0, self.k1, length=self.length)

    @property
    def end(self) -> Pose:
        """The last pose."""
        x, y, yaw, _ = self.element().get_end_data(*self.start)
        return Pose(float(x), float(y), wrap(float(yaw)))


Path = tuple[Piece, ...]


def length(path: Path) -> float:
    """Arc length of the path, m."""
    return sum(piece.length for piece in path)


def end(path: Path) -> Pose:
    """The last pose of the path."""
    return path[-1].end


def chain(start: Pose, *stretches: tuple[float, float, float]) -> Path:
    """Pieces one after the other.

    Args:
      start: first pose.
      *stretches: (length m, curvature at its start 1/m, curvature at its end 1/m); empty ones
        are left out.
    """
    pieces: list[Piece] = []
    for distance, k0, k1 in stretches:
        if distance > 1e-6:
            pieces.append(Piece(start, distance, k0, k1))
            start = pieces[-1].end
    return tuple(pieces)


def turn(start: Pose, goal: Pose) -> Path:
    """Line, arc and line with the widest arc that both tangents allow."""
    ahead, left, angle = goal.seen_from(start)
    if abs(angle) < SAME and abs(left) < SAME:
        return chain(start, (ahead, 0.0, 0.0))
    if abs(angle) < SAME:
        return shift(start, goal)
    to_corner = ahead - left / math.tan(angle)
    from_corner = left / math.sin(angle)
    tangent = min(to_corner, from_corner)
    if tangent <= 0:
        raise ValueError(f"no single bend leads from {start} to {goal}")
    curvature = math.tan(angle / 2) / tangent
    return chain(
        start,
        (to_corner - tangent, 0.0, 0.0),
        (angle / curvature, curvature, curvature),
        (from_corner - tangent, 0.0, 0.0),
    )


def bend(start: Pose, goal: Pose, radius: float, easing: float) -> Path:
    """Line, clothoid, arc, clothoid and line: a bend as roads are built.

    Args:
      start: first pose.
      goal: last pose, at least 0.1 rad turned.
      radius: of the arc, m.
      easing: length of each clothoid, m.
    """
    ahead, left, angle = goal.seen_from(start)
    to_corner = ahead - left / math.tan(angle)
    from_corner = left / math.sin(angle)
    curvature = math.copysign(1 / radius, angle)
    arc = radius * abs(angle) - easing
    eased = chain(Pose(0, 0, 0), (easing, 0, 1 / radius), (arc, 1 / radius, 1 / radius))
    x, y, yaw = eased[0].end
    # The clothoids move the arc inwards by `inset`, so the bend begins further from the corner.
    inset = y - radius * (1 - math.cos(yaw))
    tangent = (radius + inset) * math.tan(abs(angle) / 2) + x - radius * math.sin(yaw)
    if arc < 0 or tangent > min(to_corner, from_corner) + 1e-9:
        raise ValueError(f"a bend of {radius} m does not fit between {start} and {goal}")
    return chain(
        start,
        (to_corner - tangent, 0, 0),
        (easing, 0, curvature),
        (arc, curvature, curvature),
        (easing, curvature, 0),
        (from_corner - tangent, 0, 0),
    )


def wind(start: Pose, *goals: Pose) -> Path:
    """Clothoids through the poses with continuous curvature, straight at every pose."""
    pieces: list[Piece] = []
    for goal in goals:
        ahead, left, angle = goal.seen_from(start)
        if abs(left) < SAME and abs(angle) < SAME:
            pieces.append(Piece(start, ahead))
        else:
            fit = pyclothoids.SolveG2(*start, 0.0, *goal, 0.0)
            pieces += chain(start, *((c.length, c.KappaStart, c.KappaEnd) for c in fit))
        start = goal
    return tuple(pieces)


def shift(start: Pose, goal: Pose) -> Path:
    """A cubic to a pose of the same direction further ahead and aside."""
    ahead, left, _ = goal.seen_from(start)
    cubic = xodr.ParamPoly3(0, ahead, 0, 0, 0, 0, 3 * left, -2 * left)
    return (Piece(start, float(cubic.length), shift=(ahead, left)),)
