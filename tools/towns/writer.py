"""A planned town as an OpenDRIVE file, through the classes of scenariogeneration."""

from __future__ import annotations

import xml.etree.ElementTree as ET

from scenariogeneration import xodr

from towns import geometry, signs
from towns.plan import Junction, Mark, Road, Section, Town

REVISION = ("1", "6")
# Plain metres around a point of no meaning: readers that want a projection get one.
GEO_REFERENCE = "+proj=tmerc +lat_0=0 +lon_0=0 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs"
# Decimals in the file: 1 um for places, and as much for all that is multiplied by up to 500 m.
DECIMALS = 6
FINE = {"hdg": 10, "curvature": 10, "curvStart": 10, "curvEnd": 10, "b": 10, "c": 12, "d": 15}
VERBATIM = {"name", "date", "vendor", "type", "rule", "id"}
CONTACTS = {"start": xodr.ContactPoint.start, "end": xodr.ContactPoint.end}
ELEMENTS = {"road": xodr.ElementType.road, "junction": xodr.ElementType.junction}
ORIENTATIONS = {"+": xodr.Orientation.positive, "-": xodr.Orientation.negative}


def to_text(town: Town) -> str:
    """The file's text, the same on every call: no date, numbers rounded."""
    drive = xodr.OpenDrive(town.name, *REVISION, GEO_REFERENCE)
    for road in town.roads:
        drive.add_road(_road(road))
    for junction in town.junctions:
        drive.add_junction(_junction(junction))
    root = drive.get_element()
    _controllers(root, town)
    header = root.find("header")
    assert header is not None
    header.attrib.update(date="2025-01-01T00:00:00", vendor="carljax", **_bounds(town))
    for parent in list(root.iter()):
        _tidy(parent)
    ET.indent(root, " ")
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _bounds(town: Town) -> dict[str, str]:
    points = [piece.start for road in town.roads for piece in road.path]
    xs, ys = [p.x for p in points], [p.y for p in points]
    return {
        key: str(value)
        for key, value in zip(
            ("north", "south", "east", "west"), (max(ys), min(ys), max(xs), min(xs)), strict=True
        )
    }


def _road(road: Road) -> xodr.Road:
    view = xodr.PlanView()
    for piece in road.path:
        view.add_fixed_geometry(piece.element(), *piece.start)
    lanes = xodr.Lanes()
    for index, section in enumerate(road.sections):
        lanes.add_lanesection(_section(road, index, section))
    written = xodr.Road(road.id, view, lanes, -1 if road.junction is None else road.junction)
    for link, add in ((road.before, written.add_predecessor), (road.after, written.add_successor)):
        if link:
            contact = CONTACTS[link[2]] if link[2] else None
            add(ELEMENTS[link[0]], link[1], contact)
    written.add_type(xodr.RoadType[road.kind], 0, speed=road.speed, speed_unit="km/h")
    for record in road.heights:
        written.add_elevation(*record)
    # Straight into the lists: the adders rename ids that another town in this process has used.
    written.signals += [_signal(each) for each in road.signals]
    written.signals += [_reference(each) for each in road.references]
    written.objects += [_object(each) for each in road.objects]
    return written


def _section(road: Road, index: int, section: Section) -> xodr.LaneSection:
    centre = xodr.Lane(xodr.LaneType.none)
    _add_mark(centre, section.centre)
    written = xodr.LaneSection(section.s, centre)
    for sign, specs in ((1, section.left), (-1, section.right)):
        for number, spec in enumerate(specs, start=1):
            s, a, b, c, d = spec.widths[0]
            lane = xodr.Lane(xodr.LaneType[spec.kind], a, b, c, d, s)
            for s, a, b, c, d in spec.widths[1:]:
                lane.add_lane_width(a, b, c, d, s)
            before, after = road.links.get((index, sign * number), (None, None))
            if before is not None:
                lane.add_link("predecessor", before)
            if after is not None:
                lane.add_link("successor", after)
            _add_mark(lane, spec.mark)
            (written.add_left_lane if sign > 0 else written.add_right_lane)(lane)
    return written


def _add_mark(lane: xodr.Lane, mark: Mark | None) -> None:
    if mark:
        lane.add_roadmark(
            xodr.RoadMark(
                xodr.RoadMarkType[mark.kind],
                0.12,
                color=xodr.RoadMarkColor[mark.colour],
                laneChange=xodr.LaneChange[mark.change],
            )
        )


def _signal(plan: dict) -> xodr.Signal:
    value = plan.get("value")
    name = signs.NAMES[plan["type"]]
    signal = xodr.Signal(
        plan["s"],
        plan["t"],
        "OpenDRIVE",
        plan["type"],
        id=str(plan["id"]),
        name=name if value is None else f"{name}_{value:g}",
        dynamic=xodr.Dynamic.yes if plan["type"] == signs.LIGHT else xodr.Dynamic.no,
        value=value,
        unit=None if value is None else "km/h",
        zOffset=2.5,
        orientation=ORIENTATIONS[plan["orientation"]],
    )
    return signal.add_validity(*plan["validity"])


def _reference(plan: dict) -> xodr.SignalReference:
    reference = xodr.SignalReference(plan["s"], plan["t"], str(plan["id"]))
    return reference.add_validity(*plan["validity"])


def _object(plan: dict) -> xodr.Object:
    written = xodr.Object(
        plan["s"],
        plan["t"],
        xodr.ObjectType[plan["type"]],
        subtype="-1",
        id=str(plan["id"]),
        name=plan["name"],
        hdg=plan["hdg"],
        orientation=ORIENTATIONS[plan.get("orientation", "+")],
        width=plan["width"],
        length=plan["length"],
        height=0,
    )
    if "corners" in plan:
        outline = xodr.Outline()
        for u, v in [*plan["corners"], plan["corners"][0]]:
            outline.add_corner(xodr.CornerLocal(u, v, 0, 0))
        written.add_outline(outline)
    return written


def _junction(junction: Junction) -> xodr.Junction:
    written = xodr.Junction(f"junction{junction.id}", junction.id)
    for each in junction.connections:
        connection = xodr.Connection(each.arm_in.road.id, each.road.id, xodr.ContactPoint.start)
        for index, lane_id in enumerate(each.lanes_in):
            connection.add_lanelink(lane_id, -index - 1)
        written.add_connection(connection)
    return written


def _controllers(root: ET.Element, town: Town) -> None:
    """Adds what scenariogeneration has no class for: controllers and their order of service."""
    elements = {j.get("id"): j for j in root.findall("junction")}
    place = len(root.findall("road")) + 1
    for junction in town.junctions:
        for sequence, controller in enumerate(junction.controllers):
            element = ET.Element(
                "controller",
                {"id": str(controller), "name": f"ctrl{controller}", "sequence": str(sequence)},
            )
            for signal in town.controllers[controller]:
                ET.SubElement(element, "control", {"signalId": str(signal), "type": "0"})
            root.insert(place, element)
            place += 1
            ET.SubElement(
                elements[str(junction.id)],
                "controller",
                {"id": str(controller), "type": "0", "sequence": str(sequence)},
            )


def _tidy(parent: ET.Element) -> None:
    """Drops what is empty or says the default, and rounds the numbers."""
    for child in list(parent):
        if child.tag in ("lateralProfile", "elevationProfile", "link") and not len(child):
            parent.remove(child)
        elif child.tag == "outlines":
            # CARLA reads the outline as a child of its object, as OpenDRIVE 1.4 had it.
            parent.extend(list(child))
            parent.remove(child)
    for key in ("weight", "level"):
        parent.attrib.pop(key, None)
    for key, value in parent.attrib.items():
        if key not in VERBATIM:
            parent.attrib[key] = _rounded(value, FINE.get(key, DECIMALS))


def _rounded(value: str, decimals: int) -> str:
    try:
        number = float(value)
    except ValueError:
        return value
    text = (
        f"{number:.{decimals}f}".rstrip("0").rstrip(".") if "." in value or "e" in value else value
    )
    return "0" if text in ("-0", "") else text


def length_km(town: Town) -> float:
    """Lane kilometres of all driving lanes, for the report."""
    return (
        sum(
            geometry.length(road.path) * sum(lane.kind == "driving" for lane in side)
            for road in town.roads
            for side in (road.sections[0].left, road.sections[0].right)
        )
        / 1000
    )
