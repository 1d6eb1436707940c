"""ControlLoss: on three patches of the road the car does not do what it is told.

As on ice or gravel: on each of three patches of 4 m, within 60 m, steering and throttle are off by
an amount that is drawn anew. Whoever does not steer back soon leaves the lane. There is nobody and
nothing to be seen. Source: CARLA's scenario runner, `control_loss`, whose numbers these are; there
the disturbance is of a fixed size to either side, here it is uniform with the same mean size.
"""

from __future__ import annotations

import numpy as np

from carljax.sim.scenarios import site as site_module
from carljax.sim.scenarios.script import Scenario
from carljax.sim.scenarios.site import Site

PATCHES = (14.0, 48.0, 74.0)  # m beyond the trigger, the middle of each
PATCH_RADIUS = 2.0  # m
STEER_NOISE = 2 * 0.055  # half-width; the mean size is half of it
THROTTLE_NOISE = 2 * 0.03
END = 110.0  # m beyond the trigger
TIMEOUT = 60.0  # s


def place(site: Site, rng: np.random.Generator) -> Scenario | None:
    """Patches on the next 76 m of the route; nothing is drawn here."""
    middle = site.trigger_s + np.array(PATCHES)
    if middle[-1] + PATCH_RADIUS > site.length:
        return None
    return site_module.blank(site, site.trigger_s + END, TIMEOUT).replace(
        patches=np.stack([middle - PATCH_RADIUS, middle + PATCH_RADIUS], axis=1).astype(np.float32),
        steer_noise=np.float32(STEER_NOISE),
        throttle_noise=np.float32(THROTTLE_NOISE),
    )
