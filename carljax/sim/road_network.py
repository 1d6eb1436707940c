"""A town as it is read from disk: lanes, links, signals and markings, on the host.

Everything here is float64 NumPy, right-handed metres and radians, before any padding or rounding.
`opendrive.load` makes a `RoadNetwork`; `road_map.build` turns it into the arrays that live on the
device.
"""

from __future__ import annotations

import dataclasses

import numpy as np

MARK_NONE, MARK_BROKEN, MARK_SOLID = 0, 1, 2


@dataclasses.dataclass(frozen=True)
class RoadMark:
    """A painted line along one border of a lane.

    Attributes:
      xy: (P, 2) float64, the line's points in the world frame, m.
      kind: MARK_BROKEN or MARK_SOLID (lines without paint are left out).
      colour: "white", "yellow", ...
      z: (P,) float64, its heights, m; empty where everything is flat.
    """

    xy: np.ndarray
    kind: int
    colour: str
    z: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))


@dataclasses.dataclass(frozen=True)
class Lane:
    """One lane of one lane section, its points in the direction of travel.

    Attributes:
      road_id, section, lane_id: the OpenDRIVE key.
      kind: OpenDRIVE lane type: "driving", "shoulder", "parking", "sidewalk", ...
      xyz: (P, 3) float64, centre line, m.
      width: (P,) float64, m.
      s: (P,) float64, the road's own arc length at each point (falls for lanes against it), m.
      yaw: (P,) float64, direction of travel, rad.
      junction: id of the junction the lane belongs to, or None.
      speed_limit: m/s, from the lane's or the road's own speed records, or None.
      successors, predecessors: indices into `RoadNetwork.lanes`, driving lanes only.
      left, right: index of the neighbour on that side as seen in the direction of travel (driving
        lanes of the same section), or -1.
      left_is_same_direction, right_is_same_direction: whether that neighbour goes the same way.
    """

    road_id: str
    section: int
    lane_id: int
    kind: str
    xyz: np.ndarray
    width: np.ndarray
    s: np.ndarray
    yaw: np.ndarray
    junction: str | None
    speed_limit: float | None
    successors: tuple[int, ...] = ()
    predecessors: tuple[int, ...] = ()
    left: int = -1
    right: int = -1
    left_is_same_direction: bool = False
    right_is_same_direction: bool = False


@dataclasses.dataclass(frozen=True)
class Governed:
    """A place on a driving lane where a signal holds.

    Attributes:
      lane: index into `RoadNetwork.lanes`.
      distance: arc length from the lane's first point in the direction of travel, m.
    """

    lane: int
    distance: float


@dataclasses.dataclass(frozen=True)
class Signal:
    """A traffic light or sign with all the lanes it governs, its references included.

    Attributes:
      id: the signal's id in the file.
      kind: "light", "stop", "yield", "speed" or "other".
      type: the OpenDRIVE type code ("1000001", "206", ...).
      name: as in the file.
      xyz: (3,) float64, where the post stands, m.
      yaw: rad, the direction of the traffic it faces (travel direction of the lanes it governs).
      value: speed limit in m/s for kind "speed", else None.
      governed: places on driving lanes: the signal's own road and every signalReference, by
        orientation and validity.
    """

    id: str
    kind: str
    type: str
    name: str
    xyz: np.ndarray
    yaw: float
    value: float | None
    governed: tuple[Governed, ...]


@dataclasses.dataclass(frozen=True)
class Controller:
    """Signals that switch together. `sequence` orders the controllers of one junction."""

    id: str
    sequence: int
    signals: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Junction:
    """A junction: its id, its controllers in the order they are served, and its lanes.

    Attributes:
      id: as in the file.
      controllers: controller ids.
      lanes: indices of its driving lanes.
      priority: (high road id, low road id) pairs where the file gives them.
    """

    id: str
    controllers: tuple[str, ...]
    lanes: tuple[int, ...]
    priority: tuple[tuple[str, str], ...] = ()


@dataclasses.dataclass(frozen=True)
class RoadNetwork:
    """Everything read from one file.

    Attributes:
      name: the file's stem.
      left_hand_traffic: True where the file says so (rule="LHT").
      lanes: all lanes of all kinds with a width; links only among driving lanes.
      marks: painted lines, none inside junctions.
      signals: lights and signs.
      controllers: by id.
      junctions: by id.
      crosswalks: polygons, each (P, 3) float64, not closed, m.
      stop_lines: segments painted on the road, each (2, 3) float64, m.
      warnings: what the standard allows and was not read, one line each.
    """

    name: str
    left_hand_traffic: bool
    lanes: tuple[Lane, ...]
    marks: tuple[RoadMark, ...]
    signals: tuple[Signal, ...]
    controllers: dict[str, Controller]
    junctions: dict[str, Junction]
    crosswalks: tuple[np.ndarray, ...]
    stop_lines: tuple[np.ndarray, ...]
    warnings: tuple[str, ...] = ()


class MapError(ValueError):
    """A map that can't be read: one line that names file, place and reason."""
