"""How many samples a machine makes in a given time, measured before a training of that length."""

from __future__ import annotations

import statistics
import time

import jax

from carljax import build
from carljax.config import TrainConfig
from carljax.ppo import trainer

REPEATS = 7  # timed updates, after one that compiles and one that is not timed


def samples_per_second(config: TrainConfig) -> float:
    """Trains for a few updates and forgets them.

    Args:
      config: of the training; its devices are used as it will use them.

    Returns:
      Samples of rollout and update together per second, from the median time of an update.

    Raises:
      As `build.setup`.
    """
    made = build.setup(config)
    state = build.initial_state(made)
    train_step = trainer.make_train_step(made.network, config.ppo, made.mesh)
    seconds = []
    for _ in range(REPEATS + 2):
        since = time.perf_counter()
        state, metrics = train_step(made.env, state)
        jax.block_until_ready((state, metrics))
        seconds.append(time.perf_counter() - since)
    return config.ppo.batch_size / statistics.median(seconds[2:])
