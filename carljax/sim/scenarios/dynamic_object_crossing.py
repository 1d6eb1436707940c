"""DynamicObjectCrossing: a pedestrian steps onto the road from behind an obstacle.

A box stands at the kerb, and right behind it a pedestrian, who starts to cross when the ego is so
near that at its present speed it would hit the pedestrian, and walks on to the other side. Where
this would be in a junction it is behind it. Sources: CARLA's scenario runner,
`object_crash_vehicle`, for speed, places and the nearest start; the official routes, as the
authors' generator draws from them, for distance, angle and side.
"""

from __future__ import annotations

import numpy as np

from carljax.sim.scenarios import placing
from carljax.sim.scenarios import site as site_module
from carljax.sim.scenarios.script import Scenario
from carljax.sim.scenarios.site import Site
from carljax.sim.types import KIND_PEDESTRIAN, KIND_STATIC

DISTANCE = (15.0, 113.0)  # m from the trigger to where they would meet
COMMON_DISTANCE, COMMON_FRAC = 50.0, 0.32  # m, and how often it is just that
ANGLE = (-4.0, 20.0)  # degrees by which the pedestrian walks towards the ego
RIGHT_FRAC = 0.97  # from the right
SPEED = 2.0  # m/s
START_DISTANCE = 6.0  # m at which the pedestrian starts in any case
BOX = 1.0  # m, length and width. source: CARLA's vending machine, about
BODY = 0.5  # m, length and width of a pedestrian. source: CARLA's walkers, 0.38 to 0.6
BEHIND = 0.5  # m from the obstacle to the pedestrian
END = 40.0  # m beyond the place where they would meet
TIMEOUT = 60.0  # s


def place(site: Site, rng: np.random.Generator) -> Scenario | None:
    """Obstacle and pedestrian beside the route, where it is long enough."""
    is_common = rng.uniform() < COMMON_FRAC
    distance = COMMON_DISTANCE if is_common else float(rng.uniform(*DISTANCE))
    angle = np.deg2rad(rng.uniform(*ANGLE))
    side = -1.0 if rng.uniform() < RIGHT_FRAC else 1.0
    where = placing.outside_junction(site, site.trigger_s + distance)
    if where is None or site.route.s[where.index] + END > site.length:
        return None
    aside = placing.pavement(site, where, side)
    # The pedestrian comes towards the ego while crossing: so it stands that much farther.
    ahead = aside * np.tan(angle)
    xy = np.stack(
        [
            placing.beside(where, ahead, side * aside),
            placing.beside(where, ahead - 0.5 * BOX - BEHIND, side * aside),
        ]
    )
    meet_s = float(site.route.s[where.index])
    scenario = site_module.blank(site, meet_s + END, TIMEOUT)
    walk = aside / np.cos(angle)
    others = scenario.others
    others.kind[:2] = KIND_PEDESTRIAN, KIND_STATIC
    others.xy[:2] = xy
    others.z[:2] = placing.height(site, where)
    others.yaw[:2] = where.yaw - side * (np.pi / 2 + angle), where.yaw
    others.length[:2] = others.width[:2] = BODY, BOX
    others.speed[0] = SPEED
    others.distance[0] = walk + placing.pavement(site, where, -side) / np.cos(angle)
    others.meet_s[:2] = meet_s
    others.start_time[0] = walk / SPEED
    others.start_distance[0] = START_DISTANCE
    return scenario.replace(arm_s=np.float32(placing.arm_s(site, xy)))
