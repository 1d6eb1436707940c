"""`python -m carljax.train [PRESET] ...`: learn to drive, save, be scored on held-out routes."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import tyro
from rich.console import Console

from carljax import (
    build,
    checkpoint,
    compile_cache,
    config,
    courses,
    distributed,
    evaluate,
    learn,
    machine,
    memory,
    presets,
    run_dir,
    score_table,
)
from carljax.build import Setup
from carljax.checkpoint import CheckpointError
from carljax.config import ConfigError, TrainConfig
from carljax.distributed import Distributed
from carljax.drive import NetworkPolicy
from carljax.sim.road_network import MapError
from carljax.sim.route_generator import RouteError

PROG = "python -m carljax.train"
USER_ERRORS = (ConfigError, CheckpointError, MapError, RouteError)


@dataclasses.dataclass(frozen=True)
class Command:
    """What to train, field by field, and whether to start, to continue or only to look."""

    config: Annotated[TrainConfig, tyro.conf.arg(name="")]
    resume: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Continue the run in DIR exactly, from the beginning if it has no checkpoint yet; of its
    configuration only --run.* (but for seed, map and num-routes) and --ppo.total-samples may
    change."""
    dry_run: bool = False
    """Build everything, print configuration, size and memory, and stop."""
    distributed: Distributed = Distributed()
    """Several processes, on one or several hosts, that train as one."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command.

    Args:
      argv: arguments; those of the process by default.

    Returns:
      Exit status: 2 after a mistake in what the user gave, said in one line.
    """
    given = sys.argv[1:] if argv is None else list(argv)
    try:
        with distributed.joined(distributed.read(given), USER_ERRORS):
            with distributed.agreed():
                command = parse(given)
            return run(command, Console(quiet=not distributed.is_first()))
    except USER_ERRORS as error:
        if distributed.is_first():
            print(f"error: {error}", file=sys.stderr)
        return 2


def parse(argv: list[str]) -> Command:
    """Reads the command line; without a preset in front, this machine's default is meant.

    Args:
      argv: arguments.

    Returns:
      The command; with `--resume` its configuration starts from the run's own.

    Raises:
      ConfigError: `--resume` with a preset, without a run, or with another configuration.
    """
    has_preset = bool(argv) and (not argv[0].startswith("-") or argv[0] in ("-h", "--help"))
    given = argv if has_preset else [presets.default_name(), *argv]
    command = _parse_fresh(given, presets.PRESETS)
    kind = command.config.env.observation
    if command.resume is None and kind != presets.PRESETS[given[0]].config.env.observation:
        # Once more, so that what was not said has the values of this observation.
        command = _parse_fresh(given, presets.seen_as(kind))
    if command.resume is None:
        return command
    if has_preset:
        raise ConfigError(f"--resume {command.resume}: takes no preset: the run has its own values")
    saved = run_dir.load_config(command.resume)
    command = tyro.cli(
        Command,
        default=Command(saved),
        args=argv,
        prog=PROG,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    _check_same_experiment(saved, command.config)
    return dataclasses.replace(command, config=_with_run(command.config, dir=command.resume))


def _parse_fresh(argv: list[str], named: dict[str, presets.Preset]) -> Command:
    """Reads a command line that begins with a preset's name."""
    return tyro.extras.overridable_config_cli(
        {name: (preset.description, Command(preset.config)) for name, preset in named.items()},
        args=argv,
        prog=PROG,
        description=__doc__,
        config=(tyro.conf.FlagCreatePairsOff,),
    )


def run(command: Command, console: Console) -> int:
    """Does what the command says.

    Args:
      command: see `parse`.
      console: where it prints.

    Returns:
      Exit status.
    """
    wanted = command.config
    machine.offer_devices(wanted.run.num_devices)
    path = wanted.run.dir or Path(distributed.gather(str(run_dir.default_path()))[0])
    maps = tuple(file.resolve() for file in wanted.run.maps)
    banks = tuple(file.resolve() for file in wanted.run.routes)
    cache = compile_cache.absolute(wanted.run.compile_cache)
    wanted = _with_run(wanted, dir=path, maps=maps, routes=banks, compile_cache=cache)
    if not distributed.is_shared(compile_cache.enable(cache)):
        # What one process finds and another has to compile, XLA would let them tune together.
        compile_cache.enable(compile_cache.OFF)
    with distributed.agreed():
        if command.resume is None and distributed.is_first():
            run_dir.check_free(path)
        made = build.setup(wanted)
    given = str(config.to_json(wanted)), made.storage.name
    distributed.check_same("arguments, maps, routes or memory", given, made.env)
    describe(made, console)
    if command.dry_run:
        return 0
    state = build.initial_state(made)
    if command.resume is not None and checkpoint.updates(path):
        state = checkpoint.restore(path, like=state)
    open_run(path, wanted, is_new=command.resume is None)
    state = learn.learn(made, state, path, console)
    if int(state.update) < wanted.ppo.num_updates:
        console.print(f"stopped; continue with: {PROG} --resume {path}")
        return 0
    if wanted.run.eval_routes:
        score(made, state.params, path, console)
    console.print(f"run directory: {path}")
    return 0


def open_run(path: Path, wanted: TrainConfig, is_new: bool) -> None:
    """Notes in the run's directory that it begins or goes on, once for all processes.

    Raises:
      ConfigError: a map has changed, or the processes don't share the directory.
    """
    with distributed.agreed():
        if distributed.is_first():
            (run_dir.create if is_new else run_dir.reopen)(path, wanted)
    with distributed.agreed():
        if not (path / run_dir.CONFIG_FILE).exists():
            raise ConfigError(f"{path}: does not hold what process 0 has written: not shared?")


def score(made: Setup, params: Any, path: Path, console: Console) -> None:
    """Evaluates the policy on held-out routes; prints the table and writes evaluation.json.

    Of several processes each drives all routes, on one device of its own, so that none has to wait
    for another; the first one prints and writes.
    """
    course = courses.held_out(made.config, made.towns, made.config.run.eval_routes)
    since = time.perf_counter()
    action = made.config.run.eval_action
    policy = NetworkPolicy(jax.device_get(params), made.network, action)
    result = evaluate.evaluate(course, policy)
    seconds = time.perf_counter() - since
    score_table.show(result, console, title=course.title)
    if not distributed.is_first():
        return
    evaluate.save(result, path / evaluate.FILE, seconds, course=course.title, action=action)


def describe(made: Setup, console: Console) -> None:
    """Prints what is about to run: every value, the network's size, memory, devices."""
    for name, part in config.to_json(made.config).items():
        values = ", ".join(f"{field}={value}" for field, value in part.items())
        console.print(f"[bold]{name}[/bold]  {values}", highlight=False)
    names = ", ".join(town.network.name for town in made.towns)
    num_parameters, estimate = memory.estimate(made)
    ppo = made.config.ppo
    devices = made.mesh.devices.flat
    console.print(f"towns       {names}")
    console.print(f"parameters  {num_parameters:,}")
    console.print(f"updates     {ppo.num_updates:,} of {ppo.batch_size:,} samples")
    processes = distributed.num_processes()
    of_processes = f", of {processes} processes" if processes > 1 else ""
    console.print(f"devices     {made.mesh.size} x {devices[0].device_kind}{of_processes}")
    console.print("memory of one device, estimated:")
    for what, size in estimate.parts.items():
        console.print(f"  {memory.readable(size):>9}  {what}")
    verdict = "" if estimate.fits else "  [red]more than there is[/red]: set ppo.micro-batch-size"
    total, available = memory.readable(estimate.total), memory.readable(estimate.available)
    console.print(f"  {total:>9}  of {available}{verdict}")


def _with_run(values: TrainConfig, **changes: Any) -> TrainConfig:
    return dataclasses.replace(values, run=dataclasses.replace(values.run, **changes))


def _check_same_experiment(saved: TrainConfig, asked: TrainConfig) -> None:
    """Refuses changes that would make a continued run another one."""
    old, new = config.to_json(saved), config.to_json(asked)
    for part, fields in old.items():
        for name, value in fields.items():
            fixed = name in ("seed", "maps", "num_routes", "routes") if part == "run" else True
            if fixed and name != "total_samples" and new[part][name] != value:
                raise ConfigError(
                    f"{part}.{name}: is {value} in the run to be continued, can't become"
                    f" {new[part][name]}"
                )


if __name__ == "__main__":
    sys.exit(main())
