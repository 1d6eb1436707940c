"""How dangerous each kind of scenario is, and to whom: `python benchmarks/scenarios.py`.

Real routes with one scenario each and nobody else on the road. A passive driver keeps to the route
and to the speed limit whatever comes, and does not steer back when the car is pushed aside; the
planners drive as they do everywhere. One JSON line for each kind and driver.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from flax import struct

from carljax import machine
from carljax.planners import PLANNERS, Planner, controls
from carljax.planners import way as way_module
from carljax.reward import collision
from carljax.reward.config import RewardConfig
from carljax.sim import bicycle, episodes, geometry, route_generator
from carljax.sim import env as env_module
from carljax.sim import route as route_module
from carljax.sim import towns as bundled
from carljax.sim.env import DrivingEnv, EnvConfig
from carljax.sim.journey import Journey
from carljax.sim.raster_canvas import RasterConfig
from carljax.sim.road_network import MapError
from carljax.sim.route_assembly import RouteSizes
from carljax.sim.scenarios import registry
from carljax.sim.scenarios.generator import place_along
from carljax.sim.town import Town, load, offsets
from carljax.sim.types import EgoState, SimState, State

ROUTE_LENGTH = 500  # m
BEFORE = 30.0  # m before the scenario is armed, where the drive begins
LANE_WIDTH = 3.5  # m, beyond half of which from the route's line the ego has left its lane
CONFIG = EnvConfig(
    num_agents=2,
    num_pedestrians=0,
    num_scenario_slots=2,
    route_length=ROUTE_LENGTH,
    raster=RasterConfig(height=32, width=32, pixels_per_metre=0.5, ego_from_bottom_px=12),
)
AFTER = 3.0  # s after a scenario's end in which a collision still counts: whom it brought is there
TRIES = 400  # routes looked at for each one wanted


@dataclasses.dataclass(frozen=True)
class Command:
    """What to measure."""

    kind: tuple[str, ...] = registry.KINDS
    """Kinds of scenarios."""
    driver: tuple[str, ...] = ("passive", *sorted(PLANNERS))
    """Who drives."""
    map: tuple[str, ...] = ()
    """Bundled towns by name, or paths of .xodr files; all bundled towns if none is given."""
    num: int = 48
    """Routes of each kind."""
    seconds: float = 120.0
    """Longest drive."""
    seed: int = 0
    """Of routes, scenarios and all that is drawn on the way."""


class Fate(struct.PyTreeNode):
    """How a drive went.

    Attributes:
      began: () bool, the scenario was triggered.
      ended: () bool, and passed.
      timed_out: () bool, it lasted too long.
      collided: () bool, the ego touched somebody before the end or within `AFTER` of it.
      left_road: () bool, it was off the road, by the rule that ends an episode.
      left_lane: () bool, more than half of it was beyond the edge of its lane.
      played_s: () s from the trigger to the end or to the drive's.
      after_s: () s since the end.
    """

    began: jax.Array
    ended: jax.Array
    timed_out: jax.Array
    collided: jax.Array
    left_road: jax.Array
    left_lane: jax.Array
    played_s: jax.Array
    after_s: jax.Array


_NO, _ZERO = np.bool_(False), np.float32(0.0)
NOTHING_YET = Fate(_NO, _NO, _NO, _NO, _NO, _NO, _ZERO, _ZERO)


def main() -> int:
    """Measures and prints."""
    command = tyro.cli(Command, description=__doc__)
    unknown = [kind for kind in command.kind if kind not in registry.KINDS]
    unknown += [name for name in command.driver if name not in drivers()]
    if unknown:
        known = ", ".join((*registry.KINDS, *drivers()))
        print(f"error: {unknown[0]}: is none of {known}", file=sys.stderr)
        return 2
    try:
        names = command.map or tuple(bundled.names())
        towns = [load(bundled.path(n) if n in bundled.names() else Path(n)) for n in names]
    except (MapError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for kind in command.kind:
        journeys = draw(towns, kind, command.num, command.seed)
        if not journeys:
            print(f"error: {kind}: no place suits it in {', '.join(names)}", file=sys.stderr)
            return 2
        for driver in command.driver:
            line = measure(towns, journeys, kind, driver, command)
            print(json.dumps({**line, "machine": machine.describe()}), flush=True)
    return 0


def draw(towns: Sequence[Town], kind: str, num: int, seed: int) -> list[Journey]:
    """Routes with one scenario of a kind each, placed as in training, from the towns in turn.

    Args:
      towns: where.
      kind: of the scenario.
      num: how many are wanted; there may be fewer where the kind suits few places.
      seed: of everything.
    """
    firsts, found = offsets(towns), []
    for number in range(TRIES * num):
        town, rng = number % len(towns), np.random.default_rng([seed, number])
        sizes = RouteSizes(num_points=ROUTE_LENGTH + 1)
        way = route_generator.draw(towns[town], firsts[town], ROUTE_LENGTH, sizes, rng)
        placed = place_along(towns[town], firsts[town], way, rng, kinds=(kind,))
        if placed:
            found.append(Journey(way, placed[:1]))
        if len(found) == num:
            break
    return found


def measure(
    towns: Sequence[Town], journeys: Sequence[Journey], kind: str, driver: str, command: Command
) -> dict[str, Any]:
    """Lets one driver drive all routes of a kind."""
    bank = episodes.populate(towns, journeys, CONFIG.population, command.seed)
    nobody = bank.agents.replace(kind=jnp.zeros_like(bank.agents.kind))
    env = env_module.make_env(bank.replace(agents=nobody), CONFIG, RewardConfig())
    begun = time.perf_counter()
    fate = jax.tree.map(np.asarray, drive(env, driver, command.seed, command.seconds))
    began = np.maximum(fate.began.sum(), 1)
    survived = fate.began & fate.ended & ~fate.collided & ~fate.timed_out
    return {
        "benchmark": "scenarios",
        "kind": kind,
        "driver": driver,
        "maps": [town.network.name for town in towns],
        "num": len(journeys),
        "began": int(fate.began.sum()),
        **{
            f"{name}_frac": round(float((getattr(fate, name) & fate.began).sum() / began), 3)
            for name in ("collided", "left_lane", "left_road", "timed_out")
        },
        "survived_frac": round(float(survived.sum() / began), 3),
        "median_played_s": round(float(np.median(fate.played_s)), 1),
        "wall_s": round(time.perf_counter() - begun, 1),
    }


def drive(env: DrivingEnv, driver: str, seed: int, seconds: float) -> Fate:
    """(S,) how a driver fares on each route of an environment."""
    num = int(env.bank.num_episodes)
    keys = jax.random.split(jax.random.key(seed), num)
    steps = round(seconds / CONFIG.dt)
    return _drive(env, keys, jnp.arange(num), limits(env), driver, steps)


def limits(env: DrivingEnv) -> jax.Array:
    """(S,) m/s, the speed limit at each scenario's trigger."""
    trigger = env.bank.scenarios.trigger_s[:, :1]
    at = jnp.argmax(env.bank.routes.s >= trigger, axis=1)
    return env.bank.routes.speed_limit[jnp.arange(len(at)), at]


def drivers() -> dict[str, Callable[[jax.Array], Planner]]:
    """Drivers by name, made from the speed () m/s that the passive one keeps."""
    rule_based = {name: lambda _, planner=planner: planner for name, planner in PLANNERS.items()}
    return {"passive": passive, **rule_based}


def passive(speed: jax.Array) -> Planner:
    """Keeps to the route and to a speed, and does what it would do if the car obeyed.

    It steers a twin of the ego which nothing disturbs, and the ego likewise: so where the car does
    obey it keeps to the route, and elsewhere it does not steer back.
    """

    def act(env: DrivingEnv, sim: SimState, twin: EgoState) -> tuple[jax.Array, EgoState]:
        twin = jax.tree.map(
            lambda a, b: jnp.where(sim.scenarios.num_triggered > 0, a, b), twin, sim.ego
        )
        way = way_module.ahead(way_module.stretch(env, sim.replace(ego=twin)))
        accel = (speed - twin.speed) / env.config.dt
        action = controls.action(twin, way, accel, env.vehicle)
        obeyed = bicycle.step(twin, *bicycle.from_action(action), env.vehicle, env.config.dt)
        return action, obeyed

    def init(env: DrivingEnv) -> EgoState:
        return env_module.ego_at(jnp.zeros(2), jnp.float32(0.0), jnp.float32(0.0))

    return Planner(init, act)


@functools.partial(jax.jit, static_argnums=(4, 5))
def _drive(
    env: DrivingEnv,
    keys: jax.Array,
    episode: jax.Array,
    speed: jax.Array,
    driver: str,
    num_steps: int,
) -> Fate:
    def one(key: jax.Array, episode: jax.Array, speed: jax.Array) -> Fate:
        planner = drivers()[driver](speed)
        carry = begin(env, episode, key, speed), planner.init(env), NOTHING_YET

        def step(carry: tuple[State, Any, Fate], _: None) -> tuple[tuple[State, Any, Fate], None]:
            state, memory, fate = carry
            action, memory = planner.act(env, state.pipeline_state, memory)
            state = env.advance(state, action)
            return (state, memory, follow(fate, state, env)), None

        return jax.lax.scan(step, carry, None, length=num_steps)[0][2]

    return jax.vmap(one)(keys, episode, speed)


def begin(env: DrivingEnv, episode: jax.Array, key: jax.Array, speed: jax.Array) -> State:
    """The ego at speed on its route, shortly before the scenario is armed."""
    state = env.start_episode(episode, key)
    routes = env.bank.routes
    at = jnp.argmax(routes.s[episode] >= env.bank.scenarios.arm_s[episode, 0] - BEFORE)
    ego = state.pipeline_state.ego.replace(
        xy=routes.xy[episode, at], yaw=routes.yaw[episode, at], speed=speed
    )
    sim = state.pipeline_state.replace(ego=ego, route_idx=at.astype(jnp.int32))
    return state.replace(pipeline_state=sim)


def follow(fate: Fate, state: State, env: DrivingEnv) -> Fate:
    """What a step adds to how a drive goes."""
    sim, rules = state.pipeline_state, env.reward_config
    began = fate.began | (sim.scenarios.num_triggered > 0)
    ends = began & (sim.scenarios.ended_kind >= 0)
    plays = began & ~fate.ended
    counts = began & (fate.after_s < AFTER)
    touched = collision.touched(sim.ego, sim.agents, env.vehicle, rules.z_gap).any()
    return Fate(
        began=began,
        ended=fate.ended | ends,
        timed_out=fate.timed_out | (ends & sim.scenarios.has_timed_out),
        collided=fate.collided | (counts & touched),
        left_road=fate.left_road | (plays & (state.metrics["reward/off_road"] > 0)),
        left_lane=fate.left_lane | (plays & is_beyond_lane(sim, env)),
        played_s=fate.played_s + jnp.where(plays, env.config.dt, 0.0),
        after_s=fate.after_s + jnp.where(fate.ended, env.config.dt, 0.0),
    )


def is_beyond_lane(sim: SimState, env: DrivingEnv) -> jax.Array:
    """() bool: outside junctions, the ego's centre is past the edge of its route's lane."""
    stretch, first = route_module.window(env.bank.routes, sim.episode_idx, sim.route_idx)
    idx = sim.route_idx - first
    aside = geometry.to_frame(sim.ego.xy, stretch.xy[idx], stretch.yaw[idx])[1]
    return (jnp.abs(aside) > 0.5 * LANE_WIDTH) & ~stretch.in_junction[idx]


if __name__ == "__main__":
    sys.exit(main())
