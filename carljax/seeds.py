"""Trains several seeds of one configuration in one program, and leaves a run directory of each.

All seeds drive on the same training routes (those of `run.routes_seed`), so the map is held once;
everything else is each run's own, number for number what it would be alone. While they train there
is one folder of checkpoints for all; at the end each has its own, as if it had been trained alone.
All of it is for one process: several hosts (`carljax.distributed`) train one run.
"""

from __future__ import annotations

import dataclasses
import shutil
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import jax
import numpy as np
from rich.console import Console

from carljax import build, checkpoint, learn, memory, metrics_log, run_dir
from carljax.build import Setup
from carljax.config import TrainConfig
from carljax.metrics_log import MetricsLog, Report, WindowMean
from carljax.ppo import trainer
from carljax.ppo.types import TrainState

TOGETHER = "together-"  # folder of the checkpoints of seeds that train together, and their numbers
MEMORY_FRAC = 0.8  # of a device's memory that several seeds may take


def num_at_once(made: Setup) -> int:
    """How many seeds fit into the memory of one device, at least 1."""
    _, estimate = memory.estimate(made)
    shared = estimate.parts["towns and routes"]
    own = max(estimate.total - shared, 1)
    return max(int((MEMORY_FRAC * estimate.available - shared) // own), 1)


def folder(home: Path, seed: int) -> Path:
    """The run directory of one seed."""
    return home / f"seed-{seed}"


def groups(untrained: Sequence[int], most: int, home: Path) -> list[tuple[int, ...]]:
    """Which seeds train together: those that have begun together, then as many as may.

    Args:
      untrained: seeds.
      most: how many may train together.
      home: folder of all of them.
    """
    begun = [
        tuple(int(number) for number in path.name.removeprefix(TOGETHER).split("-"))
        for path in sorted(home.glob(f"{TOGETHER}*"))
    ]
    begun = [group for group in begun if set(group) & set(untrained)]
    rest = [seed for seed in untrained if not any(seed in group for group in begun)]
    return begun + [tuple(rest[i : i + most]) for i in range(0, len(rest), most)]


def train(made: Setup, seeds: Sequence[int], home: Path, console: Console) -> bool:
    """Trains until all seeds have made all updates, or the user interrupts.

    Args:
      made: see `build.setup`; its own seed does not matter.
      seeds: one for each run.
      home: folder of their run directories (see `folder`), which need not exist.
      console: where the progress is shown.

    Returns:
      Whether all are trained; else the same call goes on where this one stopped.
    """
    folders = [folder(home, seed) for seed in seeds]
    configs = [_of_seed(made.config, *run) for run in zip(seeds, folders, strict=True)]
    for config, path in zip(configs, folders, strict=True):
        if not (path / run_dir.CONFIG_FILE).exists():
            run_dir.create(path, config)
    alone = [build.initial_state(dataclasses.replace(made, config=one)) for one in configs]
    state = trainer.stack(alone, made.mesh)
    del alone
    together = home / (TOGETHER + "-".join(str(seed) for seed in seeds))
    if checkpoint.updates(together):
        state = checkpoint.restore(together, like=state)
    state = _learn(made, state, folders, together, console)
    num_updates = made.config.ppo.num_updates
    if int(state.update[0]) < num_updates:
        return False
    run = made.config.run
    for one, path in zip(trainer.unstack(state, made.mesh), folders, strict=True):
        returns = [line.get(learn.SCORE) for line in metrics_log.read(path)]
        score = WindowMean(run.best_window, returns).mean
        checkpoint.save(path, one, num_updates, score, run.keep_checkpoints)
    shutil.rmtree(together)
    return True


def _of_seed(config: TrainConfig, seed: int, path: Path) -> TrainConfig:
    run = dataclasses.replace(config.run, seed=seed, dir=path)
    return dataclasses.replace(config, run=run)


def _learn(
    made: Setup, state: TrainState, folders: Sequence[Path], together: Path, console: Console
) -> TrainState:
    """The loop around the train step of all seeds; see `learn.learn` for that of one."""
    run, ppo = made.config.run, made.config.ppo
    start = int(state.update[0])
    train_step = trainer.make_seeds_step(made.network, ppo, made.mesh, made.storage)
    with ExitStack() as stack:
        logs = [stack.enter_context(MetricsLog(folder, start)) for folder in folders]
        report = stack.enter_context(Report(console, start, ppo.num_updates))
        interrupted = stack.enter_context(learn.interrupts())
        for update in range(start + 1, ppo.num_updates + 1):
            since = time.perf_counter()
            state, on_device = train_step(made.env, state)
            values = jax.device_get(on_device)
            seconds = time.perf_counter() - since
            spent = learn.speed(seconds, ppo.batch_size, update == start + 1)
            each = [
                learn.on_host({name: x[i] for name, x in values.items()}) | spent
                for i in range(len(folders))
            ]
            for log, metrics in zip(logs, each, strict=True):
                if update % run.log_every == 0 or update == ppo.num_updates:
                    log.write(update, update * ppo.batch_size, metrics)
            of_all = learn.speed(seconds, len(folders) * ppo.batch_size, update == start + 1)
            report.show(update, _mean(each) | of_all)
            last = bool(interrupted) or update == ppo.num_updates
            if last or update % run.checkpoint_every == 0:
                checkpoint.save(together, state, update, float("nan"), 1)
            if last:
                break
    return state


def _mean(each: Sequence[dict[str, float]]) -> dict[str, float]:
    """Means over seeds, of those that have a number."""
    means = {}
    for name in each[0]:
        values = [metrics[name] for metrics in each if np.isfinite(metrics[name])]
        means[name] = float(np.mean(values)) if values else float("nan")
    return means
