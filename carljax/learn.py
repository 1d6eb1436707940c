"""The loop around the compiled train step: it logs, saves, and stops when asked."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import FrameType

import jax
from rich.console import Console

from carljax import checkpoint, distributed, metrics_log
from carljax.build import Setup
from carljax.metrics_log import MetricsLog, Report, WindowMean
from carljax.ppo import trainer
from carljax.ppo.types import TrainState

SCORE = "episode/return"  # what makes a checkpoint the best, a mean over run.best_window updates


def learn(made: Setup, state: TrainState, path: Path, console: Console) -> TrainState:
    """Makes updates until the run is complete or the user interrupts.

    The first interrupt ends the loop after the current update, with a checkpoint; a second one ends
    the program at once. Of several processes all stop after the same update, whichever of them is
    interrupted; the first one logs, and all save together.

    Args:
      made: see `build.setup`.
      state: first or restored training state; consumed.
      path: the run's directory.
      console: where the progress is shown.

    Returns:
      The last training state, which is also the newest checkpoint.
    """
    run, ppo = made.config.run, made.config.ppo
    start = int(state.update)
    train_step = trainer.make_train_step(made.network, ppo, made.mesh, made.storage)
    before_start = [line for line in metrics_log.read(path) if line["update"] <= start]
    window = WindowMean(run.best_window, [line.get(SCORE) for line in before_start])
    with (
        MetricsLog(path, start) if distributed.is_first() else nullcontext() as log,
        Report(console, start, ppo.num_updates) as report,
        interrupts() as interrupted,
    ):
        since, before = time.perf_counter(), start
        for update in range(start + 1, ppo.num_updates + 1):
            state, on_device = train_step(made.env, state)
            if update % run.log_every == 0 or update in (start + 1, ppo.num_updates):
                metrics = on_host(on_device)
                seconds = time.perf_counter() - since
                metrics |= speed(seconds, (update - before) * ppo.batch_size, update == start + 1)
                since, before = time.perf_counter(), update
                if log is not None:
                    log.write(update, update * ppo.batch_size, metrics)
                window.add(metrics[SCORE])
                report.show(update, metrics)
            last = update == ppo.num_updates or distributed.any_process(bool(interrupted))
            if last or update % run.checkpoint_every == 0:
                checkpoint.save(path, state, update, window.mean, run.keep_checkpoints)
            if last:
                break
    return state


def on_host(on_device: Mapping[str, jax.Array]) -> dict[str, float]:
    """Fetches metrics; means over episodes are NaN where none ended."""
    metrics = {name: float(value) for name, value in jax.device_get(on_device).items()}
    if metrics["episode/num"] == 0:
        for name in metrics:
            if name.startswith("episode/") and name != "episode/num":
                metrics[name] = math.nan
    return metrics


def speed(seconds: float, samples: int, is_first: bool) -> dict[str, float]:
    """Names the time taken: the first update's is mostly compilation."""
    if is_first:
        return {"time/first_update_s": seconds}
    return {"time/env_steps_per_s": samples / seconds}


@contextmanager
def interrupts() -> Iterator[list[int]]:
    """Collects the first SIGINT or SIGTERM in a list, after which they act as usual again."""
    received: list[int] = []
    kinds = (signal.SIGINT, signal.SIGTERM)
    usual = {kind: signal.getsignal(kind) for kind in kinds}

    def note(kind: int, frame: FrameType | None) -> None:
        received.append(kind)
        restore()

    def restore() -> None:
        for kind, handler in usual.items():
            signal.signal(kind, handler)

    for kind in kinds:
        signal.signal(kind, note)
    try:
        yield received
    finally:
        restore()
