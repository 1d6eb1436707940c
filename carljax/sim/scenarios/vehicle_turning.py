"""VehicleTurningRoute: behind a junction where the ego turns a bicycle crosses the road.

The bicycle stands beside the road that the ego turns into, right behind the junction, and sets off
across it, to the other side, when the ego is so near that at its present speed it would hit it.
Source: CARLA's scenario runner, `object_crash_intersection`.
"""

from __future__ import annotations

import numpy as np

from carljax.sim.scenarios import placing
from carljax.sim.scenarios import site as site_module
from carljax.sim.scenarios.script import Scenario
from carljax.sim.scenarios.site import Site
from carljax.sim.types import KIND_VEHICLE
from carljax.sim.vehicles import BICYCLE, CLASSES

BEYOND = 11.0  # m from the junction to where the bicycle crosses
SPEED = 1.8  # m/s
START_DISTANCE = 6.0  # m at which it sets off in any case
END = 40.0  # m beyond the place where they would meet
TIMEOUT = 60.0  # s
SIDE = -1.0  # from the right


def place(site: Site, rng: np.random.Generator) -> Scenario | None:
    """A bicycle behind the next junction, if the route turns there; nothing is drawn here."""
    crossing = site_module.next_junction(site)
    if crossing is None or crossing.way == "straight":
        return None
    end_s = crossing.exit_s + BEYOND + END
    if end_s > site.length:
        return None
    where = site_module.place_at(site, crossing.exit_s + BEYOND)
    aside = placing.pavement(site, where, SIDE)
    xy = placing.beside(where, 0.0, SIDE * aside)
    scenario = site_module.blank(site, end_s, TIMEOUT)
    others = scenario.others
    others.kind[0] = KIND_VEHICLE
    others.xy[0] = xy
    others.z[0] = placing.height(site, where)
    others.yaw[0] = where.yaw - SIDE * np.pi / 2
    others.length[0] = np.mean(CLASSES[BICYCLE].length)
    others.width[0] = np.mean(CLASSES[BICYCLE].width)
    others.speed[0] = SPEED
    others.distance[0] = aside + placing.pavement(site, where, -SIDE)
    others.meet_s[0] = site.route.s[where.index]
    others.start_time[0] = aside / SPEED
    others.start_distance[0] = START_DISTANCE
    return scenario.replace(arm_s=np.float32(placing.arm_s(site, xy)))
