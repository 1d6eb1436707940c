"""`python -m carljax.experiments NAME`: trains, scores and tabulates one of the paper's tables.

Every cell is trained with several seeds and scored on `carljax-36`. Each run has a directory of its
own, DIR/CELL/seed-K, as `carljax.train` makes them. A command that was cut off goes on when it is
given again: what is trained is not trained again, what is scored is not scored again. At the end
there are DIR/table.md, DIR/results.json and DIR/plot.png.
"""

from __future__ import annotations

import dataclasses
import gc
import json
import re
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import jax
import tyro
from rich.console import Console

from carljax import (
    ablations,
    atomic,
    build,
    checkpoint,
    courses,
    evaluate,
    experiment_report,
    presets,
    seeds,
)
from carljax import config as config_module
from carljax.ablations import ABLATIONS, Cell
from carljax.config import HELD_OUT_SEED, Action, ConfigError, TrainConfig
from carljax.courses import Course
from carljax.drive import NetworkPolicy
from carljax.experiment_report import Row
from carljax.ppo.networks import ActorCritic

PROG = "python -m carljax.experiments"
PLAN_FILE = "experiment.json"

Plan = Sequence[tuple[Cell, TrainConfig]]


@dataclasses.dataclass(frozen=True)
class Command:
    """Which table, at what scale."""

    name: tyro.conf.Positional[
        Literal[
            "reward-minibatch",
            "hyperparameters",
            "scale",
            "epochs",
            "architecture",
            "action-distribution",
            "input",
        ]
    ]
    """The table."""
    seeds: int = 3
    """Trainings of each cell."""
    first_seed: int = 0
    """Seed of the first of them; the others follow. It is the seed of everybody's routes too."""
    samples: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Environment steps of a training; the preset's own by default."""
    preset: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Preset that the cells are changes of; this machine's default."""
    dir: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Where everything is kept; experiments/NAME by default."""
    seeds_at_once: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Seeds trained in one program; as many as fit into the memory by default."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command.

    Args:
      argv: arguments; those of the process by default.

    Returns:
      Exit status: 2 after a mistake in what the user gave, said in one line.
    """
    command = tyro.cli(
        Command, args=argv, prog=PROG, description=__doc__, config=(tyro.conf.FlagCreatePairsOff,)
    )
    try:
        return run(command, Console())
    except evaluate.USER_ERRORS as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def run(command: Command, console: Console) -> int:
    """Trains and scores all that is missing, then reports.

    Args:
      command: what is wanted.
      console: where it prints.

    Returns:
      Exit status.
    """
    base, samples = _check(command)
    ablation = ABLATIONS[command.name]
    folder = command.dir or Path("experiments") / command.name
    plan = [(cell, ablations.configure(cell, base, samples)) for cell in ablation.cells]
    for _, config in plan:
        config.validate(config.run.num_devices or jax.device_count())
    _open(folder, command, samples, plan)
    console.print(f"{ablation.title}: {len(plan)} cells, {command.seeds} seeds, {folder}")
    for cell, config in plan:
        if not _train(cell, config, command, folder, console):
            console.print("stopped; the same command goes on from here")
            return 0
    rows = [
        Row(cell.name, action, tuple(_score_files(cell, action, command, folder)))
        for cell in ablation.cells
        for action in cell.actions
    ]
    experiment_report.write(rows, ablation.title, folder)
    experiment_report.show(rows, ablation.title, console)
    console.print(f"table, numbers and plot: {folder}")
    return 0


def _check(command: Command) -> tuple[TrainConfig, int]:
    """The preset and the number of samples, after checking what was given."""
    for name in ("seeds", "samples", "seeds_at_once"):
        value = getattr(command, name)
        if value is not None and value < 1:
            flag = name.replace("_", "-")
            raise ConfigError(f"--{flag} {value}: is below the least allowed, 1")
    name = command.preset or presets.default_name()
    if name not in presets.PRESETS:
        raise ConfigError(f"--preset {name}: is none of {', '.join(presets.PRESETS)}")
    last = command.first_seed + command.seeds - 1
    if not 0 <= command.first_seed <= last < HELD_OUT_SEED:
        raise ConfigError(f"--first-seed {command.first_seed}: is not from 0 to {HELD_OUT_SEED}")
    base = presets.PRESETS[name].config
    shared = dataclasses.replace(base.run, routes_seed=command.first_seed)
    return dataclasses.replace(base, run=shared), command.samples or base.ppo.total_samples


def _open(folder: Path, command: Command, samples: int, plan: Plan) -> None:
    """Notes what is run in a folder, or checks that it is what was begun there."""
    wanted = {
        "name": command.name,
        "samples": samples,
        "first_seed": command.first_seed,
        "cells": {cell.name: config_module.to_json(config) for cell, config in plan},
    }
    path = folder / PLAN_FILE
    if not path.exists():
        atomic.write_text(path, json.dumps(wanted, indent=2) + "\n")
        return
    try:
        begun = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: can't be read: {error}") from error
    for name, value in json.loads(json.dumps(wanted)).items():
        if begun.get(name) != value:
            raise ConfigError(
                f"{path}: was begun with other values of {name}; give those, or another --dir"
            )


def _train(
    cell: Cell, config: TrainConfig, command: Command, folder: Path, console: Console
) -> bool:
    """Trains and scores what is missing of a cell; False if it was interrupted."""
    numbers = range(command.first_seed, command.first_seed + command.seeds)
    home = folder / slug(cell.name)
    missing = [n for n in numbers if not _is_scored(cell, seeds.folder(home, n))]
    if not missing:
        console.print(f"{cell.name}: done before")
        return True
    console.print(f"{cell.name}")
    untrained = [n for n in missing if not _is_trained(config, seeds.folder(home, n))]
    if untrained:
        made = build.setup(config)
        most = command.seeds_at_once or seeds.num_at_once(made)
        for group in seeds.groups(untrained, most, home):
            if not seeds.train(made, group, home, console):
                return False
        del made
        gc.collect()
    course = courses.carljax_36(config)
    for number in missing:
        _score(cell, config, course, seeds.folder(home, number), console)
    return True


def _is_trained(config: TrainConfig, folder: Path) -> bool:
    return config.ppo.num_updates in checkpoint.updates(folder)


def _is_scored(cell: Cell, folder: Path) -> bool:
    return all((folder / score_file(action)).exists() for action in cell.actions)


def score_file(action: Action) -> str:
    """Name of the scores by one statistic of the policy, in a run's directory."""
    return f"evaluation-{action}.json"


def _score_files(cell: Cell, action: Action, command: Command, folder: Path) -> list[Path]:
    numbers = range(command.first_seed, command.first_seed + command.seeds)
    home = folder / slug(cell.name)
    return [seeds.folder(home, n) / score_file(action) for n in numbers]


def _score(cell: Cell, config: TrainConfig, course: Course, folder: Path, console: Console) -> None:
    """Drives a course with a trained run, once for each action that is asked for."""
    network = ActorCritic(config.network)
    first = jax.eval_shape(lambda env: env.reset(jax.random.key(0)), course.env)
    batch = jax.tree.map(lambda x: jax.ShapeDtypeStruct((1, *x.shape), x.dtype), first.obs)
    like = jax.eval_shape(network.init, jax.random.key(0), batch)
    params = checkpoint.restore_params(folder, like, config.ppo.num_updates)
    for action in cell.actions:
        since = time.perf_counter()
        result = evaluate.evaluate(course, NetworkPolicy(params, network, action))
        evaluate.save(
            result,
            folder / score_file(action),
            time.perf_counter() - since,
            course=course.title,
            policy=str(folder),
            update=config.ppo.num_updates,
            action=action,
        )
        score, completion = result.driving_score[0], result.completion[0]
        console.print(f"{folder} ({action}): DS {score:.1f}, RC {completion:.1f}")


def slug(name: str) -> str:
    """A cell's name as a folder's."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


if __name__ == "__main__":
    sys.exit(main())
