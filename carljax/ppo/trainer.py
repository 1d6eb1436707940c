"""The one XLA program: rollout, advantages and update of all devices as one jitted function.

Environments are shared out over the mesh axis "data"; parameters, optimiser state and the
environment's constant arrays are on every device. A mesh of one device runs the same code.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from carljax.ppo import kl_patience
from carljax.ppo.config import PPOConfig
from carljax.ppo.gae import gae
from carljax.ppo.kl_patience import KLPatience
from carljax.ppo.networks import ActorCritic
from carljax.ppo.obs_storage import STORE, ObsStorage
from carljax.ppo.rollout import mean_metrics, rollout
from carljax.ppo.types import Minibatch, TrainState, Transition
from carljax.ppo.update import (
    AXIS,
    explained_variance,
    flatten,
    learning_rate,
    make_optimizer,
    update,
)
from carljax.sim.autoreset import Env
from carljax.sim.types import State

_PLACES: dict[str, Any] = {
    "params": PartitionSpec(),
    "opt_state": PartitionSpec(),
    "env_state": PartitionSpec(AXIS),
    "key": PartitionSpec(),
    "update": PartitionSpec(),
    "patience": PartitionSpec(),
}
_SPEC = TrainState(**_PLACES)

TrainStep = Callable[[Env, TrainState], tuple[TrainState, dict[str, jax.Array]]]


def make_mesh(num_devices: int | None = None) -> Mesh:
    """Makes the mesh of the one axis "data", over as many devices of each process.

    Args:
      num_devices: of all processes together, the first ones of each; all by default.

    Returns:
      The mesh, a process's devices side by side.

    Raises:
      ValueError: there are fewer, or the processes can't have equally many.
    """
    devices = jax.devices()
    wanted = len(devices) if num_devices is None else num_devices
    if not 1 <= wanted <= len(devices):
        raise ValueError(f"{wanted} devices were asked for, but there are {len(devices)}")
    processes = sorted({device.process_index for device in devices})
    each = wanted // len(processes)
    chosen = [
        device
        for process in processes
        for device in [one for one in devices if one.process_index == process][:each]
    ]
    if len(chosen) != wanted:
        raise ValueError(f"{wanted} devices can't be shared equally by {len(processes)} processes")
    return Mesh(np.array(chosen), (AXIS,))


def shardings(mesh: Mesh) -> TrainState:
    """Returns the sharding of each part of a `TrainState`, a prefix tree for `jax.device_put`."""
    return jax.tree.map(
        lambda spec: NamedSharding(mesh, spec),
        _SPEC,
        is_leaf=lambda x: isinstance(x, PartitionSpec),
    )


def replicate(tree: Any, mesh: Mesh) -> Any:
    """Copies arrays to every device, once; else each call of the train step would do it.

    Of several processes each copies its own arrays, equal to those of the others, to its devices.
    """
    place = NamedSharding(mesh, PartitionSpec())
    if place.is_fully_addressable:
        return jax.device_put(tree, place)

    def copy(x: Any) -> jax.Array:
        whole = np.asarray(jnp.asarray(x))
        return jax.make_array_from_process_local_data(place, whole, whole.shape)

    return jax.tree.map(copy, tree)


def init(
    key: jax.Array, env: Env, network: ActorCritic, config: PPOConfig, mesh: Mesh
) -> TrainState:
    """Makes the first training state, each part where the train step wants it.

    Each device starts the environments that it will step, and nothing is sent between devices.

    Args:
      key: PRNG key of the run.
      env: unbatched environment, a pytree (see `replicate`).
      network: actor and critic.
      config: see `PPOConfig`.
      mesh: see `make_mesh`.

    Returns:
      The state before the first update.

    Raises:
      ValueError: sizes that don't divide evenly.
    """
    config.validate(mesh.size)

    start = jax.shard_map(
        functools.partial(_local_start, num_envs=config.num_envs // mesh.size),
        mesh=mesh,
        in_specs=PartitionSpec(),
        out_specs=PartitionSpec(AXIS),
        check_vma=False,
    )

    def build(key: jax.Array, env: Env) -> TrainState:
        key_params, key_env, key_run = jax.random.split(key, 3)
        env_state = start(env, key_env)
        # Of an observation the parameters take the shape alone.
        like = jax.tree.map(lambda x: jnp.zeros((1, *x.shape[1:]), x.dtype), env_state.obs)
        params = network.init(key_params, like)
        return TrainState(
            params=params,
            opt_state=make_optimizer(config).init(params),
            env_state=env_state,
            key=key_run,
            update=jnp.zeros((), jnp.int32),
            patience=None if config.kl_patience is None else kl_patience.start(),
        )

    return jax.jit(build, out_shardings=shardings(mesh))(key, env)


def make_train_step(
    network: ActorCritic, config: PPOConfig, mesh: Mesh, storage: ObsStorage = STORE
) -> TrainStep:
    """Compiles one PPO iteration: rollout, advantages, epochs x minibatches.

    Args:
      network: actor and critic.
      config: see `PPOConfig`.
      mesh: see `make_mesh`.
      storage: how observations are kept from rollout to update; the result is the same.

    Returns:
      train_step(env, train_state) -> (train_state, {name: () float32}). It consumes (donates) its
      train_state. Metrics are means over the rollout of the environment's own (see
      `rollout.mean_metrics`) and `ppo/...`.

    Raises:
      ValueError: sizes that don't divide evenly.
    """
    config.validate(mesh.size)
    # Said outright: on one device the compiler would call the result's sharding by another name
    # than that of the first state, and the second call would compile once more.
    out = (shardings(mesh), NamedSharding(mesh, PartitionSpec()))
    options = compiler_options(mesh.devices.flat[0].platform)
    step = _sharded_step(network, config, mesh, storage)
    return jax.jit(step, donate_argnums=1, out_shardings=out, compiler_options=options)


def make_seeds_step(
    network: ActorCritic, config: PPOConfig, mesh: Mesh, storage: ObsStorage = STORE
) -> TrainStep:
    """Compiles one PPO iteration of several independent runs, which share the environment's bank.

    Args:
      network: actor and critic.
      config: see `PPOConfig`.
      mesh: see `make_mesh`.
      storage: as in `make_train_step`.

    Returns:
      As `make_train_step`, with an axis of runs in front of the training state (see `stack`) and of
      the metrics.

    Raises:
      ValueError: sizes that don't divide evenly.
    """
    config.validate(mesh.size)
    out = (_with_runs(shardings(mesh)), NamedSharding(mesh, PartitionSpec()))
    options = compiler_options(mesh.devices.flat[0].platform)
    step = jax.vmap(_sharded_step(network, config, mesh, storage), in_axes=(None, 0))
    return jax.jit(step, donate_argnums=1, out_shardings=out, compiler_options=options)


def stack(states: Sequence[TrainState], mesh: Mesh) -> TrainState:
    """Puts training states side by side for `make_seeds_step`: a new axis in front."""
    join = jax.jit(
        lambda *states: jax.tree.map(lambda *x: jnp.stack(x), *states),
        out_shardings=_with_runs(shardings(mesh)),
    )
    return join(*states)


def unstack(state: TrainState, mesh: Mesh) -> list[TrainState]:
    """Takes `stack` apart."""
    pick = jax.jit(
        lambda state, i: jax.tree.map(lambda x: x[i], state), out_shardings=shardings(mesh)
    )
    return [pick(state, i) for i in range(state.update.shape[0])]


def _with_runs(places: TrainState) -> TrainState:
    """Shardings with an axis in front that is shared out over no devices."""
    return jax.tree.map(
        lambda place: NamedSharding(place.mesh, PartitionSpec(None, *place.spec)), places
    )


def _sharded_step(
    network: ActorCritic, config: PPOConfig, mesh: Mesh, storage: ObsStorage
) -> TrainStep:
    """One PPO iteration over all devices, not yet compiled."""
    local = functools.partial(_local_step, network=network, config=config, storage=storage)
    # Without check_vma a simulator may start its inner loops from constants, which vary over no
    # device. Nothing here rests on it: no collective is differentiated, and a test compares 1 and
    # 4 devices.
    return jax.shard_map(
        local,
        mesh=mesh,
        in_specs=(PartitionSpec(), _SPEC),
        out_specs=(_SPEC, PartitionSpec()),
        check_vma=False,
    )


def _local_start(env: Env, key: jax.Array, num_envs: int) -> State:
    """The first states of this device's environments, (num_envs,) in front."""
    first = jax.lax.axis_index(AXIS) * num_envs
    keys = _env_keys(key, first + jnp.arange(num_envs))
    return jax.vmap(lambda key: env.observe(env.start(key)))(keys)


def _local_step(
    env: Env,
    train_state: TrainState,
    network: ActorCritic,
    config: PPOConfig,
    storage: ObsStorage,
) -> tuple[TrainState, dict[str, jax.Array]]:
    """One PPO iteration on this device's environments."""
    device = jax.lax.axis_index(AXIS)
    num_envs = train_state.env_state.done.shape[0]
    key_rollout, key_shuffle = jax.random.split(
        jax.random.fold_in(train_state.key, train_state.update)
    )
    env_keys = _env_keys(key_rollout, device * num_envs + jnp.arange(num_envs))
    env_state, batch, last_value, metric_sums = rollout(
        env,
        network,
        train_state.params,
        train_state.env_state,
        env_keys,
        config.num_steps,
        keeps_policy=config.kl_patience is not None,
        keeps_hints=config.hint_coef > 0,
        storage=storage,
    )
    samples = make_samples(batch, last_value, config)
    rate = _rate(train_state, config)
    params, opt_state, losses = update(
        train_state.params,
        train_state.opt_state,
        samples,
        jax.random.fold_in(key_shuffle, device),
        rate,
        network,
        config,
        recall=lambda kept: jax.vmap(storage.recall, in_axes=(None, 0))(env, kept),
    )
    metrics = {f"ppo/{name}": value for name, value in losses.items()}
    metrics["ppo/explained_variance"] = explained_variance(samples)
    metrics["ppo/learning_rate"] = rate
    metrics |= _rollout_metrics(metric_sums, batch)
    train_state = TrainState(
        params=params,
        opt_state=opt_state,
        env_state=env_state,
        key=train_state.key,
        update=train_state.update + 1,
        patience=_patience(train_state, losses, config),
    )
    return train_state, metrics


def _rate(train_state: TrainState, config: PPOConfig) -> jax.Array:
    """Returns the () learning rate of this update."""
    rate = learning_rate(train_state.update, config)
    if train_state.patience is None:
        return rate
    return rate * train_state.patience.rate_scale


def _patience(
    train_state: TrainState, losses: dict[str, jax.Array], config: PPOConfig
) -> KLPatience | None:
    """Returns the next update's KL patience, if there is any."""
    if train_state.patience is None or config.kl_patience is None:
        return None
    exceeded = losses[kl_patience.KL] > config.target_kl
    return kl_patience.advance(train_state.patience, exceeded, config.kl_patience)


def make_samples(batch: Transition, last_value: jax.Array, config: PPOConfig) -> Minibatch:
    """Adds advantages and returns to a rollout and flattens it.

    Args:
      batch: (T, B) transitions.
      last_value: (B,) value of the states after the last step.
      config: discount, lambda and what a truncation is worth.

    Returns:
      (T * B,) samples.
    """
    terminated = batch.done
    if config.bootstrap_truncated:
        terminated = batch.done * (1.0 - batch.truncation)
    advantage = gae(
        batch.reward,
        batch.value,
        last_value,
        terminated,
        batch.weight,
        config.gamma,
        config.gae_lambda,
    )
    return flatten(batch, advantage)


def _rollout_metrics(sums: dict[str, jax.Array], batch: Transition) -> dict[str, jax.Array]:
    sums = {
        **sums,
        "rollout/reward": jnp.sum(batch.reward),
        "rollout/value": jnp.sum(batch.value * batch.weight),
    }
    counts = (jnp.sum(batch.weight), jnp.sum(batch.done))
    sums, counts = jax.lax.psum((sums, counts), AXIS)
    return mean_metrics(sums, *counts)


def _env_keys(key: jax.Array, indices: jax.Array) -> jax.Array:
    """Returns one key per environment, from its index among those of all devices."""
    return jax.vmap(lambda i: jax.random.fold_in(key, i))(indices)


def compiler_options(platform: str) -> dict[str, Any] | None:
    """Returns XLA options for the train step: on a CPU none of the fusions that run on one thread.

    jaxlib 0.10 hands some convolutions and products to YNNPACK, on one thread and up to four times
    slower. A jaxlib that doesn't know the option has no such fusion.
    """
    options = {"xla_cpu_experimental_ynn_fusion_type": ""}
    if platform != "cpu":
        return None
    return options if _is_known(tuple(options.items())) else None


@functools.cache
def _is_known(options: Sequence[tuple[str, Any]]) -> bool:
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        probe = jax.jit(lambda x: x, compiler_options=dict(options))
        try:
            probe(np.float32(0.0))
        except jax.errors.JaxRuntimeError:
            return False
    return True
