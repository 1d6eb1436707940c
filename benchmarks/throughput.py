"""How fast it runs: `python benchmarks/throughput.py`, one JSON line for each measurement.

Each figure is the median over repeats, with compilation and a first call left out and every call
waited for. A line carries the sizes, the versions and the machine, so it can stand by itself in a
commit or an issue.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, Literal

import jax
import jax.numpy as jnp
import tyro
from jax.sharding import PartitionSpec

from carljax import build, machine, presets
from carljax.config import TrainConfig
from carljax.ppo import trainer
from carljax.ppo.config import PPOConfig
from carljax.ppo.networks import ActorCritic
from carljax.ppo.rollout import rollout
from carljax.ppo.types import Minibatch, TrainState
from carljax.ppo.update import update
from carljax.sim import episodes
from carljax.sim.env import DrivingEnv, ObservationKind, make_env
from carljax.sim.observation import KINDS
from carljax.sim.raster_canvas import RasterConfig
from carljax.sim.town import Town
from carljax.sim.types import State

SIM_ENVS, SIM_AGENTS, SIM_STEPS = 64, 32, 50
RENDER_ENVS, RENDER_AGENTS, RENDER_STEPS = 32, 50, 20

Kind = Literal["sim", "render", "rollout", "update", "end_to_end"]


@dataclasses.dataclass(frozen=True)
class Command:
    """What to measure."""

    preset: Literal["cpu", "carl-carla", "atari"] = "cpu"
    """Configuration of rollout, update and end_to_end."""
    kinds: tuple[Kind, ...] = ("sim", "render", "rollout", "update", "end_to_end")
    """Measurements to make."""
    repeats: int = 7
    """Timed calls, at least 5."""
    num_routes: int = 64
    """Routes in the bank."""
    observation: ObservationKind = "carla"
    """What `render` draws, at the size of the preset `cpu` and at its authors' size."""


def main() -> int:
    """Measures and prints."""
    command = tyro.cli(Command, description=__doc__)
    if command.repeats < 5:
        print(f"error: --repeats {command.repeats}: a median needs at least 5", file=sys.stderr)
        return 2
    config = presets.PRESETS[command.preset].config
    towns = build.load_towns(config.run.maps)
    for line in measure(command, config, towns):
        print(json.dumps({**line, "machine": machine.describe()}), flush=True)
    return 0


def measure(command: Command, config: TrainConfig, towns: list[Town]) -> Iterator[dict[str, Any]]:
    """Makes the measurements that were asked for, one dict each."""
    if "sim" in command.kinds:
        yield sim(command, config, towns)
    if "render" in command.kinds:
        kind = command.observation
        full = "carl-carla" if kind == "carla" else kind
        for name, raster in (("cpu", presets.CPU.env.raster), (full, KINDS[kind].raster)):
            yield {"raster": name, **render(command, config, towns, raster)}
    if {"rollout", "update", "end_to_end"} & set(command.kinds):
        yield from learning(command, config, towns)


def sim(command: Command, config: TrainConfig, towns: list[Town]) -> dict[str, Any]:
    """Steps without observation and network, ended episodes restarted."""
    env = small_env(command, config, towns, SIM_AGENTS, config.env.raster)

    def one(env: DrivingEnv, state: State, key: jax.Array) -> State:
        fresh, moved = env.start(key), env.advance(state, jnp.array([0.0, 0.3], jnp.float32))
        return jax.tree.map(lambda a, b: jnp.where(state.done > 0, a, b), fresh, moved)

    def steps(env: DrivingEnv, state: State) -> State:
        def step(state: State, t: jax.Array) -> tuple[State, None]:
            keys = jax.random.split(jax.random.fold_in(jax.random.key(1), t), SIM_ENVS)
            return jax.vmap(one, in_axes=(None, 0, 0))(env, state, keys), None

        return jax.lax.scan(step, state, jnp.arange(SIM_STEPS))[0]

    keys = jax.random.split(jax.random.key(0), SIM_ENVS)
    state = jax.jit(jax.vmap(DrivingEnv.start, in_axes=(None, 0)))(env, keys)
    seconds = timed(jit(steps), lambda _: (env, state), command.repeats)
    count = SIM_ENVS * SIM_AGENTS * SIM_STEPS
    return {
        "benchmark": "sim",
        "agent_steps_per_s": count / seconds,
        "env_steps_per_s": count / SIM_AGENTS / seconds,
        "num_envs": SIM_ENVS,
        "num_agents": SIM_AGENTS,
        "num_steps": SIM_STEPS,
    }


def render(
    command: Command, config: TrainConfig, towns: list[Town], raster: RasterConfig
) -> dict[str, Any]:
    """Observations one after the other, as in a rollout; only the ego turns a little."""
    seen = dataclasses.replace(config.env, observation=command.observation)
    config = dataclasses.replace(config, env=seen)
    env = small_env(command, config, towns, RENDER_AGENTS, raster)
    episodes = jnp.arange(RENDER_ENVS) % env.bank.num_episodes

    def first(env: DrivingEnv, episode: jax.Array) -> State:
        key = jax.random.fold_in(jax.random.key(0), episode)
        return env.observe(env.start_episode(episode, key))

    state = jax.jit(jax.vmap(first, in_axes=(None, 0)))(env, episodes)

    def turn(state: State) -> State:
        sim = state.pipeline_state
        ego = sim.ego.replace(yaw=sim.ego.yaw + jnp.float32(0.01))
        return state.replace(pipeline_state=sim.replace(ego=ego))

    def frames(env: DrivingEnv, state: State) -> State:
        def frame(state: State, _: None) -> tuple[State, None]:
            return jax.vmap(lambda one: env.observe(turn(one)))(state), None

        return jax.lax.scan(frame, state, None, length=RENDER_STEPS)[0]

    seconds = timed(jit(frames), lambda _: (env, state), command.repeats)
    return {
        "benchmark": "render",
        "frames_per_s": RENDER_ENVS * RENDER_STEPS / seconds,
        "num_envs": RENDER_ENVS,
        "num_steps": RENDER_STEPS,
        "num_agents": RENDER_AGENTS,
        "observation": command.observation,
        "shape": list(state.obs.raster.shape[1:]),
    }


def learning(command: Command, config: TrainConfig, towns: list[Town]) -> Iterator[dict[str, Any]]:
    """Rollout, update and the whole train step of a preset, on one device."""
    mesh = trainer.make_mesh(1)
    env = build.environment(config, towns, command.num_routes, seed=0)
    network = ActorCritic(config.network)
    made = build.Setup(config, towns, trainer.replicate(env, mesh), network, mesh)
    state = build.initial_state(made)
    ppo = config.ppo
    sizes = {
        "preset": command.preset,
        "num_envs": ppo.num_envs,
        "num_steps": ppo.num_steps,
        "minibatch_size": ppo.minibatch_size,
        "micro_batch_size": ppo.micro_batch_size,
        "update_epochs": ppo.update_epochs,
        "encoder": config.network.encoder,
        "shape": list(state.env_state.obs.raster.shape[1:]),
    }

    def line(name: str, seconds: float) -> dict[str, Any]:
        return {"benchmark": name, "samples_per_s": ppo.batch_size / seconds, **sizes}

    collect = jit(functools.partial(collect_samples, network=network, ppo=ppo))
    if "rollout" in command.kinds:
        yield line("rollout", timed(collect, lambda _: (made.env, state), command.repeats))
    if "update" in command.kinds:
        samples = collect(made.env, state)
        learn = jit(
            jax.shard_map(
                functools.partial(update, network=network, config=ppo),
                mesh=mesh,
                in_specs=PartitionSpec(),
                out_specs=PartitionSpec(),
                check_vma=False,
            )
        )
        given = (state.params, state.opt_state, samples, state.key, jnp.float32(1e-4))
        yield line("update", timed(learn, lambda _: given, command.repeats))
    if "end_to_end" in command.kinds:
        train_step = trainer.make_train_step(network, ppo, mesh)

        def follow(result: Any) -> tuple:
            return made.env, state if result is None else result[0]

        yield line("end_to_end", timed(train_step, follow, command.repeats))


def collect_samples(
    env: DrivingEnv, state: TrainState, network: ActorCritic, ppo: PPOConfig
) -> Minibatch:
    """A rollout with its advantages."""
    keys = jax.random.split(state.key, ppo.num_envs)
    _, batch, last_value, _ = rollout(
        env, network, state.params, state.env_state, keys, ppo.num_steps
    )
    return trainer.make_samples(batch, last_value, ppo)


def small_env(
    command: Command, config: TrainConfig, towns: list[Town], num_agents: int, raster: RasterConfig
) -> DrivingEnv:
    """An environment of all towns with another number of agents and image."""
    values = dataclasses.replace(config.env, num_agents=num_agents, raster=raster)
    bank = episodes.make_bank(towns, command.num_routes, values.population, 0, values.route_length)
    return make_env(bank, values, config.reward)


def jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compiles with the options of the train step."""
    return jax.jit(function, compiler_options=trainer.compiler_options(jax.default_backend()))


def timed(function: Callable[..., Any], arguments: Callable[[Any], tuple], repeats: int) -> float:
    """Median seconds of a call.

    Args:
      function: jitted.
      arguments: makes a call's arguments from the last call's result, None before the first.
      repeats: timed calls, after one that is not.

    Returns:
      Seconds.
    """
    result = jax.block_until_ready(function(*arguments(None)))
    seconds = []
    for _ in range(repeats):
        given = jax.block_until_ready(arguments(result))
        begin = time.perf_counter()
        result = jax.block_until_ready(function(*given))
        seconds.append(time.perf_counter() - begin)
    return statistics.median(seconds)


if __name__ == "__main__":
    sys.exit(main())
