"""Reads OpenDRIVE 1.4 to 1.8: the one way every town comes in.

    network = opendrive.load("Town01.xodr")

`reference_line` has the geometry, `opendrive_roads` the file's records, `opendrive_lanes` samples
them, `opendrive_links` joins the lanes, `opendrive_signals` and `opendrive_objects` read what
stands on the road. Source: ASAM OpenDRIVE 1.8; where it leaves a choice, CARLA 0.9.16, whose towns
these mostly are.
"""

from __future__ import annotations

import os
import pathlib
import xml.etree.ElementTree as ET

import numpy as np

from carljax.sim import opendrive_lanes, opendrive_links, opendrive_objects, opendrive_signals
from carljax.sim import opendrive_xml as ox
from carljax.sim.opendrive_roads import DRIVING, RoadSpec, read_road
from carljax.sim.opendrive_xml import Place, Warnings
from carljax.sim.road_network import Controller, Lane, RoadMark, RoadNetwork, Signal

# All roads of a file together, m: enough for a country's motorways, too little to fill the memory.
TOTAL_MAX = 2_000_000.0


def _roads(root: ET.Element, file: Place, warnings: Warnings) -> dict[str, RoadSpec]:
    roads: dict[str, RoadSpec] = {}
    for element in root.findall("road"):
        road = read_road(element, file, warnings)
        if road.id in roads:
            raise road.place.error("is there twice")
        roads[road.id] = road
    if not roads:
        raise file.error("has no roads")
    if sum(r.length for r in roads.values()) > TOTAL_MAX:
        raise file.error(f"has more than {TOTAL_MAX:g} m of roads")
    if len({r.left_hand for r in roads.values()}) > 1:
        warnings.add("roads with left- and right-hand traffic in one file", file)
    return roads


def _junctions(
    root: ET.Element, file: Place, warnings: Warnings
) -> dict[str, opendrive_links.JunctionSpec]:
    out: dict[str, opendrive_links.JunctionSpec] = {}
    for element in root.findall("junction"):
        junction = opendrive_links.read_junction(element, file, warnings)
        if junction.id in out:
            raise file.at("junction", junction.id).error("is there twice")
        out[junction.id] = junction
    return out


def _check_controllers(
    controllers: dict[str, Controller],
    junctions: dict[str, opendrive_links.JunctionSpec],
    signals: list[Signal],
    file: Place,
    warnings: Warnings,
) -> None:
    known = {signal.id for signal in signals}
    for controller in controllers.values():
        if any(name not in known for name in controller.signals):
            warnings.add(
                "controller of a signal that is not there", file.at("controller", controller.id)
            )
    for junction in junctions.values():
        if any(name not in controllers for name in junction.controllers):
            warnings.add("junction's controller is not there", file.at("junction", junction.id))


def _warn_unread(root: ET.Element, file: Place, warnings: Warnings) -> None:
    """Names what the standard allows in a file, outside its roads, and this importer leaves out."""
    if root.find(".//include") is not None:
        warnings.add("<include> of another file is not read", file)
    if root.find("station") is not None:
        warnings.add("station is not read", file)
    offset = root.find("header/offset")
    if offset is not None and any(ox.number(offset, a, file, 0.0) for a in ("x", "y", "z", "hdg")):
        warnings.add("header offset is not applied: coordinates stay as in the file", file)


def load(path: str | os.PathLike[str]) -> RoadNetwork:
    """Reads an OpenDRIVE file.

    Args:
      path: the `.xodr` file.

    Returns:
      Its lanes, links, marks, signals and objects; what was not read is in `warnings`.

    Raises:
      MapError: one line that names the file, the road and lane where there is one, and what is
        wrong.
    """
    path = pathlib.Path(path)
    file, warnings = Place(str(path)), Warnings()
    root = ox.parse(path, file)
    with np.errstate(over="ignore", invalid="ignore"):  # infinities are found and named below
        roads = _roads(root, file, warnings)
        junctions = _junctions(root, file, warnings)
        opendrive_links.check_ids(roads, junctions, file, warnings)
        lanes: list[Lane] = []
        marks: list[RoadMark] = []
        for road in roads.values():
            road_lanes, road_marks = opendrive_lanes.sample_road(road, warnings)
            lanes += road_lanes
            marks += road_marks
        for road in roads.values():
            opendrive_objects.warn_unread(road, warnings)
        _warn_unread(root, file, warnings)
    if not any(lane.kind == DRIVING for lane in lanes):
        raise file.error("has no lane of type 'driving'")
    lanes = opendrive_links.LaneGraph(roads, junctions, lanes, warnings).links()
    header = root.find("header")
    vendor = header.get("vendor", "") if header is not None else ""
    signals = opendrive_signals.SignalReader(roads, lanes, warnings).read(vendor)
    controllers = opendrive_signals.read_controllers(root, file)
    _check_controllers(controllers, junctions, signals, file, warnings)
    stop_lines = [
        x for road in roads.values() for x in opendrive_objects.stop_lines(road, warnings)
    ]
    walks = [x for road in roads.values() for x in opendrive_objects.crosswalks(road, warnings)]
    return RoadNetwork(
        name=path.stem,
        left_hand_traffic=next(iter(roads.values())).left_hand,
        lanes=tuple(lanes),
        marks=tuple(marks),
        signals=tuple(signals),
        controllers=controllers,
        junctions={k: opendrive_links.junction_of(v, lanes) for k, v in junctions.items()},
        crosswalks=tuple(walks),
        stop_lines=tuple(stop_lines + opendrive_signals.stop_line_signals(signals, lanes)),
        warnings=warnings.lines(),
    )
