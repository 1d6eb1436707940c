"""The lane graph of an OpenDRIVE file: successors through sections, roads, junctions; neighbours.

Source: ASAM OpenDRIVE 1.8, sections 10.3 (road linkage), 11.6 (lane linkage) and 12 (junctions).
"""

from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ET

import numpy as np

from carljax.sim import opendrive_xml as ox
from carljax.sim.opendrive_roads import DRIVING, LaneSpec, RoadLink, RoadSpec, SectionSpec
from carljax.sim.opendrive_xml import Place, Warnings
from carljax.sim.road_network import Junction, Lane

# Lane ends this far apart still meet where the file contradicts itself about the contact point, m.
_MEET = 1.5


@dataclasses.dataclass(frozen=True)
class Connection:
    """One way through a junction: from lanes of `incoming` to `connecting`, at its end `contact`.

    `lane_links` is None where the file leaves them out: lanes of equal ids are joined then.
    """

    incoming: str
    connecting: str
    contact: str | None
    lane_links: tuple[tuple[int, int], ...] | None


@dataclasses.dataclass(frozen=True)
class JunctionSpec:
    """A junction as written."""

    id: str
    connections: tuple[Connection, ...]
    controllers: tuple[str, ...]
    priority: tuple[tuple[str, str], ...]


def _connection(element: ET.Element, place: Place) -> Connection:
    target = "connectingRoad" if element.get("connectingRoad") is not None else "linkedRoad"
    links = tuple(
        (ox.lane_number(e, "from", place), ox.lane_number(e, "to", place))
        for e in element.findall("laneLink")
    )
    contact = element.get("contactPoint") or None
    if contact not in (None, "start", "end"):
        raise place.error(f"has contactPoint {ox.shown(contact or '')}")
    return Connection(
        ox.text(element, "incomingRoad", place),
        ox.text(element, target, place),
        contact,
        links if links or element.find("laneLink") is not None else None,
    )


def read_junction(element: ET.Element, file: Place, warnings: Warnings) -> JunctionSpec:
    """Reads one <junction>."""
    junction_id = ox.text(element, "id", file.at("junction", "?"))
    place = file.at("junction", junction_id)
    kind = element.get("type", "default")
    connections = []
    if kind in ("virtual", "crossing"):
        warnings.add(f"{kind} junction is not read", place)
    else:
        for e in element.findall("connection"):
            here = place.at("connection", e.get("id", "?"))
            if e.get("type") == "virtual":
                warnings.add("virtual connection is not read", here)
            else:
                way = _connection(e, here)
                connections.append(way)
                if kind == "direct":  # two roads that touch: the links hold in both directions
                    back = tuple((b, a) for a, b in way.lane_links or ())
                    connections.append(Connection(way.connecting, way.incoming, None, back))
    controllers = [
        (ox.number(e, "sequence", place, 0.0), ox.text(e, "id", place))
        for e in element.findall("controller")
    ]
    priority = tuple(
        (e.get("high", "").strip(), e.get("low", "").strip()) for e in element.findall("priority")
    )
    return JunctionSpec(
        junction_id,
        tuple(connections),
        tuple(name for _, name in sorted(controllers, key=lambda c: c[0])),
        tuple(pair for pair in priority if all(pair)),
    )


class LaneGraph:
    """Looks lanes up and follows links. Built once per file, thrown away after `links`."""

    def __init__(
        self,
        roads: dict[str, RoadSpec],
        junctions: dict[str, JunctionSpec],
        lanes: list[Lane],
        warnings: Warnings,
    ) -> None:
        """Indexes lanes by (road, section, lane) and connections by (junction, incoming road)."""
        self.roads, self.junctions, self.lanes, self.warnings = roads, junctions, lanes, warnings
        self.index = {(x.road_id, x.section, x.lane_id): i for i, x in enumerate(lanes)}
        self.ways: dict[tuple[str, str], list[Connection]] = {}
        for junction in junctions.values():
            for way in junction.connections:
                self.ways.setdefault((junction.id, way.incoming), []).append(way)

    def _entered_at(self, road: RoadSpec, lane: LaneSpec) -> str:
        return "start" if road.travels_along(lane) else "end"

    def _driving(self, road: RoadSpec, section: SectionSpec, lane_id: int) -> bool:
        return lane_id in section.lanes and section.lanes[lane_id].kind == DRIVING

    def _gap(self, source: int, target: int) -> float:
        a, b = self.lanes[source].xyz[-1], self.lanes[target].xyz[0]
        return float(np.hypot(a[0] - b[0], a[1] - b[1]))

    def _enter(
        self, source: int, road: RoadSpec, contact: str | None, lane_id: int, place: Place
    ) -> int | None:
        """The driving lane of another road that a link leads to, or None if it leads nowhere.

        A link is followed to the lane's beginning. Where the file's contact point is the lane's end
        (or is missing) the link holds only if the lanes really meet at that beginning.
        """
        found = None
        for end, section in (("start", road.sections[0]), ("end", road.sections[-1])):
            lane = section.lanes.get(lane_id)
            if lane is None or not lane_id or self._entered_at(road, lane) != end:
                continue
            found = self.index[road.id, section.index, lane_id]
            if contact != end and (contact or self._gap(source, found) > _MEET):
                if self._gap(source, found) > _MEET:
                    self.warnings.add("link to the far end of a lane is not followed", place)
                    return None
                self.warnings.add("contact point names the wrong end: put right", place)
        if found is None:
            if not any(lane_id in section.lanes for section in road.sections):
                raise place.error(
                    f"is linked to lane {lane_id} of road {ox.plain(road.id)}, which has none"
                )
            self.warnings.add("link to a lane that does not begin there is not followed", place)
            return None
        return found if self.lanes[found].kind == DRIVING else None

    def _through_junction(
        self, source: int, road: RoadSpec, lane: LaneSpec, junction_id: str, place: Place
    ) -> list[int | None]:
        out = []
        for way in self.ways.get((junction_id, road.id), []):
            target = self.roads[way.connecting]
            links = way.lane_links
            if links is None:
                known = any(lane.id in section.lanes for section in target.sections)
                links = ((lane.id, lane.id),) if known else ()
            for from_id, to_id in links:
                if from_id == lane.id:
                    out.append(self._enter(source, target, way.contact, to_id, place))
        return out

    def _next(
        self, source: int, road: RoadSpec, section: SectionSpec, lane: LaneSpec
    ) -> list[int | None]:
        """Where the links at the lane's end lead, None for those that lead nowhere."""
        along = road.travels_along(lane)
        place = road.place.at("section", section.index).at("lane", lane.id)
        ids = lane.successors if along else lane.predecessors
        beyond = section.index + (1 if along else -1)
        if 0 <= beyond < len(road.sections):
            return [self._within(road, road.sections[beyond], lane, i, place) for i in ids]
        link = road.successor if along else road.predecessor
        if link is None:
            return []
        if link.kind == "junction":
            return self._through_junction(source, road, lane, link.id, place)
        return [self._enter(source, self.roads[link.id], link.contact, i, place) for i in ids]

    def _within(
        self, road: RoadSpec, section: SectionSpec, lane: LaneSpec, lane_id: int, place: Place
    ) -> int | None:
        target = section.lanes.get(lane_id) if lane_id else None
        if target is None or road.travels_along(target) != road.travels_along(lane):
            self.warnings.add("link to a lane that is not there or comes the other way", place)
            return None
        return self.index[road.id, section.index, lane_id] if target.kind == DRIVING else None

    def links(self) -> list[Lane]:
        """The lanes with successors, predecessors and neighbours filled in."""
        ahead: list[tuple[int, ...]] = []
        behind: list[list[int]] = [[] for _ in self.lanes]
        for i, lane in enumerate(self.lanes):
            found: tuple[int, ...] = ()
            if lane.kind == DRIVING:
                road = self.roads[lane.road_id]
                section = road.sections[lane.section]
                spec = section.lanes[lane.lane_id]
                targets = self._next(i, road, section, spec)
                found = tuple(dict.fromkeys(t for t in targets if t is not None))
                if any(self._gap(i, t) > _MEET for t in found):
                    place = road.place.at("section", section.index).at("lane", spec.id)
                    self.warnings.add("linked lanes do not meet (gap over 1.5 m)", place)
            ahead.append(found)
            for target in found:
                behind[target].append(i)
        return [
            dataclasses.replace(
                lane, successors=ahead[i], predecessors=tuple(behind[i]), **self._neighbours(lane)
            )
            for i, lane in enumerate(self.lanes)
        ]

    def _neighbours(self, lane: Lane) -> dict:
        """The fields left, right, left_is_same_direction, right_is_same_direction."""
        if lane.kind != DRIVING:
            return {}
        road = self.roads[lane.road_id]
        section = road.sections[lane.section]
        order = sorted((i for i in section.lanes if i), reverse=True)  # left to right along s
        at = order.index(lane.lane_id)
        along = road.travels_along(section.lanes[lane.lane_id])
        out: dict = {}
        for side, step in (("left", -1), ("right", 1)):
            other = at + (step if along else -step)
            if 0 <= other < len(order) and self._driving(road, section, order[other]):
                out[side] = self.index[road.id, section.index, order[other]]
                same = road.travels_along(section.lanes[order[other]]) == along
                out[f"{side}_is_same_direction"] = same
        return out


def _check_link(
    road: RoadSpec,
    link: RoadLink | None,
    what: str,
    known: dict[str, frozenset[str]],
    warnings: Warnings,
) -> None:
    if link is None or link.id in known[link.kind]:
        return
    if link.kind == "junction":  # maps cut out of larger ones end so, and CARLA reads them
        warnings.add(
            "road leads to a junction that the file does not have: it ends there", road.place
        )
        return
    raise road.place.error(f"{what} is road {ox.plain(link.id)}, which the file does not have")


def check_ids(
    roads: dict[str, RoadSpec], junctions: dict[str, JunctionSpec], file: Place, warnings: Warnings
) -> None:
    """Every road and junction named in a link must be in the file.

    Raises:
      MapError: names the first that is not.
    """
    known = {"road": frozenset(roads), "junction": frozenset(junctions)}
    for road in roads.values():
        _check_link(road, road.predecessor, "predecessor", known, warnings)
        _check_link(road, road.successor, "successor", known, warnings)
        if road.junction is not None and road.junction not in junctions:
            raise road.place.error(
                f"belongs to junction {ox.plain(road.junction)}, which the file does not have"
            )
    for junction in junctions.values():
        place = file.at("junction", junction.id)
        for way in junction.connections:
            for road_id in (way.incoming, way.connecting):
                if road_id not in roads:
                    raise place.error(
                        f"connects road {ox.plain(road_id)}, which the file does not have"
                    )
        if any(name not in roads for pair in junction.priority for name in pair):
            warnings.add("priority of a road that the file does not have", place)


def junction_of(spec: JunctionSpec, lanes: list[Lane]) -> Junction:
    """The junction with its driving lanes."""
    members = tuple(i for i, x in enumerate(lanes) if x.junction == spec.id and x.kind == DRIVING)
    return Junction(spec.id, spec.controllers, members, spec.priority)
