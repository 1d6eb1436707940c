"""Painted objects of OpenDRIVE roads: crosswalks and stop lines.

Source: ASAM OpenDRIVE 1.8, section 13 (objects, outlines, corners).
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET

import numpy as np

from carljax.sim import opendrive_xml as ox
from carljax.sim.opendrive_roads import RoadSpec
from carljax.sim.opendrive_signals import is_speed_object, pose
from carljax.sim.opendrive_xml import Place, Warnings

# Corners closer than this are one, m.
_SAME = 1e-3
# Stop lines have the width 0 in CARLA's towns; the shortest segment that is a line, m.
_LINE_MIN = 0.1


def _rotation(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """(3, 3) rotation from the object's frame (u, v, z) to the world: roll, pitch, then yaw."""
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    cr, sr = math.cos(roll), math.sin(roll)
    about_z = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    return about_z @ about_y @ about_x


def _frame(element: ET.Element, road: RoadSpec, place: Place) -> tuple[np.ndarray, np.ndarray]:
    """Origin (3,) and rotation (3, 3) of an object.

    t counts from the reference line; CARLA adds the lane offset, which puts them off the road.
    """
    s, t = (ox.number(element, a, place) for a in ("s", "t"))
    z, hdg, pitch, roll = (
        ox.number(element, a, place, 0.0) for a in ("zOffset", "hdg", "pitch", "roll")
    )
    origin, yaw = pose(road, min(max(s, 0.0), road.length), t, z)
    return origin, _rotation(yaw + hdg, pitch, roll)


def _open(polygon: np.ndarray) -> np.ndarray:
    """Without corners that the next one repeats, a closing one included."""
    keep = np.linalg.norm(polygon - np.roll(polygon, -1, axis=0), axis=1) > _SAME
    return polygon[keep]


def _outline(outline: ET.Element, element: ET.Element, road: RoadSpec, place: Place) -> np.ndarray:
    """(P, 3) corners of an outline in the world, not closed."""
    origin, turn = _frame(element, road, place)
    corners = []
    for corner in outline:
        if corner.tag == "cornerLocal":
            uvz = [ox.number(corner, "u", place), ox.number(corner, "v", place)]
            corners.append(origin + turn @ np.array([*uvz, ox.number(corner, "z", place, 0.0)]))
        elif corner.tag == "cornerRoad":
            s, t = ox.number(corner, "s", place), ox.number(corner, "t", place)
            z = ox.number(corner, "dz", place, 0.0)
            corners.append(pose(road, min(max(s, 0.0), road.length), t, z)[0])
    return _open(np.array(corners)) if corners else np.zeros((0, 3))


def _box(element: ET.Element, road: RoadSpec, place: Place) -> np.ndarray:
    """(4, 3) corners of an object given by length and width alone."""
    u, v = (ox.length(element, a, place, 0.0) / 2 for a in ("length", "width"))
    origin, turn = _frame(element, road, place)
    corners = np.array([[u, v, 0.0], [-u, v, 0.0], [-u, -v, 0.0], [u, -v, 0.0]])
    return _open(origin + corners @ turn.T)


def warn_unread(road: RoadSpec, warnings: Warnings) -> None:
    """Counts the objects that mean nothing to this importer: poles, painted arrows, trees, ..."""
    for element in road.element.findall("objects/object"):
        name = element.get("name", "")
        is_read = element.get("type") == "crosswalk" or name.startswith("StopLine")
        if not is_read and not is_speed_object(element):
            place = road.place.at("object", element.get("id", "?"))
            warnings.add("object that is no crosswalk, stop line or Speed_NN: not read", place)


def _is_area(outline: ET.Element) -> bool:
    """Whether a crosswalk's outline encloses an area.

    In OpenDRIVE 1.4 every outline does. Since 1.5 (<outlines>) it can also be a line:
    closed="true", a fill or a repeated first corner make it an area. CARLA 0.9.16 reads none of the
    later kind.
    """
    if outline.get("closed") is not None:
        return outline.get("closed") in ("true", "1")
    corners = [c for c in outline if c.tag.startswith("corner")]
    places = [tuple(c.get(key) for key in "uvst") for c in corners]
    return outline.get("fillType") is not None or (len(places) > 2 and places[0] == places[-1])


def crosswalks(road: RoadSpec, warnings: Warnings) -> list[np.ndarray]:
    """Polygons (P, 3) of the road's crosswalks, not closed."""
    out = []
    for element in road.element.findall("objects/object"):
        if element.get("type") != "crosswalk":
            continue
        place = road.place.at("object", element.get("id", "?"))
        if element.find("repeat") is not None:
            warnings.add("repeat of a crosswalk is not read", place)
        simple, later = element.findall("outline"), element.findall("outlines/outline")
        areas = simple + [o for o in later if _is_area(o)]
        if len(areas) < len(simple) + len(later):
            warnings.add('crosswalk outline that is not closed="true": left out', place)
        areas = [o for o in areas if o.get("outer", "true") != "false"]
        polygons = [_outline(o, element, road, place) for o in areas]
        if not simple and not later:
            polygons = [_box(element, road, place)]
        good = [p for p in polygons if len(p) >= 3]
        if len(good) < len(polygons):
            warnings.add("crosswalk with fewer than three corners: left out", place)
        out += good
    return out


def stop_lines(road: RoadSpec, warnings: Warnings) -> list[np.ndarray]:
    """Segments (2, 3) of the road's objects named StopLine*, along their longer side."""
    out = []
    for element in road.element.findall("objects/object"):
        if not element.get("name", "").startswith("StopLine"):
            continue
        place = road.place.at("object", element.get("id", "?"))
        length, width = (ox.length(element, a, place, 0.0) for a in ("length", "width"))
        if max(length, width) < _LINE_MIN:
            warnings.add("stop line without length: left out", place)
            continue
        origin, turn = _frame(element, road, place)
        half = turn[:, 0] * length / 2 if length >= width else turn[:, 1] * width / 2
        out.append(np.stack([origin + half, origin - half]))
    return out
