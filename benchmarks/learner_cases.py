"""What both learners of `learner_torch.py` are given: networks, batches, our update."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, Literal

import jax
import jax.numpy as jnp
import measure
import numpy as np
from jax.sharding import PartitionSpec

from carljax import presets
from carljax.ppo import trainer
from carljax.ppo.config import NetworkConfig, PPOConfig
from carljax.ppo.networks import ActorCritic
from carljax.ppo.types import Minibatch
from carljax.ppo.update import make_optimizer, update
from carljax.sim.types import Observation

Name = Literal["cpu", "roach", "carl"]

RATE = 2.5e-4  # of Adam, on both sides


@dataclasses.dataclass(frozen=True)
class Case:
    """A network with what it sees and how it learns.

    Attributes:
      network, ppo: its configuration; the update is plain PPO.
      image: rows, columns, channels.
      num_scalars, num_value_scalars: numbers seen besides.
      samples: of the batch, by default.
      micro: samples whose gradients are computed at once, by default.
    """

    network: NetworkConfig
    ppo: PPOConfig
    image: tuple[int, int, int]
    num_scalars: int
    num_value_scalars: int
    samples: int
    micro: int


CASES: dict[Name, Case] = {
    "cpu": Case(presets.CPU.network, presets.CPU.ppo, (64, 40, 10), 8, 10, 8192, 256),
    "roach": Case(
        presets.ROACH.network,
        dataclasses.replace(presets.ROACH.ppo, kl_patience=None, hint_coef=0.0),
        (192, 192, 15),
        6,
        3,
        1024,
        64,
    ),
    "carl": Case(
        presets.CARL_CARLA.network, presets.CARL_CARLA.ppo, (256, 256, 10), 8, 10, 1024, 64
    ),
}


def sized(case: Case, samples: int, minibatch: int, micro: int) -> Case:
    """The case with one epoch over a batch of another size.

    Args:
      case: network and losses.
      samples: of the batch.
      minibatch: of a gradient step.
      micro: whose gradients are computed at once.

    Raises:
      UsageError: they don't divide evenly.
    """
    for whole, part in ((samples, minibatch), (minibatch, micro)):
        if whole < 1 or part < 1 or whole % part:
            raise measure.UsageError(f"a batch of {whole} does not divide into parts of {part}")
    ppo = dataclasses.replace(
        case.ppo,
        num_envs=samples,
        num_steps=1,
        num_minibatches=samples // minibatch,
        micro_batch_size=micro,
        update_epochs=1,
    )
    return dataclasses.replace(case, samples=samples, micro=micro, ppo=ppo)


def batch(case: Case, seed: int = 0) -> Minibatch:
    """Samples drawn at random: half of the image's bytes are 0, some ratios and values clip."""
    rng, num = np.random.default_rng(seed), case.samples

    def normal(*shape: int) -> jax.Array:
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    raster = rng.integers(0, 256, (num, *case.image), np.uint8)
    raster *= rng.integers(0, 2, raster.shape, np.uint8)
    value = 0.3 * normal(num)
    return Minibatch(
        obs=Observation(
            raster=jnp.asarray(raster),
            scalars=normal(num, case.num_scalars),
            value_scalars=normal(num, case.num_value_scalars),
        ),
        action=jnp.asarray(rng.uniform(0.05, 0.95, (num, 2)), jnp.float32),
        log_prob=0.2 * normal(num),
        value=value,
        advantage=normal(num),
        target=value + normal(num),
        weight=jnp.ones(num, jnp.float32),
    )


def arguments(case: Case) -> tuple:
    """What our update is given: parameters, optimiser state, samples, key, learning rate."""
    samples, key = batch(case), jax.random.key(0)
    first = jax.tree.map(lambda x: x[:1], samples.obs)
    params = jax.jit(ActorCritic(case.network).init)(key, first)
    return params, make_optimizer(case.ppo).init(params), samples, key, jnp.float32(RATE)


def our_update(case: Case) -> Any:
    """The update, jitted with the options of the train step."""
    return measure.jit(
        jax.shard_map(
            functools.partial(update, network=ActorCritic(case.network), config=case.ppo),
            mesh=trainer.make_mesh(1),
            in_specs=PartitionSpec(),
            out_specs=PartitionSpec(),
            check_vma=False,
        )
    )
