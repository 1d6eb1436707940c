"""A planner after PDM-Lite: as fast as the most restrictive of its reasons to be slow allows.

Reasons are whoever is ahead, whoever a forecast of two seconds meets, lights, signs, and junctions
where the ego gives way; each asks for an acceleration by the Intelligent Driver Model, and the
lowest holds. It knows nothing of scenarios. Source: PDM-Lite (carla_garage). Ours where it says so:
there a target speed goes to a regression of CARLA's car twenty times a second, here an acceleration
goes to the inverse of the car's law ten times a second.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct

from carljax.planners import controls, forecast, gate, lane_change, leader, pace, stops
from carljax.planners import way as way_module
from carljax.planners.way import Way
from carljax.sim import idm
from carljax.sim.env import DrivingEnv
from carljax.sim.idm import IDMParams
from carljax.sim.types import KIND_PEDESTRIAN, Agents, SimState

LIMIT_FRAC = 0.72  # of the limit. source: PDM-Lite
JUNCTION_SPEED = 64.0 / 3.6  # m/s near junctions. source: PDM-Lite
JUNCTION_RANGE = 30  # m before a junction that count as near. source: PDM-Lite
HORIZON = 10  # moments of forecast, 2.0 s. source: PDM-Lite
# PDM-Lite's driver has a = 24 m/s^2, b = 8.7 below 6.02 m/s and 3.72 above, integrated over 0.05 s.
# source of a: ours; at steps of 0.1 s 24 would swing around low speeds (4 a dt / v > 2) and brake
# later than this car can stop. b and the distances: PDM-Lite.
DRIVER = IDMParams(min_gap=4.0, headway=0.25, accel_max=4.0, comfort_brake=3.72, brake_max=7.26)
# source: ours, from bumper to line, where PDM-Lite's 6 m and 2 m are from its centre
AT_LIGHT = DRIVER.replace(min_gap=1.5, headway=0.1)
AT_SIGN = DRIVER.replace(min_gap=1.0, headway=0.1)
AT_GATE = DRIVER.replace(min_gap=0.5, headway=0.1)
STANDING = 1.0  # m/s, slower ones in the way are waited for as they stand. source: ours
GO_ACCEL = 2.5  # m/s^2, of the ego in forecasts. source: ours, what its driver keeps up
FAR = 1e3  # m, a gap that changes nothing
VEHICLE_MARGIN, PEDESTRIAN_MARGIN = 0.4, 0.8  # m added to boxes in forecasts. source: ours
# m/s^2 by which the acceleration may change in a step, unless it brakes hard. source: ours, below
# the comfort limit of 30 m/s^3
ACCEL_STEP = 2.5
HARD_BRAKING = -3.5  # m/s^2. source: ours

Respond = Callable[[jax.Array, jax.Array | float, IDMParams], jax.Array]


class Memory(struct.PyTreeNode):
    """What it remembers.

    Attributes:
      waited_s: () s, how long it has stood.
      delay: () m, by which it puts off changes of lane.
    """

    waited_s: jax.Array
    delay: jax.Array


def init(env: DrivingEnv) -> Memory:
    """Memory at the start of a route."""
    del env
    return Memory(waited_s=jnp.float32(0.0), delay=jnp.float32(0.0))


def act(env: DrivingEnv, sim: SimState, memory: Memory) -> tuple[jax.Array, Memory]:
    """The next action.

    Args:
      env: the environment.
      sim: its state.
      memory: of the step before.

    Returns:
      (2,) float32 in [-1, 1], steering and pedals; the memory for the next step.
    """
    car, ego, road_map = env.vehicle, sim.ego, env.bank.road_map
    found = way_module.stretch(env, sim, memory.delay)
    way = way_module.ahead(found)
    speeds = desired_speeds(way)
    desired = pace.at(speeds, ego.speed * env.config.dt)

    def respond(gap: jax.Array, speed: jax.Array | float, driver: IDMParams) -> jax.Array:
        of_leader = jnp.asarray(speed, jnp.float32)
        return idm.acceleration(ego.speed, jnp.minimum(gap, FAR), of_leader, desired, driver)

    light = respond(stops.lights(sim, found, way, road_map, car), 0.0, AT_LIGHT)
    sign = respond(stops.signs(sim, found, way, car), 0.0, AT_SIGN)
    for_others = _for_others(env, sim, way, speeds, memory, respond)
    delay, room = lane_change.postpone(found, ego, sim.agents, memory.delay, road_map, car)
    merge = respond(room, 0.0, AT_GATE)
    accel = jnp.stack([light, sign, for_others, merge]).min()
    accel = _comfortable(accel, ego.accel)
    waited = jnp.where(ego.speed < 0.3, memory.waited_s + env.config.dt, 0.0)
    return controls.action(ego, way, accel, car), Memory(waited, delay)


def desired_speeds(way: Way) -> jax.Array:
    """(K,) m/s along the way, on an empty road."""
    speeds = pace.wanted(way, LIMIT_FRAC)
    ahead = jnp.pad(way.in_junction, (0, JUNCTION_RANGE), mode="edge")
    seen = jax.lax.reduce_window(
        ahead, False, jax.lax.bitwise_or, (JUNCTION_RANGE + 1,), (1,), "valid"
    )
    return pace.slowed_before(jnp.where(seen, jnp.minimum(speeds, JUNCTION_SPEED), speeds))


def _for_others(
    env: DrivingEnv,
    sim: SimState,
    way: Way,
    speeds: jax.Array,
    memory: Memory,
    respond: Respond,
) -> jax.Array:
    """() m/s^2, what leaders, the forecast and giving way ask for."""
    car, ego, agents, road_map = env.vehicle, sim.ego, sim.agents, env.bank.road_map
    near = leader.in_way(ego, agents, way, car)
    is_leader = near.same_way | (agents.speed < STANDING)
    leads = respond(jnp.where(is_leader, near.gap, FAR), near.speed, DRIVER).min()
    cast = forecast.others(agents, env.config.population, road_map, sim.lights, gate.HORIZON)
    distances = forecast.ego_distances(ego.speed, speeds, GO_ACCEL, gate.HORIZON)
    soon = jax.tree.map(lambda x: x[:HORIZON], cast)
    met = forecast.hits(ego, agents, soon, way, distances[:HORIZON], car, _margins(agents))
    meets = respond(met.gap, met.speed, DRIVER).min()
    room = gate.gap(
        ego,
        agents,
        cast,
        way,
        distances,
        near.same_way & (near.gap < FAR),
        memory.waited_s,
        road_map,
        car,
    )
    waits = respond(room, 0.0, AT_GATE)
    return jnp.minimum(jnp.minimum(leads, meets), waits)


def _margins(agents: Agents) -> tuple[jax.Array, jax.Array]:
    margin = jnp.where(agents.kind == KIND_PEDESTRIAN, PEDESTRIAN_MARGIN, VEHICLE_MARGIN)
    return margin, margin


def _comfortable(accel: jax.Array, before: jax.Array) -> jax.Array:
    """Changes the acceleration by small steps, unless it is an emergency."""
    gentle = jnp.clip(accel, before - ACCEL_STEP, before + ACCEL_STEP)
    return jnp.where(accel < HARD_BRAKING, accel, gentle)
