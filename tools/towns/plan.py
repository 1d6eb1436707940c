"""What a town is made of before it is written: roads with lanes, junctions, signals and objects."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

from towns import geometry
from towns.geometry import Path, Pose

LANE_WIDTH = 3.5

Cubic = tuple[float, float, float, float, float]


@dataclasses.dataclass(frozen=True)
class Mark:
    """A painted line: OpenDRIVE type, colour, and who may cross it ("none", "both", ...)."""

    kind: str
    colour: str = "white"
    change: str = "none"


SOLID = Mark("solid")
BROKEN = Mark("broken", change="both")
YELLOW = Mark("solid", "yellow")
CENTRE_BROKEN = Mark("broken")


@dataclasses.dataclass(frozen=True)
class LaneSpec:
    """One lane of a section.

    Attributes:
      kind: OpenDRIVE lane type.
      widths: (sOffset, a, b, c, d) records, m.
      mark: line along the border away from the reference line, None for none.
    """

    kind: str
    widths: tuple[Cubic, ...]
    mark: Mark | None = None

    def width(self, s: float) -> float:
        """Width at s from the section's start, m."""
        s0, a, b, c, d = [w for w in self.widths if w[0] <= s + 1e-9][-1]
        u = s - s0
        return a + u * (b + u * (c + u * d))


@dataclasses.dataclass(frozen=True)
class Section:
    """Lanes from s on, each side listed from the reference line outwards."""

    s: float
    left: tuple[LaneSpec, ...]
    right: tuple[LaneSpec, ...]
    centre: Mark | None = None

    def lane(self, lane_id: int) -> LaneSpec:
        """The lane of this id."""
        return self.left[lane_id - 1] if lane_id > 0 else self.right[-lane_id - 1]


def lane(kind: str, width: float, mark: Mark | None = None) -> LaneSpec:
    """A lane of constant width, m."""
    return LaneSpec(kind, ((0.0, width, 0.0, 0.0, 0.0),), mark)


def ease(s: float, start: float, goal: float, distance: float) -> Cubic:
    """A cubic record from `start` to `goal` over `distance` m, flat at both ends."""
    rise = goal - start
    return (s, start, 0.0, 3 * rise / distance**2, -2 * rise / distance**3)


@dataclasses.dataclass
class Road:
    """A road as it will be written.

    Attributes:
      id: number in the file.
      path: the reference line.
      sections: at least one, rising s.
      speed: limit in km/h.
      kind: OpenDRIVE road type.
      junction: id of the junction it lies in, or None.
      heights: (s, a, b, c, d) records of the elevation profile; empty is flat at 0.
      before, after: ("road", id, contact) or ("junction", id, None).
      links: {(section, lane id): (predecessor lane id, successor lane id)}, None for none.
      signals, references, objects: filled by `signs.py`, dictionaries of what is written.
    """

    id: int
    path: Path
    sections: tuple[Section, ...]
    speed: float
    kind: str = "town"
    junction: int | None = None
    heights: tuple[Cubic, ...] = ()
    before: tuple[str, int, str | None] | None = None
    after: tuple[str, int, str | None] | None = None
    links: dict[tuple[int, int], tuple[int | None, int | None]] = dataclasses.field(
        default_factory=dict
    )
    signals: list[dict] = dataclasses.field(default_factory=list)
    references: list[dict] = dataclasses.field(default_factory=list)
    objects: list[dict] = dataclasses.field(default_factory=list)

    @property
    def length(self) -> float:
        """Length of the reference line, m."""
        return geometry.length(self.path)


@dataclasses.dataclass(frozen=True)
class ArmLane:
    """A lane where it meets a junction.

    Attributes:
      id: its id on its road.
      spec: what it is.
      pose: of its left border in the direction of travel.
      width: there, m.
    """

    id: int
    spec: LaneSpec
    pose: Pose
    width: float


@dataclasses.dataclass(frozen=True)
class Arm:
    """One end of a road at a junction; `contact` is "start" or "end"."""

    road: Road
    contact: str

    @property
    def pose(self) -> Pose:
        """The reference line's end, looking into the junction."""
        if self.contact == "end":
            return geometry.end(self.road.path)
        return self.road.path[0].start.turned(math.pi)

    @property
    def section(self) -> int:
        """Index of the section that touches the junction."""
        return len(self.road.sections) - 1 if self.contact == "end" else 0

    def lanes(self, incoming: bool) -> list[ArmLane]:
        """All lanes of one direction of travel, from the inside outwards.

        Args:
          incoming: the lanes that lead into the junction, else those that lead out of it.
        """
        section = self.road.sections[self.section]
        s = self.road.length - section.s if self.contact == "end" else 0.0
        right = incoming == (self.contact == "end")
        specs = section.right if right else section.left
        pose = self.pose if incoming else self.pose.turned(math.pi)
        offset, result = 0.0, []
        for index, spec in enumerate(specs):
            result.append(
                ArmLane(
                    (index + 1) * (-1 if right else 1), spec, pose.aside(-offset), spec.width(s)
                )
            )
            offset += spec.width(s)
        return result

    def driving(self, incoming: bool) -> list[ArmLane]:
        """The driving lanes of one direction, from the inside outwards."""
        return [each for each in self.lanes(incoming) if each.spec.kind == "driving"]

    def outside(self, incoming: bool) -> list[ArmLane]:
        """What lies outside the last driving lane of one direction."""
        lanes = self.lanes(incoming)
        last = max(i for i, each in enumerate(lanes) if each.spec.kind == "driving")
        return lanes[last + 1 :]


@dataclasses.dataclass
class Connection:
    """A connecting road and what it joins: lane ids from arm to arm, in the same order."""

    road: Road
    arm_in: Arm
    arm_out: Arm
    lanes_in: tuple[int, ...]


@dataclasses.dataclass
class Junction:
    """A junction, its connections, and the controllers of its lights in the order of service."""

    id: int
    arms: tuple[Arm, ...]
    height: float = 0.0
    connections: list[Connection] = dataclasses.field(default_factory=list)
    controllers: list[int] = dataclasses.field(default_factory=list)


@dataclasses.dataclass
class Town:
    """Everything of one town; ids are handed out by `next_id` and never used twice."""

    name: str
    roads: list[Road] = dataclasses.field(default_factory=list)
    junctions: list[Junction] = dataclasses.field(default_factory=list)
    controllers: dict[int, list[int]] = dataclasses.field(default_factory=dict)
    last_id: int = 0

    def next_id(self) -> int:
        """A number that names nothing yet."""
        self.last_id += 1
        return self.last_id

    def add_road(
        self, path: Path, sections: Sequence[Section], speed: float, **more: object
    ) -> Road:
        """Adds a road; further keywords are fields of `Road`."""
        road = Road(self.next_id(), path, tuple(sections), speed, **more)  # type: ignore[arg-type]
        self.roads.append(road)
        link_sections(road)
        return road


def link_sections(road: Road) -> None:
    """Links the lanes of consecutive sections that keep their id and kind."""
    for k, section in enumerate(road.sections):
        ids = [*range(1, len(section.left) + 1), *range(-1, -len(section.right) - 1, -1)]
        for lane_id in ids:
            kept = [
                lane_id
                if _has(road.sections, k + step, lane_id, section.lane(lane_id).kind)
                else None
                for step in (-1, 1)
            ]
            road.links[k, lane_id] = (kept[0], kept[1])


def _has(sections: Sequence[Section], k: int, lane_id: int, kind: str) -> bool:
    if not 0 <= k < len(sections):
        return False
    side = sections[k].left if lane_id > 0 else sections[k].right
    return abs(lane_id) <= len(side) and sections[k].lane(lane_id).kind == kind


def join_roads(first: Road, second: Road) -> None:
    """Makes `second` the successor of `first`, start to end, lane ids kept."""
    first.after = ("road", second.id, "start")
    second.before = ("road", first.id, "end")
    last = len(first.sections) - 1
    for (k, lane_id), (before, _) in list(first.links.items()):
        if k == last and (0, lane_id) in second.links:
            first.links[k, lane_id] = (before, lane_id)
            second.links[0, lane_id] = (lane_id, second.links[0, lane_id][1])
