"""Samples the lanes and road marks of OpenDRIVE roads into polylines.

All lanes of a section share one set of arc lengths, so that neighbours have their points side by side.
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
# Jumps in the file can't be refined away: stop here, m.
STEP_MIN = 0.05
# A lane further from its road's line, or wider, than this is a typing error, m.
OFFSET_MAX = 1000.0
# Breaks closer than this to a neighbour add nothing, m.
_MERGE = 1e-3


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


def evaluate(road: RoadSpec, section: SectionSpec, s: np.ndarray) -> Sampled:
    """The section at arc lengths `s`; at its end the records that end there still hold."""
    pick = np.minimum(s, max(section.s0, np.nextafter(section.s1, -np.inf)))
    xy, yaw, bend = rl.evaluate(road.line, s, pick)
    border, slope = _borders(road, section, s, pick)
    normal = np.stack([-np.sin(yaw), np.cos(yaw)], axis=-1)
    return Sampled(s, xy, normal, yaw, bend, road.elevation.at(s, pick)[0], border, slope)


def _breaks(road: RoadSpec, section: SectionSpec) -> np.ndarray:
    """Arc lengths where a record of the section begins, with its two ends."""
    starts = [road.line.start, road.lane_offset.start]
    starts += [lane.width.start for lane in section.lanes.values()]
    inside = np.unique(np.concatenate(starts))
    inside = inside[(inside > section.s0 + _MERGE) & (inside < section.s1 - _MERGE)]
    if len(inside):
        inside = inside[np.concatenate([[True], np.diff(inside) > _MERGE])]
    return np.concatenate([[section.s0], inside, [section.s1]])


def _too_coarse(ends: Sampled, middle: Sampled) -> np.ndarray:
    """(P-1,) whether the step is too long for a lane border or centre: chord, or error in its middle."""
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


def sample_positions(road: RoadSpec, section: SectionSpec) -> np.ndarray:
    """Arc lengths to sample a section at, its two ends and the starts of all records among them."""
    breaks = _breaks(road, section)
    count = np.maximum(np.ceil(np.diff(breaks) / STEP - 1e-9).astype(int), 1)
    parts = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(breaks, breaks[1:], count, strict=False)]
    s = np.concatenate([*parts, [section.s1]])
    for _ in range(6):  # halves a step of 1 m down to STEP_MIN at most
        middle = (s[1:] + s[:-1]) / 2
        bad = _too_coarse(evaluate(road, section, s), evaluate(road, section, middle))
        bad &= np.diff(s) > 2 * STEP_MIN
        if not bad.any():
            break
        s = np.sort(np.concatenate([s, middle[bad]]))
    return s


def _in_force(records: tuple[tuple[float, float | None], ...], s: float) -> float | None:
    """The value of the last record that starts at or before s."""
    value = None
    for start, speed in records:
        if start <= s:
            value = speed
    return value


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
    # Heading of the curve xy + t n: d/ds = (1 - bend t) along, t' across; inside of a bend tighter than
    # t the lane folds over, its heading stays that of the road.
    yaw = at.yaw + np.arctan2(slope, np.maximum(1.0 - at.bend * t, 1e-2))
    xyz = np.column_stack([at.line(t), at.z])
    along = road.travels_along(spec)
    step = slice(None) if along else slice(None, None, -1)
    yaw = yaw if along else yaw + np.pi
    middle = (section.s0 + section.s1) / 2
    limit = _in_force(spec.speed, middle)
    return Lane(
        road_id=road.id,
        section=section.index,
        lane_id=spec.id,
        kind=spec.kind,
        xyz=xyz[step],
        width=np.maximum(width, 0.0)[step],
        s=at.s[step],
        yaw=(np.mod(yaw + np.pi, 2 * np.pi) - np.pi)[step],
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
        out.append(RoadMark(xy, mark.kind, mark.colour))
    return out


def sample_road(road: RoadSpec, warnings: Warnings) -> tuple[list[Lane], list[RoadMark]]:
    """All lanes (but the middle one) of a road, and its marks; roads in junctions have none painted."""
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
