"""HardBreakRoute: the car ahead brakes to a halt for no reason, stands, and drives on.

A car comes onto the route out of sight ahead and is slower than the limit, so that the ego catches
up with it by the trigger. From then on the car ahead of the ego, this one or whichever it is,
brakes as hard as it can, stands, and drives on. Source: CARLA's scenario runner, `hard_break`, for
the time it stands; there it takes the cars of the background traffic.
"""

from __future__ import annotations

import numpy as np

from carljax.sim.respawn import VIEW_FRONT
from carljax.sim.scenarios import placing
from carljax.sim.scenarios import site as site_module
from carljax.sim.scenarios.script import DRIVE_LEGAL, Scenario
from carljax.sim.scenarios.site import Site
from carljax.sim.vehicles import CAR

BRAKE_S = 10.0  # s, braking and standing
SPEED_FRAC = (0.35, 0.5)  # of the limit. source: ours, so that it is caught up with in time
HEADWAY = 14.0  # m to its middle when the ego, at the limit, comes to the trigger. source: ours
SLACK = 8.0  # m by which it appears farther than the ego sees. source: ours
END = 60.0  # m beyond the trigger: past where it stood, so it has driven on. source: ours
TIMEOUT = 120.0  # s


def place(site: Site, rng: np.random.Generator) -> Scenario | None:
    """A slow car ahead, if the route before the trigger is long enough to catch up with it."""
    frac = float(rng.uniform(*SPEED_FRAC))
    ahead = VIEW_FRONT + SLACK
    # While the ego comes nearer at (1 - frac) of its speed from `ahead` to `HEADWAY`.
    run = (ahead - HEADWAY) / (1.0 - frac)
    arm_s = site.trigger_s - run
    if arm_s < 0.0 or site.trigger_s + END > site.length:
        return None
    start = site_module.place_at(site, arm_s + ahead)
    scenario = site_module.blank(site, site.trigger_s + END, TIMEOUT)
    cars = scenario.cars
    cars.model[0] = CAR
    cars.lanes[0] = _lanes(site, start.index)
    cars.s[0] = start.lane_s
    cars.speed[0] = frac * float(site.route.speed_limit[start.index])
    cars.drive[0] = DRIVE_LEGAL
    last_chance = placing.arm_s(site, start.xy)
    return scenario.replace(arm_s=np.float32(min(arm_s, last_chance)), brake_s=np.float32(BRAKE_S))


def _lanes(site: Site, index: int) -> np.ndarray:
    """(3,) int32, the route's lanes from a point on, as far as they follow one another."""
    lane = np.asarray(site.route.lane[index : int(site.route.num_points)]) - site.first.lane
    ordered = lane[np.r_[True, lane[1:] != lane[:-1]]].tolist()
    kept = ordered[:1]
    for row in ordered[1:3]:
        if row not in site.town.lanes.successors[kept[-1]]:
            break  # the route changes lanes here
        kept.append(row)
    return site_module.shared_lanes(site, kept)
