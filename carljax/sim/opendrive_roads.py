"""The roads of an OpenDRIVE file as written: reference line, profiles, lane sections and lanes.

Source: ASAM OpenDRIVE 1.8 (1.4 to 1.7 read the same way). Nothing is sampled here.
"""

from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ET

import numpy as np

from carljax.sim import opendrive_xml as ox
from carljax.sim import reference_line as rl
from carljax.sim.opendrive_xml import Place, Warnings
from carljax.sim.road_network import MARK_BROKEN, MARK_SOLID, MapError

# A road longer than this is a typing error, and would take gigabytes to sample.
ROAD_MAX = 100_000.0
# Starts may pass the road's length by rounding in the file.
S_SLACK = 1e-3

DRIVING = "driving"
# Types on which the standard lets cars drive, but not everywhere or not everybody. CARLA's maps
# call every lane to drive on "driving", and CARLA itself drives on no other.
ALSO_DRIVABLE = frozenset(
    "entry exit onRamp offRamp connectingRamp slipLane bidirectional bus taxi HOV".split()
)


@dataclasses.dataclass(frozen=True)
class MarkSpec:
    """A road mark record: start within the section, MARK_* (0: no paint) and colour."""

    start: float
    kind: int
    colour: str


@dataclasses.dataclass(frozen=True)
class LaneSpec:
    """One lane as written.

    Attributes:
      id: > 0 left of the reference line, < 0 right of it, 0 the line itself.
      kind: lane type.
      predecessors, successors: lane ids, along s whatever the direction of travel.
      width: cubics over s (absolute), or of the outer border where `is_border`.
      is_border: the cubics give the outer border's t instead of the width.
      marks: at the outer border.
      speed: (start, m/s or None) records.
      reversed: driven against the rule of its side (OpenDRIVE 1.8 lane@direction).
    """

    id: int
    kind: str
    predecessors: tuple[int, ...]
    successors: tuple[int, ...]
    width: rl.Cubics
    is_border: bool
    marks: tuple[MarkSpec, ...]
    speed: tuple[tuple[float, float | None], ...]
    reversed: bool


@dataclasses.dataclass(frozen=True)
class SectionSpec:
    """A lane section from s0 to s1, its lanes by id."""

    index: int
    s0: float
    s1: float
    lanes: dict[int, LaneSpec]


@dataclasses.dataclass(frozen=True)
class RoadLink:
    """What a road's end touches: "road" or "junction", its id, the end of that road if known."""

    kind: str
    id: str
    contact: str | None


@dataclasses.dataclass(frozen=True)
class RoadSpec:
    """One road as written; `junction` is None outside junctions."""

    id: str
    length: float
    junction: str | None
    left_hand: bool
    predecessor: RoadLink | None
    successor: RoadLink | None
    line: rl.ReferenceLine
    elevation: rl.Cubics
    lane_offset: rl.Cubics
    sections: tuple[SectionSpec, ...]
    speed: tuple[tuple[float, float | None], ...]
    element: ET.Element
    place: Place

    def travels_along(self, lane: LaneSpec) -> bool:
        """Whether traffic on the lane moves along s."""
        return (lane.id < 0) != (self.left_hand != lane.reversed)


def in_order(starts: list[float], place: Place, warnings: Warnings, what: str) -> np.ndarray:
    """Row order by start; a file that has them mixed up is put right and warned of."""
    order = np.argsort(np.asarray(starts), kind="stable")
    if (np.diff(order) < 0).any():
        warnings.add(f"{what} records out of order: sorted", place)
    return order


def cubics(
    elements: list[ET.Element], key: str, offset: float, place: Place, warnings: Warnings
) -> rl.Cubics:
    """The records of one profile; `key` names the start attribute, `offset` is added to it."""
    if not elements:
        return rl.Cubics(np.zeros(0), np.zeros((0, 4)))
    start = [offset + ox.number(e, key, place) for e in elements]
    coeff = np.array([[ox.number(e, c, place) for c in "abcd"] for e in elements])
    order = in_order(start, place, warnings, f"<{elements[0].tag}>")
    return rl.Cubics(np.array(start)[order], coeff[order])


def _param_poly3(shape: ET.Element, length: float, place: Place) -> rl.PlanarCurve:
    u, v = (np.array([ox.number(shape, c + axis, place) for c in "abcd"]) for axis in "UV")
    # A missing pRange means "normalized" (OpenDRIVE 1.4, 5.3.4.1.5).
    p_range = shape.get("pRange", "normalized")
    if p_range not in ("arcLength", "normalized"):
        raise place.error(f"pRange {ox.shown(p_range)} is neither arcLength nor normalized")
    curve = rl.planar_curve(u, v, 1.0 if p_range == "normalized" else length, length)
    if not 0.01 < curve.scale < 100.0:
        raise place.error(
            f"paramPoly3 is {curve.arc[-1]:.6g} m long, its length says {length:.6g} m"
        )
    return curve


def _shape(
    element: ET.Element, length: float, place: Place
) -> tuple[float, float, rl.PlanarCurve | None]:
    """Curvature, its rate, and the curve of one planView geometry."""
    for shape in element:
        if shape.tag == "line":
            return 0.0, 0.0, None
        if shape.tag == "arc":
            return ox.number(shape, "curvature", place), 0.0, None
        if shape.tag == "spiral":
            k0, k1 = (ox.number(shape, c, place) for c in ("curvStart", "curvEnd"))
            return k0, (k1 - k0) / length if length > 0.0 else 0.0, None
        if shape.tag == "poly3":
            v = np.array([ox.number(shape, c, place) for c in "abcd"])
            u = np.array([0.0, 1.0, 0.0, 0.0])
            return 0.0, 0.0, rl.planar_curve(u, v, length, None) if length > 0.0 else None
        if shape.tag == "paramPoly3":
            return 0.0, 0.0, _param_poly3(shape, length, place) if length > 0.0 else None
    raise place.error("holds no line, arc, spiral, poly3 or paramPoly3")


def _reference_line(
    road: ET.Element, total: float, place: Place, warnings: Warnings
) -> rl.ReferenceLine:
    elements = road.findall("planView/geometry")
    if not elements:
        raise place.error("has no planView geometry")
    rows, shapes = [], []
    for i, element in enumerate(elements):
        here = place.at("geometry", i)
        row = [ox.number(element, c, here) for c in ("s", "x", "y", "hdg")]
        row.append(ox.length(element, "length", here))
        rows.append(row)
        shapes.append(_shape(element, row[4], here))
    order = in_order([r[0] for r in rows], place, warnings, "<geometry>")
    start, x, y, hdg, length = np.array(rows)[order].T
    shapes = [shapes[i] for i in order]
    line = rl.ReferenceLine(
        start, x, y, hdg, length,
        np.array([k for k, _, _ in shapes]),
        np.array([rate for _, rate, _ in shapes]),
        {i: curve for i, (_, _, curve) in enumerate(shapes) if curve is not None},
    )  # fmt: skip
    _check_line(line, total, place, warnings)
    return line


def _check_line(line: rl.ReferenceLine, total: float, place: Place, warnings: Warnings) -> None:
    """Warns of gaps between the pieces, and of a length that isn't theirs."""
    if abs(line.start[0]) > S_SLACK:
        warnings.add("first geometry does not start at s = 0", place)
    end = line.start[-1] + line.length[-1]
    if abs(end - total) > max(0.01, 1e-4 * total):
        warnings.add("road length differs from its geometries'", place)
    if len(line.start) > 1:
        before = np.nextafter(line.start[1:], -np.inf)
        xy, _, _ = rl.evaluate(line, line.start[1:], before)
        gap = np.hypot(xy[:, 0] - line.x[1:], xy[:, 1] - line.y[1:])
        if not np.isfinite(gap).all():
            raise place.error("a geometry runs off to infinity")
        if (gap > 0.05).any():
            warnings.add("geometries of a road do not meet (gap over 5 cm)", place)


# Double lines count as solid where either is; curb, grass and edge are no paint.
_MARKS = {
    "solid": MARK_SOLID,
    "broken": MARK_BROKEN,
    "solid solid": MARK_SOLID,
    "solid broken": MARK_SOLID,
    "broken solid": MARK_SOLID,
    "broken broken": MARK_BROKEN,
    "botts dots": MARK_BROKEN,
}


def _mark(element: ET.Element, offset: float, place: Place, warnings: Warnings) -> MarkSpec:
    name = element.get("type", "none")
    kind = _MARKS.get(name, 0)
    if name == "custom":
        lines = element.findall("type/line") + element.findall("explicit/line")
        gaps = [ox.number(x, "space", place, 0.0) > 0.0 for x in lines]
        kind = 0 if not gaps else MARK_BROKEN if all(gaps) else MARK_SOLID
    elif not kind and name not in ("none", "curb", "grass", "edge"):
        warnings.add(f"road mark type {ox.shown(name)} is not read", place)
    if element.find("sway") is not None:
        warnings.add("road mark sway is not read", place)
    colour = element.get("color", "white")
    start = offset + ox.number(element, "sOffset", place, 0.0)
    return MarkSpec(start, kind, "white" if colour == "standard" else colour)


def _speeds(
    records: list[tuple[float, ET.Element]], place: Place, warnings: Warnings
) -> tuple[tuple[float, float | None], ...]:
    """(start, m/s) of <speed> elements; OpenDRIVE's default unit is m/s."""
    out = [
        (start, ox.speed(e.get("max"), e.get("unit") or "m/s", place, warnings))
        for start, e in records
    ]
    return tuple(sorted(out, key=lambda record: record[0]))


def _lane(element: ET.Element, s0: float, place: Place, warnings: Warnings) -> LaneSpec:
    lane_id = ox.lane_number(element, "id", place)
    widths, borders = element.findall("width"), element.findall("border")
    kind = element.get("type", "none")
    if lane_id and not widths and not borders:
        if kind != "none":
            raise place.error("has neither width nor border")
        warnings.add("lane of type 'none' without width: taken as 0", place)
    if widths and borders:
        warnings.add("lane with width and border: width is taken, as the standard says", place)
    for tag in ("height", "access", "rule"):
        if element.find(tag) is not None:
            warnings.add(f"lane {tag} is not read", place)
    if kind in ALSO_DRIVABLE:
        warnings.add(f"lane type {kind!r} is not driven on", place)
    direction = element.get("direction", "standard")
    if direction == "both":
        warnings.add("lane direction 'both' is read as one way, by its side", place)
    links = {
        tag: tuple(ox.lane_number(e, "id", place) for e in element.findall(f"link/{tag}"))
        for tag in ("predecessor", "successor")
    }
    marks = [_mark(e, s0, place, warnings) for e in element.findall("roadMark")]
    speeds = [(s0 + ox.number(e, "sOffset", place, 0.0), e) for e in element.findall("speed")]
    return LaneSpec(
        id=lane_id,
        kind=kind,
        predecessors=links["predecessor"],
        successors=links["successor"],
        width=cubics(widths or borders, "sOffset", s0, place, warnings),
        is_border=not widths,
        marks=tuple(sorted(marks, key=lambda m: m.start)),
        speed=_speeds(speeds, place, warnings),
        reversed=direction == "reversed",
    )


def _section(
    element: ET.Element, index: int, span: tuple[float, float], place: Place, warnings: Warnings
) -> SectionSpec:
    lanes: dict[int, LaneSpec] = {}
    for side, sign in (("left", 1), ("center", 0), ("right", -1)):
        for lane in element.findall(f"{side}/lane"):
            here = place.at("lane", lane.get("id", "?"))
            spec = _lane(lane, span[0], here, warnings)
            if np.sign(spec.id) != sign:
                raise here.error(f"stands under <{side}>")
            if spec.id in lanes:
                raise here.error("is there twice")
            lanes[spec.id] = spec
    if not lanes:
        raise place.error("has no lanes")
    return SectionSpec(index, span[0], span[1], lanes)


def _sections(
    road: ET.Element, total: float, place: Place, warnings: Warnings
) -> tuple[SectionSpec, ...]:
    elements = road.findall("lanes/laneSection")
    if not elements:
        raise place.error("has no lane section")
    starts = [ox.number(e, "s", place.at("section", i)) for i, e in enumerate(elements)]
    for i, start in enumerate(starts):
        here = place.at("section", i)
        if i and start < starts[i - 1]:
            raise here.error(f"starts at s = {start:g} m, before the section ahead of it")
        if not -S_SLACK <= start <= total + S_SLACK:
            raise here.error(f"starts at s = {start:g} m, off the road's 0 to {total:g} m")
    if starts[0] > S_SLACK:
        warnings.add("first lane section does not start at s = 0", place)
    edges = [*np.clip(starts, 0.0, total), total]
    return tuple(
        _section(e, i, (float(edges[i]), float(edges[i + 1])), place.at("section", i), warnings)
        for i, e in enumerate(elements)
    )


def _link(road: ET.Element, tag: str, place: Place, warnings: Warnings) -> RoadLink | None:
    element = road.find(f"link/{tag}")
    if element is None or not element.get("elementId", "").strip():
        return None
    kind = element.get("elementType", "road")
    if kind not in ("road", "junction"):
        raise place.error(f"{tag} is a {ox.shown(kind)}, neither road nor junction")
    contact = element.get("contactPoint")
    if element.get("elementS") is not None:
        warnings.add(
            "link into the middle of a road holds only if it is near that road's end", place
        )
        contact = None
    if contact not in (None, "", "start", "end"):
        raise place.error(f"{tag} has contactPoint {ox.shown(contact or '')}")
    return RoadLink(kind, ox.text(element, "elementId", place), contact or None)


def _warn_unread(road: ET.Element, place: Place, warnings: Warnings) -> None:
    """Names what the standard allows on a road and this importer leaves out."""
    for path in ("superelevation", "crossfall", "shape"):
        for e in road.findall(f"lateralProfile/{path}"):
            if any(ox.number(e, c, place, 0.0) for c in "abcd"):
                warnings.add(f"{path} is not read: roads are flat across", place)
                break
    for path, what in (
        ("lateralProfile/crossSectionSurface", "cross section surface"),
        ("surface/CRG", "surface (CRG)"),
        ("railroad/switch", "railroad"),
        ("objects/bridge", "bridge"),
        ("objects/tunnel", "tunnel"),
        ("signals/signal/dependency", "dependency between signals"),
    ):
        if road.find(path) is not None:
            warnings.add(f"{what} is not read", place)


def read_road(element: ET.Element, file: Place, warnings: Warnings) -> RoadSpec:
    """Reads one <road>.

    Raises:
      MapError: with the road, and the section and lane where it has come to one.
    """
    road_id = ox.text(element, "id", file.at("road", "?"))
    place = file.at("road", road_id)
    total = ox.length(element, "length", place)
    if total > ROAD_MAX:
        raise place.error(f"is {total:g} m long; the longest road read is {ROAD_MAX:g} m")
    rule = element.get("rule", "RHT")
    if rule not in ("RHT", "LHT"):
        raise place.error(f"has rule {ox.shown(rule)}, neither RHT nor LHT")
    junction = element.get("junction", "-1").strip()
    try:
        _warn_unread(element, place, warnings)
        types = [(ox.number(t, "s", place, 0.0), t) for t in element.findall("type")]
        return RoadSpec(
            id=road_id,
            length=total,
            junction=None if junction in ("-1", "") else junction,
            left_hand=rule == "LHT",
            predecessor=_link(element, "predecessor", place, warnings),
            successor=_link(element, "successor", place, warnings),
            line=_reference_line(element, total, place, warnings),
            elevation=cubics(
                element.findall("elevationProfile/elevation"), "s", 0.0, place, warnings
            ),
            lane_offset=cubics(element.findall("lanes/laneOffset"), "s", 0.0, place, warnings),
            sections=_sections(element, total, place, warnings),
            speed=_speeds([(s, e) for s, t in types for e in t.findall("speed")], place, warnings),
            element=element,
            place=place,
        )
    except (FloatingPointError, OverflowError) as e:
        raise MapError(f"{place}: {e}") from None
