"""HardBreakRoute: the car ahead brakes to a halt for no reason, stands, and drives on.

A car comes onto the route out of sight ahead and is slower than the limit, so that the ego catches
up with it by the trigger. From then on the car ahead of the ego, this one or whichever it is,
brakes as hard as it can, stands, and drives on. Source: CARLA's scenario runner, `hard_break`, for
the time it stands; there it takes the cars of the background traffic.
"""

from __future__ import annotations

import itertools

import numpy as np

from carljax.sim.respawn import VIEW_FRONT
from carljax.sim.scenarios import placing
from carljax.sim.scenarios import site as site_module
from carljax.sim.scenarios.script import DRIVE_LEGAL, WAY_LANES, Scenario
from carljax.sim.scenarios.site import Site
from carljax.sim.vehicles import CAR

BRAKE_S = 10.0  # s, braking and standing
SPEED_FRAC = (0.35, 0.5)  # of the limit. source: ours, so that it is caught up with in time
HEADWAY = 14.0  # m to its middle when the ego, at the limit, comes to the trigger. source: ours
REACH = 24.0  # m beyond the trigger on which it keeps to the route. source: ours
SLACK = 8.0  # m by which it appears farther than the ego sees. source: ours
END = 60.0  # m beyond the trigger: past where it stood, so it has driven on. source: ours
TIMEOUT = 120.0  # s


def place(site: Site, rng: np.random.Generator) -> Scenario | None:
    """A slow car ahead, if it and the ego come to the trigger on the same lane."""
    frac = float(rng.uniform(*SPEED_FRAC))
    # The ego comes nearer at (1 - frac) of its speed. Near the route's start it has less of a run:
    # there the car stands nearer from the beginning.
    run = min((VIEW_FRONT + SLACK - HEADWAY) / (1.0 - frac), site.trigger_s)
    arm_s = site.trigger_s - run
    if site.trigger_s + END > site.length:
        return None
    start = site_module.place_at(site, arm_s + (1.0 - frac) * run + HEADWAY)
    lanes = _lanes(site, start.index, site_module.place_at(site, site.trigger_s + REACH).index)
    if lanes is None:
        return None
    slowest = site.route.speed_limit[
        site_module.place_at(site, arm_s).index : start.index + 1
    ].min()
    scenario = site_module.blank(site, site.trigger_s + END, TIMEOUT)
    cars = scenario.cars
    cars.model[0] = CAR
    cars.lanes[0] = site_module.shared_lanes(site, lanes)
    cars.s[0] = start.lane_s
    cars.speed[0] = frac * float(slowest)
    cars.drive[0] = DRIVE_LEGAL
    last_chance = placing.arm_s(site, start.xy)
    return scenario.replace(arm_s=np.float32(min(arm_s, last_chance)), brake_s=np.float32(BRAKE_S))


def _lanes(site: Site, first: int, last: int) -> list[int] | None:
    """The route's lanes between two of its points; None where it changes lanes or has too many.

    A car plans three lanes ahead, and would stand where it knows no more: if the route has fewer
    there, it goes on as it likes.
    """
    table = site.town.lanes
    lane = np.asarray(site.route.lane[first : last + 1]) - site.first.lane
    ordered = lane[np.r_[True, lane[1:] != lane[:-1]]].tolist()
    follow = all(after in table.successors[before] for before, after in itertools.pairwise(ordered))
    while len(ordered) < 3 and table.successors[ordered[-1]].max() >= 0:
        ordered.append(int(table.successors[ordered[-1]].max()))
    return ordered if follow and len(ordered) <= WAY_LANES else None
