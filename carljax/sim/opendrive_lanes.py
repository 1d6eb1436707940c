"""Samples the lanes and road marks of OpenDRIVE roads into polylines.

All lanes of a section share one set of arc lengths, so that neighbours have their points side by
side.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from carljax.sim import reference_line as rl
from carljax.sim.opendrive_roads import LaneSpec, RoadSpec, SectionSpec
from carljax.sim.opendrive_xml import Warnings
from carljax.sim.road_network import Lane, RoadMark

# source: ours. Points at most this far apart, and chords at most this far from the true curve, m.
STEP, CHORD_ERROR = 1.0, 0.008
# A section with more points than this is not sampled any finer (a road bent into a knot).
POINTS_MAX = 200_000
# Jumps in the file can't be refined away: stop here, m.
STEP_MIN = 0.05
# A lane further from its road's line, or wider, than this is a typing error, m.
OFFSET_MAX = 1000.0
# Breaks closer than this to the one before add nothing, m.
_MERGE = 1e-3
# A lane's crossing with itself is looked for this many points either side of a fold.
_LOOP = 200
# Jumps and turns between two records up to this size are rounding, m and rad.
_JUMP, _TURN = 0.02, 0.05


@dataclasses.dataclass(frozen=True)
class Sampled:
    """A section at P arc lengths.

    Attributes:
      s: (P,) m along the road.
      xy: (P, 2) m, reference line; normal: (P, 2) unit, to its left.
      yaw: (P,) rad; bend: (P,) 1/m; z: (P,) m.
      border: lane id -> (P,) t of its outer border, m; 0 is the lane offset itself.
      slope: lane id -> (P,) its slope along s.
    """

    s: np.ndarray
    xy: np.ndarray
    normal: np.ndarray
    yaw: np.ndarray
    bend: np.ndarray
    z: np.ndarray
    border: dict[int, np.ndarray]
    slope: dict[int, np.ndarray]

    def inner(self, lane_id: int) -> int:
        """The id whose outer border is this lane's inner one."""
        side = [i for i in self.border if i * lane_id >= 0 and abs(i) < abs(lane_id)]
        return max(side, key=abs)

    def line(self, t: np.ndarray) -> np.ndarray:
        """(P, 2) points at lateral offset t."""
        return self.xy + self.normal * t[:, None]


def _borders(
    road: RoadSpec, section: SectionSpec, s: np.ndarray, pick: np.ndarray
) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray]]:
    """Outer borders and slopes, from the middle outwards."""
    offset, slope = road.lane_offset.at(s, pick)
    border, slopes = {0: offset}, {0: slope}
    for sign in (1, -1):
        at, rise = offset, slope
        for lane_id in sorted((i for i in section.lanes if i * sign > 0), key=abs):
            lane = section.lanes[lane_id]
            value, change = lane.width.at(s, pick)
            if lane.is_border:
                at, rise = offset + value, slope + change
            else:
                at, rise = at + sign * value, rise + sign * change
            border[lane_id], slopes[lane_id] = at, rise
    return border, slopes


@dataclasses.dataclass(frozen=True)
class Positions:
    """Where to sample a section.

    Attributes:
      s: (P,) m, never falling.
      pick: (P,) m, chooses the records in force: just below s where a record ends.
      turn: (P,) rad, added to the heading: rounds the corner where two geometries meet at an angle.
    """

    s: np.ndarray
    pick: np.ndarray
    turn: np.ndarray

    def insert(self, rows: np.ndarray, s: np.ndarray) -> Positions:
        """With plain positions `s` in front of the given rows."""
        return Positions(
            np.insert(self.s, rows, s),
            np.insert(self.pick, rows, s),
            np.insert(self.turn, rows, 0.0),
        )


def evaluate(road: RoadSpec, section: SectionSpec, at: Positions) -> Sampled:
    """The section at some positions; at its end the records that end there still hold."""
    pick = np.minimum(at.pick, max(section.s0, np.nextafter(section.s1, -np.inf)))
    xy, yaw, bend = rl.evaluate(road.line, at.s, pick)
    yaw = yaw + at.turn
    border, slope = _borders(road, section, at.s, pick)
    normal = np.stack([-np.sin(yaw), np.cos(yaw)], axis=-1)
    return Sampled(at.s, xy, normal, yaw, bend, road.elevation.at(at.s, pick)[0], border, slope)


def _plain(s: np.ndarray) -> Positions:
    return Positions(s, s, np.zeros_like(s))


def _breaks(road: RoadSpec, section: SectionSpec) -> np.ndarray:
    """Arc lengths inside the section where a record begins."""
    starts = [road.line.start, road.lane_offset.start]
    starts += [lane.width.start for lane in section.lanes.values()]
    inside = np.unique(np.concatenate(starts))
    return inside[(inside > section.s0) & (inside < section.s1)]


def _corners(
    road: RoadSpec, section: SectionSpec, breaks: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """At each break: jump sideways (m), turn of the heading (rad), reach of the lanes (m)."""
    before = Positions(breaks, np.nextafter(breaks, -np.inf), np.zeros_like(breaks))
    a, b = evaluate(road, section, before), evaluate(road, section, _plain(breaks))
    jump = np.hypot(*(b.xy - a.xy).T)
    for lane_id in a.border:
        jump = np.maximum(jump, np.abs(b.border[lane_id] - a.border[lane_id]))
    turn = np.mod(b.yaw - a.yaw + np.pi, 2 * np.pi) - np.pi
    reach = np.max([np.abs(t) for t in b.border.values()], axis=0)
    return jump, turn, reach


def _round_corner(at: float, turn: float, reach: float) -> Positions:
    """Positions around a corner of the reference line, all at the same s."""
    count = int(min(np.ceil(abs(turn) * min(reach, 50.0) / (STEP / 2)) + 1, 100))
    part = np.linspace(1.0, 0.0, count + 1)
    s = np.full(count + 1, at)
    return Positions(s, s, -turn * part)


def _knots(
    road: RoadSpec, section: SectionSpec
) -> tuple[list[float], dict[int, Positions], np.ndarray]:
    """Arc lengths to sample in any case, the corners at some of them, and where records jump.

    A jump becomes a ramp of twice its size along the road, a corner of the heading an arc.
    """
    breaks = _breaks(road, section)
    around = np.concatenate([[section.s0], breaks, [section.s1]])
    knots, corners, jumps = [section.s0], {}, []
    for i, (jump, turn, reach) in enumerate(zip(*_corners(road, section, breaks), strict=True)):
        at = float(breaks[i])
        if jump > _JUMP:
            half = min(jump, STEP / 2)
            low, high = (at + around[i]) / 2, (at + around[i + 2]) / 2
            knots += [max(at - half, low), min(at + half, high)]
            jumps.append(at)
        elif abs(turn) > _TURN:
            corners[len(knots)] = _round_corner(at, turn, reach)
            knots.append(at)
        elif at > knots[-1] + _MERGE and at < section.s1 - _MERGE:
            knots.append(at)
    return [*knots, section.s1], corners, np.array(jumps)


def _first_positions(road: RoadSpec, section: SectionSpec) -> tuple[Positions, np.ndarray]:
    """Positions STEP apart at most, with all breaks; and the breaks at which a record jumps."""
    knots, corners, jumps = _knots(road, section)
    parts = []
    for i, (start, end) in enumerate(zip(knots, knots[1:], strict=False)):
        count = max(int(np.ceil((end - start) / STEP - 1e-9)), 1)
        s = np.linspace(start, end, count, endpoint=False)
        if i in corners:
            parts += [corners[i], _plain(s[1:])]
        else:
            parts.append(_plain(s))
    parts.append(_plain(np.array([section.s1])))
    joined = [np.concatenate([getattr(p, f) for p in parts]) for f in ("s", "pick", "turn")]
    return Positions(*joined), jumps


def _too_coarse(ends: Sampled, middle: Sampled) -> np.ndarray:
    """(P-1,) whether a step is too long for a border or centre: chord, or error in its middle."""
    ids = sorted(ends.border)
    t = np.stack([ends.border[i] for i in ids])
    tm = np.stack([middle.border[i] for i in ids])
    t = np.concatenate([t, (t[1:] + t[:-1]) / 2])
    tm = np.concatenate([tm, (tm[1:] + tm[:-1]) / 2])
    xy = ends.xy + t[..., None] * ends.normal  # (lines, P, 2)
    mid = middle.xy + tm[..., None] * middle.normal
    chord = xy[:, 1:] - xy[:, :-1]
    off = mid - xy[:, :-1]
    size = np.hypot(chord[..., 0], chord[..., 1])
    cross = np.abs(chord[..., 0] * off[..., 1] - chord[..., 1] * off[..., 0])
    error = cross / np.maximum(size, 1e-9)
    return ((size > STEP) | (error > CHORD_ERROR)).any(axis=0)


def sample_positions(road: RoadSpec, section: SectionSpec) -> Positions:
    """Where to sample a section: its ends, the starts of all records, and as densely as need be."""
    at, jumps = _first_positions(road, section)
    for _ in range(6):  # halves a step of 1 m down to STEP_MIN at most
        middle = _plain((at.s[1:] + at.s[:-1]) / 2)
        bad = np.diff(at.s) > 2 * STEP_MIN
        bad &= np.searchsorted(jumps, at.s[1:]) == np.searchsorted(jumps, at.s[:-1])
        bad &= _too_coarse(evaluate(road, section, at), evaluate(road, section, middle))
        if not bad.any() or len(at.s) > POINTS_MAX:
            break
        at = at.insert(np.flatnonzero(bad) + 1, middle.s[bad])
    return at


def _in_force(records: tuple[tuple[float, float | None], ...], s: float) -> float | None:
    """The value of the last record that starts at or before s."""
    value = None
    for start, speed in records:
        if start <= s:
            value = speed
    return value


def _crossing(xy: np.ndarray, before: slice, after: slice) -> tuple[int, int] | None:
    """The first segment of `before` that a segment of `after` crosses, and the last such one."""
    p, q = xy[before][:-1, None], xy[after][:-1]
    d, e = np.diff(xy[before], axis=0)[:, None], np.diff(xy[after], axis=0)
    det = d[..., 0] * e[..., 1] - d[..., 1] * e[..., 0]
    det = np.where(det == 0.0, np.inf, det)
    off = q - p
    u = (off[..., 0] * e[..., 1] - off[..., 1] * e[..., 0]) / det
    v = (off[..., 0] * d[..., 1] - off[..., 1] * d[..., 0]) / det
    i, j = np.nonzero((u >= 0.0) & (u <= 1.0) & (v >= 0.0) & (v <= 1.0) & np.isfinite(det))
    return (before.start + int(i[0]), after.start + int(j[i == i[0]][-1])) if len(i) else None


def _onward(xy: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Rows of the points but for those in loops.

    On the inside of a bend tighter than its distance from the reference line a lane goes backwards
    and crosses itself. A car cuts that loop off; where the fold reaches the lane's end it stops
    short of it.
    """
    heading = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    step = np.diff(xy, axis=0)
    back = np.flatnonzero((step * (heading[:-1] + heading[1:])).sum(axis=-1) < 0.0)
    keep = np.ones(len(xy), bool)
    while len(back):
        gaps = np.flatnonzero(np.diff(back) > 1)
        first, last = int(back[0]), int(back[gaps[0]] if len(gaps) else back[-1])
        low, high = max(first - _LOOP, 0), min(last + 1 + _LOOP, len(xy) - 1)
        cut = _crossing(xy, slice(low, first + 1), slice(last + 1, high + 1))
        if cut is not None:
            keep[cut[0] + 1 : cut[1] + 1] = False
        elif last == len(step) - 1:
            ahead = ((xy[-1] - xy[low:-1]) * heading[low:-1]).sum(axis=-1) > 0.0
            keep[low:-1] &= np.logical_and.accumulate(ahead)
        elif first == 0:
            ahead = ((xy[1:high] - xy[0]) * heading[1:high]).sum(axis=-1) > 0.0
            keep[1:high] &= np.logical_and.accumulate(ahead[::-1])[::-1]
        back = back[back > last]
    return np.flatnonzero(keep)


def _lane(
    road: RoadSpec, section: SectionSpec, spec: LaneSpec, at: Sampled, warnings: Warnings
) -> Lane:
    place = road.place.at("section", section.index).at("lane", spec.id)
    inner = at.inner(spec.id)
    t = (at.border[inner] + at.border[spec.id]) / 2
    slope = (at.slope[inner] + at.slope[spec.id]) / 2
    width = (at.border[spec.id] - at.border[inner]) * np.sign(spec.id)
    if not (np.abs(t) + np.abs(width) < OFFSET_MAX).all():
        raise place.error(f"lies or reaches further than {OFFSET_MAX:g} m from its road's line")
    if (width < -0.01).any():
        warnings.add("lane with negative width: taken as 0", place)
    # Heading of the curve xy + t n: d/ds = (1 - bend t) along, t' across; inside of a bend tighter
    # than t the lane folds over, its heading stays that of the road.
    yaw = at.yaw + np.arctan2(slope, np.maximum(1.0 - at.bend * t, 1e-2))
    xyz = np.column_stack([at.line(t), at.z])
    rows = _onward(xyz[:, :2], yaw)
    along = road.travels_along(spec)
    yaw = yaw if along else yaw + np.pi
    rows = rows if along else rows[::-1]
    middle = (section.s0 + section.s1) / 2
    limit = _in_force(spec.speed, middle)
    return Lane(
        road_id=road.id,
        section=section.index,
        lane_id=spec.id,
        kind=spec.kind,
        xyz=xyz[rows],
        width=np.maximum(width, 0.0)[rows],
        s=at.s[rows],
        yaw=(np.mod(yaw + np.pi, 2 * np.pi) - np.pi)[rows],
        junction=road.junction,
        speed_limit=limit if limit is not None else _in_force(road.speed, middle),
    )


def _marks(spec: LaneSpec, section: SectionSpec, at: Sampled) -> list[RoadMark]:
    """The painted stretches along a lane's outer border."""
    out = []
    ends = [m.start for m in spec.marks[1:]] + [section.s1]
    for mark, end in zip(spec.marks, ends, strict=False):
        start, stop = max(mark.start, section.s0), min(end, section.s1)
        if not mark.kind or stop - start < _MERGE:
            continue
        inside = at.s[(at.s > start + _MERGE) & (at.s < stop - _MERGE)]
        s = np.concatenate([[start], inside, [stop]])
        xy = at.line(at.border[spec.id])
        xy = np.column_stack([np.interp(s, at.s, xy[:, i]) for i in (0, 1)])
        out.append(RoadMark(xy, mark.kind, mark.colour, np.interp(s, at.s, at.z)))
    return out


def sample_road(road: RoadSpec, warnings: Warnings) -> tuple[list[Lane], list[RoadMark]]:
    """All lanes (but the middle one) of a road, and its marks; none are painted in junctions."""
    lanes, marks = [], []
    for section in road.sections:
        at = evaluate(road, section, sample_positions(road, section))
        if not all(np.isfinite(v).all() for v in (at.xy, at.yaw, at.z)):
            raise road.place.at("section", section.index).error("runs off to infinity")
        for lane_id in sorted(section.lanes, reverse=True):
            spec = section.lanes[lane_id]
            if lane_id:
                lanes.append(_lane(road, section, spec, at, warnings))
            if road.junction is None:
                marks += _marks(spec, section, at)
    return lanes, marks
