"""What must hold of every reward whoever drives: `python benchmarks/reward_invariants.py`.

Drivers with random pedals who steer along the route more or less well, in traffic, for a million
steps of each reward; one JSON line for each. The status is 1 where an invariant was broken:

- progress adds up to 0 ... 100 percent of an episode's route, and route completion never exceeds it
- soft factors are in [0, 1]
- rewards of progress (CaRL's) add up to 100 at most
- a terminal penalty is paid once, on the last step, exactly where the episode ended with a cause
  that costs one, and is of its size
- an episode that ends has a cause, one that goes on has none, and every number is finite
"""

from __future__ import annotations

import dataclasses
import functools
import json
import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from flax import struct

from carljax import machine
from carljax.reward import reward, roach, think2drive
from carljax.reward.config import RewardConfig
from carljax.reward.think2drive import Think2DriveConfig
from carljax.sim import episodes, geometry, route, town, towns
from carljax.sim.env import DrivingEnv, EnvConfig, make_env
from carljax.sim.raster_canvas import RasterConfig
from carljax.sim.types import State

CHUNK = 500  # steps a call
SLACK = 1e-2  # percent, rounding of a thousand float32 increments
LOOK_AHEAD = 5  # route points to the one that is steered for
# Short enough for time limits and standing still to happen.
LIMITS = {"time_limit_s": 40.0, "blocked_s": 6.0, "think2drive": Think2DriveConfig(blocked_s=6.0)}
# Causes that cost a terminal penalty.
PENALISED = {
    "carl": ("collision", "red_light"),
    "carl-nuplan": ("collision",),
    "carl-nuplan-survival": ("collision",),
    "carl-nuplan-tuned": ("collision",),
    "roach": roach.CAUSES,
    "think2drive": think2drive.FAILURES,
}
OF_SPEED = ("roach", "think2drive")  # the penalty is 1 and for some the speed on top; else just 1


@dataclasses.dataclass(frozen=True)
class Command:
    """What to drive."""

    rewards: tuple[str, ...] = tuple(reward.REWARDS)
    """Rewards by name."""
    steps: int = 1_000_000
    """Steps for each reward, over all environments."""
    num_envs: int = 256
    """Environments at once."""
    num_routes: int = 64
    """Routes in the bank, in the grid and the village."""
    seed: int = 0
    """Of drivers, routes and traffic."""


class Driver(struct.PyTreeNode):
    """What an environment's driver is at.

    Attributes:
      pedal: () held for a while.
      drift: () added to the steering, held for a while.
    """

    pedal: jax.Array
    drift: jax.Array


class Sums(struct.PyTreeNode):
    """What an episode has added up to, all ().

    Attributes:
      reward: sum of rewards.
      progress: sum of progress, percent.
      penalty: sum of terminal penalties.
      num_penalties: int32, steps with one.
    """

    reward: jax.Array
    progress: jax.Array
    penalty: jax.Array
    num_penalties: jax.Array


class Tally(struct.PyTreeNode):
    """What a step has shown of one environment.

    Attributes:
      broken: {invariant: () bool}.
      ended: () bool.
      causes: {name: () bool} of an end.
      progress, reward: () of an episode that has ended, else 0.
    """

    broken: dict[str, jax.Array]
    ended: jax.Array
    causes: dict[str, jax.Array]
    progress: jax.Array
    reward: jax.Array


def main() -> int:
    """Drives and prints."""
    command = tyro.cli(Command, description=__doc__)
    unknown = set(command.rewards) - set(reward.REWARDS)
    if unknown:
        print(f"error: --rewards: no such reward: {', '.join(sorted(unknown))}", file=sys.stderr)
        return 2
    env = environment(command.num_routes, command.seed)
    status = 0
    for name in command.rewards:
        line = measure(env, name, command.num_envs, command.steps, command.seed)
        print(json.dumps({**line, "machine": machine.describe()}), flush=True)
        status |= any(line["broken"].values())
    return status


def environment(num_routes: int, seed: int, num_scenario_slots: int = 1) -> DrivingEnv:
    """Short routes among cars, pedestrians and scenarios."""
    config = EnvConfig(
        num_agents=8,
        num_pedestrians=4,
        num_scenario_slots=num_scenario_slots,
        route_length=200.0,
        raster=RasterConfig(16, 16, pixels_per_metre=0.5, ego_from_bottom_px=4),
    )
    there = [town.load(towns.path(name)) for name in ("grid", "village")]
    spacing = 60.0 if num_scenario_slots else None
    bank = episodes.make_bank(there, num_routes, config.population, seed, 200.0, spacing)
    return make_env(bank, config, RewardConfig())


def measure(
    env: DrivingEnv, name: str, num_envs: int, num_steps: int, seed: int = 0
) -> dict[str, Any]:
    """Drives by one reward and counts what it breaks.

    Args:
      env: the environment; its reward does not matter.
      name: of the reward.
      num_envs: at once.
      num_steps: over all environments, at least.
      seed: of drivers and traffic.

    Returns:
      Numbers of steps, episodes, ends by cause and broken invariants; extremes of the sums.
    """
    env = env.replace(reward_config=RewardConfig(name=name, **LIMITS))
    keys = jax.random.split(jax.random.key(seed), num_envs)
    carry, begun, tallies = _begin(env, keys), time.perf_counter(), []
    chunk = min(CHUNK, -(-num_steps // num_envs))
    for number in range(-(-num_steps // (num_envs * chunk))):
        carry, tally = _drive(env, carry, jnp.int32(number), chunk)
        tallies.append(jax.tree.map(np.asarray, tally))
    tally = jax.tree.map(lambda *x: np.concatenate(x), *tallies)
    sums = tally.progress[tally.ended], tally.reward[tally.ended]
    return {
        "benchmark": "reward_invariants",
        "reward": name,
        "steps": tally.ended.size,
        "episodes": int(tally.ended.sum()),
        "ends": {cause: int(of.sum()) for cause, of in tally.causes.items()},
        "progress": [round(float(f(sums[0])), 3) for f in (np.min, np.mean, np.max)],
        "return": [round(float(f(sums[1])), 3) for f in (np.min, np.mean, np.max)],
        "broken": {what: int(of.sum()) for what, of in tally.broken.items()},
        "wall_s": round(time.perf_counter() - begun, 1),
    }


Carry = tuple[State, Driver, Sums, jax.Array]


@jax.jit
def _begin(env: DrivingEnv, keys: jax.Array) -> Carry:
    states = jax.vmap(env.start)(keys)
    zeros = jnp.zeros(keys.shape, jnp.float32)
    sums = Sums(zeros, zeros, zeros, zeros.astype(jnp.int32))
    return states, Driver(zeros, zeros), sums, keys


@functools.partial(jax.jit, static_argnames="num_steps")
def _drive(env: DrivingEnv, carry: Carry, chunk: jax.Array, num_steps: int) -> tuple[Carry, Tally]:
    """The next steps of all environments; an ended one starts anew in the same step."""

    def one(state: State, driver: Driver, sums: Sums, key: jax.Array, t: jax.Array) -> Any:
        key_t = jax.random.fold_in(jax.random.fold_in(key, chunk), t)
        key_driver, key_start = jax.random.split(key_t)
        driver, action = act(env, state, driver, key_driver)
        after = env.advance(state, action)
        sums = _add(sums, after)
        tally = check(after, sums, env.reward_config)
        ended = after.done > 0
        fresh = env.start(key_start)
        state = jax.tree.map(lambda a, b: jnp.where(ended, a, b), fresh, after)
        sums = jax.tree.map(lambda x: jnp.where(ended, jnp.zeros_like(x), x), sums)
        return (state, driver, sums, key), tally

    def step(carry: Carry, t: jax.Array) -> tuple[Carry, Tally]:
        return jax.vmap(one, in_axes=(0, 0, 0, 0, None))(*carry, t)

    return jax.lax.scan(step, carry, jnp.arange(num_steps))


def act(env: DrivingEnv, state: State, driver: Driver, key: jax.Array) -> tuple[Driver, jax.Array]:
    """Steers for a point of the route, with a drift; the pedal is any, more often throttle.

    Args:
      env: the environment.
      state: unbatched.
      driver: what it was at.
      key: PRNG key.

    Returns:
      What it is at now, and the (2,) action.
    """
    key_turn, key_pedal, key_drift, key_wild = jax.random.split(key, 4)
    changes = jax.random.uniform(key_turn) < 0.04
    pedal = jnp.clip(0.5 + 0.5 * jax.random.normal(key_pedal), -1.0, 0.8)
    drift = 0.1 * jax.random.normal(key_drift)
    drift = jnp.where(jax.random.uniform(key_wild) < 0.15, 8.0 * drift, drift)
    driver = Driver(
        pedal=jnp.where(changes, pedal, driver.pedal),
        drift=jnp.where(changes, drift, driver.drift),
    )
    sim = state.pipeline_state
    stretch, first = route.window(env.bank.routes, sim.episode_idx, sim.route_idx)
    target = jnp.minimum(sim.route_idx - first + LOOK_AHEAD, stretch.num_points - 1)
    offset = geometry.to_frame(stretch.xy[target], sim.ego.xy, sim.ego.yaw)
    steer = jnp.arctan2(offset[1], jnp.maximum(offset[0], 0.5)) / env.vehicle.wheel_angle_max
    slow = jnp.where(sim.ego.speed > 9.0, -0.3, driver.pedal)
    return driver, jnp.clip(jnp.stack([steer + driver.drift, slow]), -1.0, 1.0)


def _add(sums: Sums, after: State) -> Sums:
    metrics, zero = after.metrics, jnp.zeros((), jnp.float32)
    penalty = metrics["reward/penalty"]
    return Sums(
        reward=sums.reward + after.reward,
        progress=sums.progress + metrics.get("reward/progress", zero),
        penalty=sums.penalty + penalty,
        num_penalties=sums.num_penalties + (penalty > 0).astype(jnp.int32),
    )


def check(after: State, sums: Sums, config: RewardConfig) -> Tally:
    """Looks at one step.

    Args:
      after: the state after it, unbatched.
      sums: of its episode, the step included.
      config: the reward.

    Returns:
      What was broken and how it ended.
    """
    chosen, metrics, ended = reward.chosen(config), after.metrics, after.done > 0
    causes = {name: metrics[f"reward/{name}"] > 0 for name in chosen.ends}
    stops = {k: v for k, v in causes.items() if k != "finished" or chosen.at_finish != "goes on"}
    any_cause = jnp.stack(list(stops.values())).any()
    soft = jnp.stack([jnp.zeros(()), *(metrics[f"reward/{name}"] for name in chosen.soft)])
    costs = jnp.stack([causes[name] for name in PENALISED[config.name]]).any()
    completion = metrics["episode/route_completion"]
    low = jnp.float32(1.0)
    high = low + jnp.where(config.name in OF_SPEED, after.pipeline_state.ego.speed, 0.0)
    size_is_off = (sums.penalty < low) | (sums.penalty > high)
    earns_progress = config.name.startswith("carl")
    broken = {
        "progress": (sums.progress < 0.0) | (sums.progress > 100.0 + SLACK),
        "completion": (completion < 0.0) | (completion > 100.0 + SLACK),
        "soft": ((soft < 0.0) | (soft > 1.0)).any(),
        "return": (sums.reward > 100.0 + SLACK) & earns_progress,
        "penalty": sums.num_penalties != (ended & costs).astype(jnp.int32),
        "penalty_size": ended & costs & size_is_off,
        "end": ended != any_cause,
        "finite": ~jnp.isfinite(jnp.stack([after.reward, *metrics.values()])).all(),
    }
    return Tally(
        broken=broken,
        ended=ended,
        causes={name: ended & value for name, value in causes.items()},
        progress=jnp.where(ended, sums.progress, 0.0),
        reward=jnp.where(ended, sums.reward, 0.0),
    )


if __name__ == "__main__":
    sys.exit(main())
