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
import math
import re
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import tyro
from rich.console import Console

from carljax import (
    ablations,
    atomic,
    build,
    checkpoint,
    compile_cache,
    courses,
    evaluate,
    experiment_report,
    presets,
    seeds,
    time_budget,
)
from carljax import config as config_module
from carljax.ablations import ABLATIONS, Cell
from carljax.compile_cache import CacheFolder
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
            "cpu-preset",
        ]
    ]
    """The table."""
    seeds: int = 3
    """Trainings of each cell."""
    first_seed: int = 0
    """Seed of the first of them; the others follow. It is the seed of everybody's routes too."""
    samples: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Environment steps of a training; the preset's own by default."""
    minutes: Annotated[float | None, tyro.conf.arg(metavar="MIN")] = None
    """Instead of samples: as many as this machine makes in so much time, measured for each cell in
    turn with the first one before anything is trained, so do nothing else on it meanwhile."""
    preset: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Preset that the cells are changes of; this machine's default."""
    dir: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Where everything is kept; experiments/NAME by default."""
    seeds_at_once: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Seeds trained in one program; as many as fit into the memory by default."""
    compile_cache: CacheFolder = None
    """Folder for compiled programs, or `off` for none; the user's cache folder by default."""


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
    base = _check(command)
    ablation = ABLATIONS[command.name]
    folder = command.dir or Path("experiments") / command.name
    for cell in ablation.cells:
        config = ablations.configure(cell, base, 1)
        config.validate(config.run.num_devices or jax.device_count())
    compile_cache.enable(command.compile_cache)
    plan = _plan(ablation.cells, base, command, folder / PLAN_FILE, console)
    console.print(f"{ablation.title}: {len(plan)} cells, {command.seeds} seeds, {folder}")
    for cell, config in plan:
        if not _train(cell, config, command, folder, console):
            console.print("stopped; the same command goes on from here")
            return 0
    rows = [
        Row(
            cell.name,
            action,
            config.ppo.total_samples,
            tuple(_score_files(cell, action, command, folder)),
        )
        for cell, config in plan
        for action in cell.actions
    ]
    experiment_report.write(rows, ablation.title, folder)
    experiment_report.show(rows, ablation.title, console)
    console.print(f"table, numbers and plot: {folder}")
    return 0


def _check(command: Command) -> TrainConfig:
    """The preset, after checking what was given."""
    for name in ("seeds", "samples", "seeds_at_once"):
        value = getattr(command, name)
        if value is not None and value < 1:
            flag = name.replace("_", "-")
            raise ConfigError(f"--{flag} {value}: is below the least allowed, 1")
    if command.minutes is not None and not 0.0 < command.minutes < math.inf:
        raise ConfigError(f"--minutes {command.minutes}: is not a number above 0")
    if command.minutes is not None and command.samples is not None:
        raise ConfigError("--minutes and --samples exclude each other; give one of them")
    own = ABLATIONS[command.name].preset
    name = command.preset or own or presets.default_name()
    if own is not None and name != own:
        raise ConfigError(f"--preset {name}: {command.name} is about the preset {own}")
    if name not in presets.PRESETS:
        raise ConfigError(f"--preset {name}: is none of {', '.join(presets.PRESETS)}")
    last = command.first_seed + command.seeds - 1
    if not 0 <= command.first_seed <= last < HELD_OUT_SEED:
        raise ConfigError(f"--first-seed {command.first_seed}: is not from 0 to {HELD_OUT_SEED}")
    base = presets.PRESETS[name].config
    shared = dataclasses.replace(base.run, routes_seed=command.first_seed)
    return dataclasses.replace(base, run=shared)


def _plan(
    cells: Sequence[Cell], base: TrainConfig, command: Command, path: Path, console: Console
) -> Plan:
    """Each cell with its configuration: as begun in the folder, or newly made and noted there."""
    begun = _read(path)
    asked: dict[str, Any] = {
        "name": command.name,
        "first_seed": command.first_seed,
        "minutes": command.minutes,
    }
    _check_same(path, begun, asked)
    if begun and command.minutes is not None:
        samples = _measured_before(path, begun, cells)
    else:
        samples = _samples(cells, base, command, console)
    plan = [(cell, ablations.configure(cell, base, samples[cell.name])) for cell in cells]
    asked["samples"] = samples
    asked["cells"] = {cell.name: config_module.to_json(config) for cell, config in plan}
    _check_same(path, begun, asked)
    if not begun:
        atomic.write_text(path, json.dumps(asked, indent=2) + "\n")
    return plan


def _read(path: Path) -> dict[str, Any]:
    """What a folder notes of its experiment; nothing if none was begun there."""
    if not path.exists():
        return {}
    try:
        begun = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: can't be read: {error}") from error
    if not isinstance(begun, dict):
        raise ConfigError(f"{path}: is no experiment's plan")
    return begun


def _check_same(path: Path, begun: dict[str, Any], asked: dict[str, Any]) -> None:
    """Checks that what was begun, if anything was, is what is asked for."""
    for name, value in json.loads(json.dumps(asked)).items():
        if begun and begun.get(name) != value:
            raise ConfigError(
                f"{path}: was begun with other values of {name}; give those, or another --dir"
            )


def _measured_before(path: Path, begun: dict[str, Any], cells: Sequence[Cell]) -> dict[str, int]:
    """Samples of each cell from the folder's note."""
    samples = begun.get("samples")
    for cell in cells:
        number = samples.get(cell.name) if isinstance(samples, dict) else None
        if type(number) is not int or number < 1:
            raise ConfigError(f"{path}: samples: has no whole number above 0 for {cell.name!r}")
    return {cell.name: begun["samples"][cell.name] for cell in cells}


def _samples(
    cells: Sequence[Cell], base: TrainConfig, command: Command, console: Console
) -> dict[str, int]:
    """Samples that each cell is to be trained with; measured if minutes are given."""
    if command.minutes is None:
        return {cell.name: command.samples or base.ppo.total_samples for cell in cells}
    rates = time_budget.samples_per_second([ablations.configure(cell, base, 1) for cell in cells])
    samples = {}
    for cell, rate in zip(cells, rates, strict=True):
        samples[cell.name] = max(round(60.0 * command.minutes * rate), 1)
        console.print(f"{cell.name}: {rate:,.0f} samples/s")
    return samples


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
