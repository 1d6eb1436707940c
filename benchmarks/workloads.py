"""The programs that `throughput.py` and `scaling.py` time: simulator, image, rollout, update, all.

A workload is a jitted function with its first arguments and what one call of it makes.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import measure
from jax.sharding import PartitionSpec
from measure import Workload

from carljax import build
from carljax.config import TrainConfig
from carljax.ppo import trainer
from carljax.ppo.config import PPOConfig
from carljax.ppo.networks import ActorCritic
from carljax.ppo.rollout import rollout
from carljax.ppo.types import Minibatch, TrainState
from carljax.ppo.update import update
from carljax.sim import autoreset, episodes
from carljax.sim.env import DrivingEnv, EnvConfig, make_env
from carljax.sim.town import Town
from carljax.sim.types import State

ACTION = (0.0, 0.3)  # straight on with some throttle


def environment(
    config: TrainConfig, towns: list[Town], num_routes: int, num_agents: int, **env: Any
) -> DrivingEnv:
    """An environment of all towns with other values than the configuration's.

    Args:
      config: everything else.
      towns: where.
      num_routes: in the bank.
      num_agents: vehicles of traffic.
      **env: further fields of `EnvConfig`.
    """
    values: EnvConfig = dataclasses.replace(config.env, num_agents=num_agents, **env)
    bank = episodes.make_bank(
        towns, num_routes, values.population, 0, values.route_length, values.scenario_spacing
    )
    return make_env(bank, values, config.reward)


def sim(env: DrivingEnv, num_envs: int, num_steps: int) -> Workload:
    """Steps without observation and network, ended episodes restarted."""

    def steps(env: DrivingEnv, state: State) -> State:
        def step(state: State, t: jax.Array) -> tuple[State, None]:
            keys = jax.random.split(jax.random.fold_in(jax.random.key(1), t), num_envs)
            action = jnp.tile(jnp.array(ACTION, jnp.float32), (num_envs, 1))
            return autoreset.advance(env, state, action, keys), None

        return jax.lax.scan(step, state, jnp.arange(num_steps))[0]

    keys = jax.random.split(jax.random.key(0), num_envs)
    state = jax.jit(jax.vmap(DrivingEnv.start, in_axes=(None, 0)))(env, keys)
    num_agents = env.config.num_agents
    env_steps = num_envs * num_steps
    return Workload(
        name="sim",
        program=measure.jit(steps),
        given=(env, state),
        units={"agent_steps": env_steps * num_agents, "env_steps": env_steps},
        sizes={"num_envs": num_envs, "num_agents": num_agents, "num_steps": num_steps},
    )


def render(env: DrivingEnv, num_envs: int, num_steps: int) -> Workload:
    """Observations one after the other, as in a rollout; only the ego turns a little."""
    episodes = jnp.arange(num_envs) % env.bank.num_episodes

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

        return jax.lax.scan(frame, state, None, length=num_steps)[0]

    return Workload(
        name="render",
        program=measure.jit(frames),
        given=(env, state),
        units={"frames": num_envs * num_steps},
        sizes={
            "num_envs": num_envs,
            "num_steps": num_steps,
            "num_agents": env.config.num_agents,
            "observation": env.config.observation,
            "shape": list(state.obs.raster.shape[1:]),
        },
    )


@dataclasses.dataclass(frozen=True)
class Learner:
    """A training before its first update, on some devices.

    Attributes:
      made: see `build.Setup`.
      state: the first training state.
    """

    made: build.Setup
    state: TrainState

    @property
    def ppo(self) -> PPOConfig:
        """The learner's configuration."""
        return self.made.config.ppo

    @property
    def sizes(self) -> dict[str, Any]:
        """What a line should say of it."""
        ppo = self.ppo
        return {
            "num_devices": self.made.mesh.size,
            "num_envs": ppo.num_envs,
            "num_steps": ppo.num_steps,
            "minibatch_size": ppo.minibatch_size,
            "micro_batch_size": ppo.micro_batch_size,
            "update_epochs": ppo.update_epochs,
            "encoder": self.made.config.network.encoder,
            "obs_storage": self.made.storage.name,
            "shape": list(self.state.env_state.obs.raster.shape[1:]),
        }


def learner(
    config: TrainConfig, towns: list[Town], num_routes: int, num_devices: int = 1
) -> Learner:
    """Sets up a training.

    Args:
      config: of the training; its own maps, devices and number of routes do not matter.
      towns: where.
      num_routes: in the bank.
      num_devices: the first ones of this process.

    Raises:
      ValueError: there are fewer devices, or sizes don't divide evenly.
    """
    mesh = trainer.make_mesh(num_devices)
    env = build.environment(config, towns, num_routes, seed=0)
    network = ActorCritic(config.network)
    storage = build.obs_storage_on(mesh, config)
    made = build.Setup(config, towns, trainer.replicate(env, mesh), network, mesh, storage)
    return Learner(made, build.initial_state(made))


def collect(learner: Learner) -> Workload:
    """Observation, network, sampled action, simulator and advantages; images are stored."""
    made, ppo = learner.made, learner.ppo
    program = measure.jit(functools.partial(_collect, network=made.network, ppo=ppo))
    return _of(learner, "rollout", program, (made.env, learner.state))


def learn(learner: Learner) -> Workload:
    """All epochs on one batch from the first parameters; needs a learner on one device."""
    made, state = learner.made, learner.state
    rolled = collect(learner)
    program = jax.shard_map(
        functools.partial(update, network=made.network, config=learner.ppo),
        mesh=made.mesh,
        in_specs=PartitionSpec(),
        out_specs=PartitionSpec(),
        check_vma=False,
    )
    samples = rolled.program(*rolled.given)
    given = (state.params, state.opt_state, samples, state.key, jnp.float32(1e-4))
    return _of(learner, "update", measure.jit(program), given)


def train(learner: Learner) -> Workload:
    """The whole train step, with the storage of training; it consumes the learner's state."""
    made = learner.made
    program = trainer.make_train_step(made.network, learner.ppo, made.mesh, made.storage)
    workload = _of(learner, "end_to_end", program, (made.env, learner.state))
    return dataclasses.replace(workload, follow=lambda result: (made.env, result[0]))


def _of(learner: Learner, name: str, program: Any, given: tuple) -> Workload:
    return Workload(
        name=name,
        program=program,
        given=given,
        units={"samples": learner.ppo.batch_size},
        sizes=learner.sizes,
        num_devices=learner.made.mesh.size,
    )


def _collect(env: DrivingEnv, state: TrainState, network: ActorCritic, ppo: PPOConfig) -> Minibatch:
    """A rollout with its advantages."""
    keys = jax.random.split(state.key, ppo.num_envs)
    _, batch, last_value, _ = rollout(
        env, network, state.params, state.env_state, keys, ppo.num_steps
    )
    return trainer.make_samples(batch, last_value, ppo)
