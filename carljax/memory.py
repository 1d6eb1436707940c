"""How much memory a training run will take, worked out from shapes before anything is allocated."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp

from carljax import build
from carljax.build import Setup
from carljax.ppo.rollout import rollout
from carljax.ppo.types import TrainState, Transition
from carljax.sim.env import DrivingEnv


@dataclasses.dataclass(frozen=True)
class MemoryEstimate:
    """Memory on one device.

    Attributes:
      parts: {what: bytes}.
      available: bytes that one device may use.
    """

    parts: dict[str, int]
    available: int

    @property
    def total(self) -> int:
        """Sum of the parts, bytes."""
        return sum(self.parts.values())

    @property
    def fits(self) -> bool:
        """Whether the parts fit into what is available."""
        return self.total <= self.available


def estimate(made: Setup) -> tuple[int, MemoryEstimate]:
    """Works out the size of the network and the memory of a run, allocating nothing.

    Args:
      made: see `build.setup`.

    Returns:
      Number of parameters, and the memory on one device.
    """
    state, batch = jax.eval_shape(lambda env: _first_batch(env, made), made.env)
    ppo, num_devices = made.config.ppo, made.mesh.size
    at_once = ppo.micro_batch_size or ppo.minibatch_size // num_devices
    obs = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct((at_once, *x.shape[1:]), x.dtype), state.env_state.obs
    )
    parts = {
        "towns and routes": tree_bytes(made.env),
        "parameters, gradients, optimiser": 2 * tree_bytes(state.params)
        + tree_bytes(state.opt_state),
        "environment states": tree_bytes(state.env_state),
        f"batch of {ppo.batch_size // num_devices:,} samples ({made.storage.name})": tree_bytes(
            batch
        ),
        f"activations of {at_once} samples (at most)": activation_bytes(
            made.network, state.params, obs
        ),
        # The compiler gives rollout and update each room of its own.
        "layers while acting": forward_bytes(made.network, state.params, state.env_state.obs),
    }
    available = build.memory_of_device(made.mesh)
    return count(state.params), MemoryEstimate(parts, available)


def _first_batch(env: DrivingEnv, made: Setup) -> tuple[TrainState, Transition]:
    """A training state with the environments of one device, and what they collect."""
    ppo, num_devices = made.config.ppo, made.mesh.size
    state = build.initial_state(dataclasses.replace(made, env=env))
    local = jax.tree.map(lambda x: x[: x.shape[0] // num_devices], state.env_state)
    keys = jax.random.split(state.key, ppo.num_envs // num_devices)
    batch = rollout(
        env, made.network, state.params, local, keys, ppo.num_steps, storage=made.storage
    )[1]
    return state.replace(env_state=local), batch


def tree_bytes(tree: Any) -> int:
    """Adds up the bytes of all arrays (or their shapes) in a tree.

    Args:
      tree: a pytree of arrays or `jax.ShapeDtypeStruct`.

    Returns:
      Bytes; a random key counts its words.
    """
    return sum(_leaf_bytes(leaf) for leaf in jax.tree.leaves(tree))


def count(tree: Any) -> int:
    """Counts the numbers in a tree of arrays: the parameters of a network."""
    return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(tree))


def activation_bytes(network: Any, params: Any, obs: Any) -> int:
    """Estimates what a gradient keeps of the forward pass: all that the backward pass will read.

    Args:
      network: a flax module.
      params: its variables, or their shapes.
      obs: a batch of observations, or their shapes.

    Returns:
      Bytes; an estimate from above, since the compiler may recompute some of it.
    """
    return tree_bytes(_kept(network, params, obs))


def forward_bytes(network: Any, params: Any, obs: Any) -> int:
    """Estimates what the network needs to act: the largest layer's input and output at once.

    Args:
      network: a flax module.
      params: its variables, or their shapes.
      obs: a batch of observations, or their shapes.

    Returns:
      Bytes, without the observations.
    """
    kept = _kept(network, params, obs)
    return 2 * max(_leaf_bytes(leaf) for leaf in kept if jnp.issubdtype(leaf.dtype, jnp.floating))


def _kept(network: Any, params: Any, obs: Any) -> list[Any]:
    """Shapes of what a gradient keeps of the forward pass."""

    def backward(params: Any, obs: Any) -> Any:
        return jax.vjp(lambda p: network.apply(p, obs), params)[1]

    return jax.tree.leaves(jax.eval_shape(backward, params, obs))


def readable(num_bytes: float) -> str:
    """Writes a number of bytes for people: "3.2 GiB"."""
    for unit in ("B", "KiB", "MiB"):
        if num_bytes < 1024:
            return f"{num_bytes:.3g} {unit}"
        num_bytes /= 1024
    return f"{num_bytes:.3g} GiB"


def _leaf_bytes(leaf: Any) -> int:
    if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.eval_shape(jax.random.key_data, leaf)
    return math.prod(leaf.shape) * leaf.dtype.itemsize
