"""An IDM route follower: it follows its route and whoever drives on it, and obeys lights and signs.

It knows nothing of crossing traffic nor of pedestrians beside its lane. Source of the parameters:
the IDM planner of nuPlan.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.planners import controls, leader, pace, stops
from carljax.planners import way as way_module
from carljax.sim import idm
from carljax.sim.env import DrivingEnv
from carljax.sim.idm import IDMParams
from carljax.sim.types import SimState

# source: nuPlan's IDM planner: gap 1.0 m, headway 1.5 s, 1.0 and 3.0 m/s^2
DRIVER = IDMParams(min_gap=1.0, headway=1.5, accel_max=1.0, comfort_brake=3.0)
LIMIT_FRAC = 1.0  # of the limit. source: nuPlan's IDM planner
# m from bumper to line, and no headway. source: ours; it has to halt within 3 m before a stop sign
AT_LINE = DRIVER.replace(min_gap=1.0, headway=0.0)
LINE_FAR = 1e3  # m, a gap that changes nothing


def init(env: DrivingEnv) -> tuple[()]:
    """It remembers nothing."""
    del env
    return ()


def act(env: DrivingEnv, sim: SimState, memory: tuple[()]) -> tuple[jax.Array, tuple[()]]:
    """The next action.

    Args:
      env: the environment.
      sim: its state.
      memory: nothing.

    Returns:
      (2,) float32 in [-1, 1], steering and pedals; nothing.
    """
    car, ego = env.vehicle, sim.ego
    found = way_module.stretch(env, sim)
    way = way_module.ahead(found)
    desired = pace.at(pace.slowed_before(pace.wanted(way, LIMIT_FRAC)), ego.speed * env.config.dt)
    near = leader.in_way(ego, sim.agents, way, car)
    first = jnp.argmin(near.gap)
    line = jnp.minimum(
        stops.lights(sim, found, way, env.bank.road_map, car), stops.signs(sim, found, way, car)
    )
    accel = idm.acceleration(
        ego.speed, jnp.minimum(near.gap[first], LINE_FAR), near.speed[first], desired, DRIVER
    )
    at_line = idm.acceleration(
        ego.speed, jnp.minimum(line, LINE_FAR), jnp.float32(0.0), desired, AT_LINE
    )
    return controls.action(ego, way, jnp.minimum(accel, at_line), car), memory
