"""Worlds with one scenario each: real routes in bundled towns, nobody else, scripted egos.

`draws` finds routes with a scenario of a kind on each, `make` puts them into an environment,
`drive` runs all of them with one driver from shortly before the scenario is armed.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from scripted_driver import LOOK_AHEAD, pedal, steering

from carljax.reward import collision
from carljax.reward.config import RewardConfig
from carljax.sim import env as env_module
from carljax.sim import episodes, route, route_generator
from carljax.sim.env import EnvConfig
from carljax.sim.journey import Journey
from carljax.sim.raster_canvas import RasterConfig
from carljax.sim.route_assembly import RouteSizes
from carljax.sim.scenarios import registry
from carljax.sim.scenarios.site import Site
from carljax.sim.town import offsets
from carljax.sim.types import SimState

ROUTE_LENGTH = 500.0  # m
BEFORE = 10.0  # m before the scenario is armed, where the drive begins
Z_GAP = 3.0  # m
CONFIG = EnvConfig(
    num_agents=2,
    num_pedestrians=0,
    num_scenario_slots=2,
    route_length=ROUTE_LENGTH,
    raster=RasterConfig(32, 32, pixels_per_metre=0.5, ego_from_bottom_px=12),
)
ROWS = CONFIG.population
# Drivers: along the route; likewise, but keeping distance; by the road's curvature alone.
PASSIVE, CAREFUL, BLIND = range(3)


def draws(towns, kind, num, seed=0, length=ROUTE_LENGTH, tries=40) -> list[Journey]:
    """Journeys with one scenario of a kind, from towns in turn, at random places."""
    firsts = offsets(towns)
    found: list[Journey] = []
    for number in range(tries * num):
        town = number % len(towns)
        rng = np.random.default_rng([seed, number])
        sizes = RouteSizes(num_points=int(length) + 1)
        way = route_generator.draw(towns[town], firsts[town], length, sizes, rng)
        site = Site(towns[town], firsts[town], way, int(rng.integers(1, int(way.num_points) - 1)))
        scenario = registry.place(kind, site, rng)
        if scenario is not None:
            found.append(Journey(way, (scenario,)))
        if len(found) == num:
            return found
    raise AssertionError(f"{kind}: only {len(found)} of {num} found")


def make(towns, journeys):
    """An environment on these journeys without any traffic."""
    bank = episodes.populate(towns, journeys, ROWS, 0)
    nobody = bank.agents.replace(kind=jnp.zeros_like(bank.agents.kind))
    return env_module.make_env(bank.replace(agents=nobody), CONFIG, RewardConfig())


def limits(env):
    """(S,) m/s, the speed limit at each scenario's trigger."""
    trigger = np.asarray(env.bank.scenarios.trigger_s)[:, :1]
    at = np.argmax(np.asarray(env.bank.routes.s) >= trigger, axis=1)
    return np.asarray(env.bank.routes.speed_limit)[np.arange(len(at)), at]


@dataclasses.dataclass(frozen=True)
class Drive:
    """What happened: (S, T, ...) NumPy arrays.

    Attributes:
      sim: all states.
      route_s: m.
      hits: (S, T, N) bool, whom the ego touches.
    """

    sim: SimState
    route_s: np.ndarray
    hits: np.ndarray

    @property
    def hit(self) -> np.ndarray:
        """(S,) bool, the ego touched somebody of the scenario."""
        return self.hits.any(axis=(1, 2))


def _action(env, sim, driver, speed):
    """What each of the drivers does."""
    stretch, first = route.window(env.bank.routes, sim.episode_idx, sim.route_idx)
    idx, ego = sim.route_idx - first, sim.ego
    near = jnp.minimum(idx + jnp.arange(LOOK_AHEAD + 1), stretch.num_points - 1)
    steer = steering(env, ego, stretch.xy[near[-1]])
    # The road's own curvature, as the arc from one point's pose to another's.
    there = ego.replace(xy=stretch.xy[idx], yaw=stretch.yaw[idx])
    blind = steering(env, there, stretch.xy[near[-1]])
    at = jnp.stack([jnp.cos(ego.yaw), jnp.sin(ego.yaw)])
    offset = sim.agents.xy - ego.xy
    ahead = offset @ at
    aside = jnp.abs(offset @ jnp.stack([-at[1], at[0]]))
    reach = 6.0 + 0.3 * ego.speed + ego.speed**2 / (2 * 4.0)
    in_way = sim.agents.valid & (ahead > 0.0) & (ahead < reach) & (aside < 3.0)
    wanted = jnp.where((driver == CAREFUL) & in_way.any(), -10.0, speed)
    return jnp.stack([jnp.where(driver == BLIND, blind, steer), pedal(env, ego.speed, wanted)])


def _begin(env, episode, key, speed):
    """The ego at speed on its route, shortly before the scenario is armed."""
    state = env.start_episode(episode, key)
    sim = state.pipeline_state
    routes = env.bank.routes
    at = jnp.argmax(routes.s[episode] >= env.bank.scenarios.arm_s[episode, 0] - BEFORE)
    ego = sim.ego.replace(xy=routes.xy[episode, at], yaw=routes.yaw[episode, at], speed=speed)
    sim = sim.replace(ego=ego, route_idx=at.astype(jnp.int32))
    return state.replace(pipeline_state=sim)


def _drive(env, driver, speed, seed, num_steps):
    def one(episode, key, speed):
        def step(state, _):
            sim = state.pipeline_state
            state = env.advance(state, _action(env, sim, driver, speed))
            sim = state.pipeline_state
            hits = collision.touched(sim.ego, sim.agents, env.vehicle, Z_GAP)
            return state, (sim.replace(key=jnp.zeros(())), hits)

        return jax.lax.scan(step, _begin(env, episode, key, speed), None, length=num_steps)[1]

    num = len(speed)
    keys = jax.random.split(jax.random.key(seed), num)
    return jax.vmap(one)(jnp.arange(num), keys, speed)


_drive_jit = jax.jit(_drive, static_argnames="num_steps")


def drive(env, driver=PASSIVE, speed=None, seed=0, num_steps=500) -> Drive:
    """Drives all journeys of an environment; no collision and no red light ends a drive.

    Args:
      env: of `make`.
      driver: one of the constants above.
      speed: (S,) m/s that the driver keeps; the limit at the trigger unless told otherwise.
      seed: of all that is drawn.
      num_steps: of 0.1 s.
    """
    speed = limits(env) if speed is None else speed
    speed = jnp.broadcast_to(jnp.asarray(speed, jnp.float32), (int(env.bank.num_episodes),))
    found = _drive_jit(env, jnp.int32(driver), speed, seed, num_steps=num_steps)
    sim, hits = jax.tree.map(np.asarray, found)
    s = np.take_along_axis(np.asarray(env.bank.routes.s), sim.route_idx, axis=1)
    return Drive(sim, s, hits)
