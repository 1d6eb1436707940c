"""How many samples a machine makes in a given time, measured before a training of that length."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from typing import Any

from carljax import build, timing
from carljax.config import TrainConfig
from carljax.ppo import trainer

REPEATS = 7  # timed updates of a configuration, after one that compiles and one that is not timed

# Makes an update and returns its seconds.
Update = Callable[[], float]


def samples_per_second(configs: Sequence[TrainConfig]) -> list[float]:
    """Trains each configuration for a few updates and forgets them.

    A machine's speed drifts by a quarter within minutes, more than what is compared. So each
    configuration is timed in turn with the first one, and what counts is the ratio of the two.

    Args:
      configs: of trainings, at least one; their devices are used as they will use them.

    Returns:
      Samples of rollout and update together per second of each: the first one's from the median
      of all its updates, the others' from that and the medians that were timed in turn.

    Raises:
      As `build.setup`.
    """
    first, *others = configs
    first_update = _updates(first)
    pairs = [_in_turn(first_update, _updates(config)) for config in others]
    alone = [] if pairs else [first_update() for _ in range(REPEATS)]
    seconds = statistics.median([*alone, *(time for pair in pairs for time in pair[0])])
    rates = [first.ppo.batch_size / seconds]
    for config, (firsts, own) in zip(others, pairs, strict=True):
        slower = statistics.median(own) / statistics.median(firsts)
        rates.append(config.ppo.batch_size / (seconds * slower))
    return rates


def _in_turn(a: Update, b: Update) -> tuple[list[float], list[float]]:
    """Returns the seconds of both, one after the other again and again."""
    pairs = [(a(), b()) for _ in range(REPEATS)]
    return [pair[0] for pair in pairs], [pair[1] for pair in pairs]


def _updates(config: TrainConfig) -> Update:
    """Returns what makes the next update of a training; its first two are made already."""
    made = build.setup(config)
    train_step = trainer.make_train_step(made.network, config.ppo, made.mesh, made.storage)
    state: Any = build.initial_state(made)

    def update() -> float:
        nonlocal state
        seconds, (state, *_) = timing.timed(train_step, made.env, state)
        return seconds

    update()
    update()
    return update
