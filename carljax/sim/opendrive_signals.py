"""Signals, controllers and objects of OpenDRIVE roads: lights, signs, crosswalks, stop lines.

Source: ASAM OpenDRIVE 1.8, sections 13 (objects) and 14 (signals); type codes as CARLA uses them.
"""

from __future__ import annotations

import dataclasses
import math
import re
import xml.etree.ElementTree as ET

import numpy as np

from carljax.sim import opendrive_xml as ox
from carljax.sim import reference_line as rl
from carljax.sim.opendrive_roads import DRIVING, LaneSpec, RoadSpec, SectionSpec
from carljax.sim.opendrive_xml import Place, Warnings
from carljax.sim.road_network import Controller, Governed, Lane, Signal

# source: OpenDRIVE 1.8 annex "signal types" (country OpenDRIVE): lights for cars. 1000002 and
# 1000007 are for pedestrians and cyclists.
LIGHT_TYPES = frozenset({"1000001", "1000008", "1000009", "1000010", "1000011", "1000012"})
# source: CARLA 0.9.16; the numbers are those of the German road traffic regulations (StVO).
SIGN_KINDS = {"206": "stop", "205": "yield", "274": "speed"}
STOP_LINE_TYPES = frozenset({"294"})
# source: CARLA 0.9.16 reads objects whose names begin so as speed limits, and uses them as km/h.
_SPEED_OBJECT = re.compile(r"[Ss]peed_\s*(\d+(?:\.\d+)?)")


@dataclasses.dataclass(frozen=True)
class Spot:
    """A signal or reference on a road: where, for which direction and which lanes."""

    road: RoadSpec
    s: float
    orientation: str
    validity: tuple[tuple[int, int], ...]

    def lane_ids(self) -> frozenset[int] | None:
        """Lanes named by validity; None: no validity, all of the direction."""
        if not self.validity:
            return None
        section = section_at(self.road, self.s)
        return frozenset(i for a, b in self.validity for i in section.lanes if a <= i <= b and i)


def is_speed_object(element: ET.Element) -> bool:
    """Whether an <object> is one of CARLA's speed signs."""
    return _SPEED_OBJECT.match(element.get("name", "")) is not None


def section_at(road: RoadSpec, s: float) -> SectionSpec:
    """The section that holds s."""
    out = road.sections[0]
    for section in road.sections:
        if section.s0 <= s:
            out = section
    return out


def _spot(element: ET.Element, road: RoadSpec, place: Place, warnings: Warnings) -> Spot:
    s = ox.number(element, "s", place)
    if not -0.01 <= s <= road.length + 0.01:
        warnings.add(f"<{element.tag}> off its road's ends: moved to the end", place)
    validity = []
    for e in element.findall("validity"):
        a, b = ox.lane_number(e, "fromLane", place), ox.lane_number(e, "toLane", place)
        validity.append((min(a, b), max(a, b)))
    return Spot(
        road,
        float(np.clip(s, 0.0, road.length)),
        element.get("orientation", "none"),
        tuple(validity),
    )


def pose(road: RoadSpec, s: float, t: float, z_offset: float) -> tuple[np.ndarray, float]:
    """World position (3,) and heading of the reference line at (s, t)."""
    at = np.array([s])
    xy, yaw, _ = rl.evaluate(road.line, at, at)
    z = road.elevation.at(at, at)[0][0] + z_offset
    h = float(yaw[0])
    return np.array([xy[0, 0] - t * math.sin(h), xy[0, 1] + t * math.cos(h), z]), h


class SignalReader:
    """Collects signals and their references over all roads, then says which lanes they rule."""

    def __init__(self, roads: dict[str, RoadSpec], lanes: list[Lane], warnings: Warnings) -> None:
        """Indexes the lanes; `vendor_reversed` is decided by `read`."""
        self.roads, self.lanes, self.warnings = roads, lanes, warnings
        self.index = {(x.road_id, x.section, x.lane_id): i for i, x in enumerate(lanes)}
        self.reversed = False

    def read(self, vendor: str) -> list[Signal]:
        """All signals of the file.

        Args:
          vendor: header@vendor. RoadRunner up to 2020 ("VectorZero"), with which CARLA's towns were
            made, writes orientation the other way round: "-" for traffic along s. What the file's
            own validities say counts more.

        Raises:
          MapError: a reference to a signal that is not there.
        """
        found = [x for road in self.roads.values() for x in self._own(road)]
        known = {e.get("id", "").strip() for e, _, _ in found}
        if len(known) < len(found):
            self.warnings.add("signals share an id", found[0][2])
        references = self._references(known)
        every = [spot for _, spot, _ in found] + [x for s in references.values() for x in s]
        self.reversed = _writes_orientation_reversed(every, vendor)
        signals = [
            self._signal(e, own, references.get(e.get("id", "").strip(), []), place)
            for e, own, place in found
        ]
        return [signal for signal in signals if signal is not None]

    def _own(self, road: RoadSpec) -> list[tuple[ET.Element, Spot, Place]]:
        """The signals that stand on a road, CARLA's speed objects among them."""
        elements = road.element.findall("signals/signal")
        elements += [e for e in road.element.findall("objects/object") if is_speed_object(e)]
        out = []
        for e in elements:
            place = road.place.at(e.tag, e.get("id", "?"))
            ox.text(e, "id", place)
            out.append((e, _spot(e, road, place, self.warnings), place))
        return out

    def _references(self, known: set[str]) -> dict[str, list[Spot]]:
        """Signal id -> the further places where it holds."""
        out: dict[str, list[Spot]] = {}
        for road in self.roads.values():
            for e in road.element.findall("signals/signalReference"):
                name = ox.text(e, "id", road.place.at("signalReference", "?"))
                place = road.place.at("signalReference", name)
                if name not in known:
                    raise place.error("refers to a signal that the file does not have")
                out.setdefault(name, []).append(_spot(e, road, place, self.warnings))
        return out

    def _signal(
        self, element: ET.Element, own: Spot, references: list[Spot], place: Place
    ) -> Signal | None:
        if all(spot.validity and set(spot.validity) == {(0, 0)} for spot in [own, *references]):
            self.warnings.add("signal valid for lane 0 alone, so for no lane: left out", place)
            return None
        name = element.get("name", "")
        named = _SPEED_OBJECT.match(name) if element.tag == "object" else None
        code = "274" if named else element.get("type", "").strip()
        is_light = code in LIGHT_TYPES and element.get("dynamic", "yes") != "no"
        kind = "light" if is_light else SIGN_KINDS.get(code.partition(".")[0], "other")
        value = None
        if kind == "speed":
            value = float(named[1]) / 3.6 if named else self._limit(element, place)
        governed = tuple(
            dict.fromkeys(g for spot in [own, *references] for g in self._governed(spot))
        )
        t, z = (ox.number(element, a, place, 0.0) for a in ("t", "zOffset"))
        xyz, yaw = pose(own.road, own.s, t, z)
        if governed:
            first = governed[0]
            lane = self.lanes[first.lane]
            yaw = float(np.interp(first.distance, lane_distance(lane), np.unwrap(lane.yaw)))
        elif self._along(own) is False:
            yaw += math.pi
        yaw = (yaw + math.pi) % (2 * math.pi) - math.pi
        return Signal(element.get("id", "").strip(), kind, code, name, xyz, yaw, value, governed)

    def _limit(self, element: ET.Element, place: Place) -> float | None:
        """The limit on a sign 274, m/s: value and unit, else the subtype; km/h without unit."""
        unit = element.get("unit") or "km/h"
        value = ox.speed(element.get("value"), unit, place, self.warnings)
        subtype = element.get("subtype", "")
        if value is None and subtype.isdecimal():
            value = ox.speed(subtype, "km/h", place, self.warnings)
        return value

    def _along(self, spot: Spot) -> bool | None:
        """Whether the spot rules traffic along s; None: both ways."""
        if spot.orientation not in ("+", "-"):
            return None
        return (spot.orientation == "+") != self.reversed

    def _governed(self, spot: Spot) -> list[Governed]:
        """The driving lanes at the spot, by validity and orientation.

        Where the two exclude each other validity, the finer statement, holds.
        """
        section = section_at(spot.road, spot.s)
        lanes = [x for x in section.lanes.values() if x.kind == DRIVING and x.id]
        ids = spot.lane_ids()
        valid = [x for x in lanes if ids is None or x.id in ids]
        along = self._along(spot)
        ruled = [x for x in valid if along is None or spot.road.travels_along(x) == along]
        return [self._place_on(spot, section, x) for x in ruled or (valid if ids else [])]

    def _place_on(self, spot: Spot, section: SectionSpec, spec: LaneSpec) -> Governed:
        i = self.index[spot.road.id, section.index, spec.id]
        lane = self.lanes[i]
        distance = lane_distance(lane)
        s = lane.s if lane.s[-1] >= lane.s[0] else -lane.s
        at = spot.s if lane.s[-1] >= lane.s[0] else -spot.s
        return Governed(i, float(np.interp(at, s, distance)))


def lane_distance(lane: Lane) -> np.ndarray:
    """(P,) arc length from the lane's first point, m, flat as seen from above."""
    step = np.hypot(*np.diff(lane.xyz[:, :2], axis=0).T)
    return np.concatenate([[0.0], np.cumsum(step)])


def _writes_orientation_reversed(spots: list[Spot], vendor: str) -> bool:
    """Whether the file's validities, where they name one direction, contradict its orientations."""
    votes = 0
    for spot in spots:
        ids = spot.lane_ids()
        if not ids or spot.orientation not in ("+", "-"):
            continue
        ways = {spot.road.travels_along(section_at(spot.road, spot.s).lanes[i]) for i in ids}
        if len(ways) == 1:
            votes += 1 if ways == {spot.orientation == "-"} else -1
    return votes > 0 or (votes == 0 and vendor == "VectorZero")


def read_controllers(root: ET.Element, file: Place) -> dict[str, Controller]:
    """All controllers by id."""
    out: dict[str, Controller] = {}
    for element in root.findall("controller"):
        name = ox.text(element, "id", file.at("controller", "?"))
        place = file.at("controller", name)
        if name in out:
            raise place.error("is there twice")
        signals = [ox.text(e, "signalId", place) for e in element.findall("control")]
        sequence = int(ox.number(element, "sequence", place, 0.0))
        out[name] = Controller(name, sequence, tuple(dict.fromkeys(signals)))
    return out


def stop_line_signals(signals: list[Signal], lanes: list[Lane]) -> list[np.ndarray]:
    """The stop lines that stand as signals (294), one segment (2, 3) per lane ruled."""
    out = []
    for signal in signals:
        for g in signal.governed if signal.type in STOP_LINE_TYPES else ():
            lane = lanes[g.lane]
            distance = lane_distance(lane)
            centre = np.array([np.interp(g.distance, distance, x) for x in lane.xyz.T])
            half = np.interp(g.distance, distance, lane.width) / 2
            yaw = np.interp(g.distance, distance, np.unwrap(lane.yaw))
            across = half * np.array([-np.sin(yaw), np.cos(yaw), 0.0])
            out.append(np.stack([centre + across, centre - across]))
    return out
