"""How many samples a machine makes in a given time, measured before a training of that length."""

from __future__ import annotations

import statistics
from typing import Any

from carljax import build, timing
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
    first = build.initial_state(made)
    train_step = trainer.make_train_step(made.network, config.ppo, made.mesh, made.storage)

    def follow(result: Any) -> tuple:
        return made.env, first if result is None else result[0]

    seconds = timing.call_seconds(train_step, follow, REPEATS, warm_up=2)
    return config.ppo.batch_size / statistics.median(seconds)
