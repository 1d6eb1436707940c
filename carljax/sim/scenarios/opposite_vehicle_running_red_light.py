"""OppositeVehicleRunningRedLight: the ego has green, an ambulance from a cross arm runs its red.

It comes from the left or from the right, as likely as not where both arms are there, with its
lights on, and times itself to be where the ways cross when the ego is. It sets off when the lights
that are held for it have had the time to change.
"""

from __future__ import annotations

import numpy as np

from carljax.sim.lights import CLEARING_S
from carljax.sim.scenarios import junction_flow
from carljax.sim.scenarios import site as site_module
from carljax.sim.scenarios.script import DRIVE_MEET, Scenario
from carljax.sim.scenarios.site import Site
from carljax.sim.types import SIGNAL_EMERGENCY
from carljax.sim.vehicles import VAN

SPEED = 60.0 / 3.6  # m/s. source: CARLA's scenario
TIMEOUT = 180.0  # s. source: CARLA's scenario
# of the time that the car needs at its own speed, in which an ego at the limit comes to the meeting
# place: the car can be faster, and somewhat slower. source: ours
EGO_TIME = (0.9, 1.4)
END_BEYOND = 10.0  # m beyond the junction. source: CARLA's turns at junctions


def place(site: Site, rng: np.random.Generator) -> Scenario | None:
    """The ego's light green and the others red, and one car that does not care."""
    crossing = site_module.next_junction(site)
    # Both sides are drawn for, whatever comes of it, so that each is as likely.
    from_left_first = rng.random() < 0.5
    if crossing is None:
        return None
    light = junction_flow.ego_light(site, crossing)
    if light < 0:
        return None
    # Whoever comes from the left drives to the ego's right.
    from_left, from_right = (
        [
            way
            for way in junction_flow.cross_ways(site, crossing, yaw)
            if way.light not in (light, -1)
        ]
        for yaw in (-np.pi / 2, np.pi / 2)
    )
    first, second = (from_left, from_right) if from_left_first else (from_right, from_left)
    found = first or second
    if not found:
        return None
    across = found[int(rng.integers(len(found)))]
    source = across.source(junction_flow.OUT_OF_SIGHT)
    time = (across.meet_lane_s - source) / SPEED
    time = CLEARING_S + time * float(rng.uniform(*EGO_TIME))
    site = junction_flow.trigger(site, crossing, across, time)
    scenario = site_module.blank(site, crossing.exit_s + END_BEYOND, TIMEOUT)
    cars = scenario.cars
    cars.model[0] = VAN
    cars.lanes[0] = site_module.shared_lanes(site, across.way.lanes)
    cars.s[0] = source
    cars.speed[0] = SPEED
    cars.drive[0] = DRIVE_MEET
    cars.meet_s[0] = across.meet_s
    cars.meet_lane_s[0] = across.meet_lane_s
    cars.signals[0] = SIGNAL_EMERGENCY
    cars.from_trigger[0] = True
    cars.delay[0] = CLEARING_S
    return site_module.hold(site, scenario, crossing.junction, [light])
