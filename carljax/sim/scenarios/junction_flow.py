"""A stream of cars through a junction that does not wait for the ego, which has to turn there.

The stream leaves its source, out of sight up the arm, from the trigger on, one car after another.
Each goes straight on at the stream's speed, minds only the cars ahead in its lane, and starts again
once it is far beyond the junction. The gaps are drawn, but for one in each round that is long
enough to go. Sources of the numbers: CARLA's scenarios of turns at junctions, where the text does
not say otherwise.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from carljax.sim import junctions
from carljax.sim.scenarios import site as site_module
from carljax.sim.scenarios.script import (
    DRIVE_FLOW,
    NUM_CARS,
    WAY_LANES,
    Scenario,
    ScriptedCars,
)
from carljax.sim.scenarios.site import RouteJunction, Site, Way
from carljax.sim.vehicles import CAR

TIMEOUT = 240.0  # s
END_BEYOND = 10.0  # m beyond the junction, where it is over
GAP = (15.0, 60.0)  # m from car to car. source: source intervals of the official routes
# s, the gap that comes once in each round, and GAP[1] at least. source: HCM, critical gap of a
# right turn from a minor road, 6.2 s; of a left turn across oncoming traffic, 4.1 s
GAP_TO_GO = 6.2
# m up the arm, nearer than which no car may appear: the policy sees 64 m aside, and ahead 78 m from
# before the junction. source: paper, Observation
OUT_OF_SIGHT = 65.0
SHORTEST_ARM = 58.0  # m; out of sight aside from the ego's road, with half a junction. source: ours
ARM_CLEARANCE = 4.0  # m kept to an arm's beginning. source: ours
FARTHEST_SINK = 90.0  # m beyond the junction, out of sight. source: ours
# m from the trigger to the junction. source: ours
TRIGGER_AHEAD = (20.0, 110.0)
# s from when the first car of a stream can be at the meeting to when an ego at the limit is there.
# source: ours, one or two cars come before it
LATE = (0.0, 4.0)
SAME_DIRECTION = np.pi / 4  # rad by which an arm may differ from the side it is on. source: ours


@dataclasses.dataclass(frozen=True)
class Stream:
    """Where a stream comes from and how fast it is.

    Attributes:
      way: the turn that the ego makes, "left" or "right".
      yaw: rad, the stream's direction of travel relative to the ego's before the junction.
      speed: m/s, least, most common and greatest.
      source_time: s of its way from its source to the junction, where the arm is long enough.
      sink_time: s of its way from the junction to where it starts again, at least.
    """

    way: str
    yaw: float
    speed: tuple[float, float, float]
    source_time: float
    sink_time: float


# source of the speeds: the official routes, as drawn from by the authors' generator
ONCOMING = Stream("left", np.pi, (7.0, 12.0, 19.0), source_time=4.0, sink_time=2.5)
FROM_LEFT = Stream("right", -np.pi / 2, (7.0, 10.0, 18.0), source_time=5.0, sink_time=3.0)


@dataclasses.dataclass(frozen=True)
class CrossWay:
    """A way straight on through a junction, across or into the route's.

    Attributes:
      way: from up the arm to the end of the lane beyond the junction.
      entry, exit: m along it.
      meet_s: m on the route, where the two meet.
      meet_lane_s: m along the way, the same place.
      light: the town's row, -1 for none.
    """

    way: Way
    entry: float
    exit: float
    meet_s: float
    meet_lane_s: float
    light: int

    def source(self, reach: float) -> float:
        """M along the way, `reach` m before the junction or as far up the arm as it goes."""
        return max(self.entry - reach, ARM_CLEARANCE)


def place(
    site: Site, rng: np.random.Generator, stream: Stream, is_signalized: bool
) -> Scenario | None:
    """A stream at the next junction, if the route makes the turn there that it is for."""
    crossing = site_module.next_junction(site)
    if crossing is None or crossing.way != stream.way:
        return None
    light = ego_light(site, crossing)
    if (light >= 0) != is_signalized:
        return None
    found = cross_ways(site, crossing, stream.yaw)
    if not found:
        return None
    across = found[int(rng.integers(len(found)))]
    speed = float(rng.triangular(*stream.speed))
    gaps = rng.uniform(*GAP, NUM_CARS - 1)
    round_ = _round(across, stream, speed, gaps)
    if round_ is None:
        return None
    soonest = (across.meet_lane_s - round_.source) / speed
    site = trigger(site, crossing, across, soonest + float(rng.uniform(*LATE)))
    wait = time_at_limit(site, crossing, across) - soonest
    scenario = site_module.blank(site, crossing.exit_s + END_BEYOND, TIMEOUT)
    _put_cars(site, scenario.cars, across, round_, speed, wait)
    if not is_signalized:
        return scenario
    green = [row for row in (light, across.light) if row >= 0]
    return site_module.hold(site, scenario, crossing.junction, green)


def trigger(site: Site, crossing: RouteJunction, across: CrossWay, time: float) -> Site:
    """The site moved along its route to where an ego at the limit needs some time to the meeting.

    Args:
      site: before the junction.
      crossing: the junction.
      across: the way that the route meets there.
      time: s.
    """
    limit = float(site.route.speed_limit[crossing.entry])
    least, most = TRIGGER_AHEAD
    ahead = limit * time - (across.meet_s - crossing.entry_s)
    trigger_s = crossing.entry_s - min(max(ahead, least), most)
    return dataclasses.replace(site, index=site_module.place_at(site, trigger_s).index)


def time_at_limit(site: Site, crossing: RouteJunction, across: CrossWay) -> float:
    """S from the trigger to the meeting for an ego at the limit."""
    return (across.meet_s - site.trigger_s) / float(site.route.speed_limit[crossing.entry])


def ego_light(site: Site, crossing: RouteJunction) -> int:
    """The light at which the route enters a junction; the town's row or -1."""
    return site_module.light_of(site.town, (*crossing.lanes, crossing.approach))


def cross_ways(site: Site, crossing: RouteJunction, yaw: float) -> list[CrossWay]:
    """Ways straight on through a junction that get in the route's way, from one side.

    Args:
      site: of the route.
      crossing: the junction.
      yaw: rad, their direction of travel relative to the ego's before the junction.

    Returns:
      All with an arm long enough, in order of lane rows.
    """
    town = site.town
    found = []
    inner = site_module.conflicting_lanes(town, crossing.lanes)
    for lane in site_module.entering_lanes(town, inner):
        aside = site_module.lane_yaw(town, lane) - crossing.yaw - yaw
        if abs((aside + np.pi) % (2 * np.pi) - np.pi) > SAME_DIRECTION:
            continue
        if abs(junctions.turn(town.lanes, lane)) <= junctions.TURN_YAW:
            found.append(_cross_way(site, crossing, lane))
    return [one for one in found if one is not None]


def _cross_way(site: Site, crossing: RouteJunction, lane: int) -> CrossWay | None:
    """The way through a lane of the junction, or None where its arm is short or they don't meet."""
    town = site.town
    length = town.lanes.length
    before = site_module.arm(town, lane, SHORTEST_ARM, WAY_LANES - 2)
    entry = float(length[list(before)].sum())
    if entry < SHORTEST_ARM:
        return None
    inside = site_module.through(town, lane)
    path = site_module.way(town, (*before, *inside))
    met = site_module.meeting(site, crossing.entry, crossing.exit, path)
    if met is None:
        return None
    is_inside = town.junctions.junction[list(inside)] == crossing.junction
    return CrossWay(
        way=path,
        entry=entry,
        exit=entry + float(length[list(inside)][is_inside].sum()),
        meet_s=met[0],
        meet_lane_s=met[1],
        light=site_module.light_of(town, (*inside, *reversed(before))),
    )


@dataclasses.dataclass(frozen=True)
class _Round:
    """One round of a stream.

    Attributes:
      source: m along the way, where cars begin.
      travel: m along the way, where they begin again.
      behind: (n,) m, how far each car follows the first.
    """

    source: float
    travel: float
    behind: np.ndarray


def _round(across: CrossWay, stream: Stream, speed: float, gaps: np.ndarray) -> _Round | None:
    """As many cars as the way has room for, at least two."""
    source = across.source(max(stream.source_time * speed, OUT_OF_SIGHT))
    nearest = across.exit + stream.sink_time * speed
    farthest = min(across.way.length, across.exit + FARTHEST_SINK)
    if nearest > farthest:
        return None
    last = max(GAP[1], GAP_TO_GO * speed)
    behind = np.concatenate([[0.0], np.cumsum(gaps)])
    behind = behind[behind + last <= farthest - source]
    if len(behind) < 2:
        return None
    return _Round(source, max(source + float(behind[-1]) + last, nearest), behind)


def _put_cars(
    site: Site, cars: ScriptedCars, across: CrossWay, round_: _Round, speed: float, wait: float
) -> None:
    """Fills in the cars of a stream.

    Args:
      site: its place.
      cars: empty rows.
      across: its way.
      round_: its cars.
      speed: m/s.
      wait: s after the trigger at which a car has to leave the source in order to meet an ego at
        the limit. One of the stream does, and as many as there is time for come before it.
    """
    rows = slice(0, len(round_.behind))
    after = round_.behind / speed
    before = after[after <= max(wait, 0.0)]
    cars.model[rows] = CAR
    cars.lanes[rows] = site_module.shared_lanes(site, across.way.lanes)
    cars.s[rows] = round_.source
    cars.speed[rows] = speed
    cars.drive[rows] = DRIVE_FLOW
    cars.travel[rows] = round_.travel
    cars.meet_s[rows] = across.meet_s
    cars.meet_lane_s[rows] = across.meet_lane_s
    cars.from_trigger[rows] = True
    cars.delay[rows] = after + max(wait, 0.0) - before[-1]
