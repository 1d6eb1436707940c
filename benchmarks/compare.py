"""Is NEW faster than BASE? `python benchmarks/compare.py BASE NEW --kinds sim update`.

Both are git revisions of this repository or directories of checkouts. The same benchmark is run in
turn, each time in a process of its own: BASE NEW, NEW BASE, BASE NEW, ... so that a machine whose
speed drifts slows both alike. A round gives one ratio NEW / BASE for each rate; their spread says
what a difference is worth. One JSON line and one to read for each rate.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import shlex
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from scipy import stats

ROOT = Path(__file__).resolve().parents[1]
OWN_SCRIPT = Path("benchmarks", "throughput.py")
LEAST_ROUNDS = 3
CONFIDENCE = 0.95
# Fields that tell two lines of one benchmark apart.
KEY = ("benchmark", "raster", "preset", "observation")

Kind = Literal["sim", "traffic", "render", "rollout", "update", "end_to_end"]


class CompareError(ValueError):
    """What can't be compared, in one line."""


@dataclasses.dataclass(frozen=True)
class Command:
    """What to compare."""

    base: tyro.conf.Positional[str]
    """Git revision, or directory of a checkout."""
    new: tyro.conf.Positional[str]
    """Likewise."""
    kinds: tuple[Kind, ...] = ("sim", "traffic", "render", "rollout", "update", "end_to_end")
    """Passed on to the benchmark."""
    rounds: int = 5
    """Pairs of runs, at least 3."""
    repeats: int = 5
    """Timed calls of each run; passed on."""
    script: Path = ROOT / OWN_SCRIPT
    """Benchmark that prints JSON lines with rates (`..._per_s`)."""
    own_scripts: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Run each side's own benchmarks/throughput.py, where they differ too much for one."""
    options: str = ""
    """Passed on to the benchmark, as in --options="--preset carl-carla"."""


@dataclasses.dataclass(frozen=True)
class Side:
    """One of the two.

    Attributes:
      name: as the user gave it.
      root: its checkout.
      script: benchmark to run.
    """

    name: str
    root: Path
    script: Path


Rates = dict[str, float]  # by benchmark and unit, of one run


def main(argv: Sequence[str] | None = None) -> int:
    """Compares and prints.

    Args:
      argv: arguments; those of the process by default.

    Returns:
      Exit status: 2 after a mistake in what the user gave, said in one line.
    """
    command = tyro.cli(Command, args=argv, description=__doc__)
    try:
        check(command)
        both = {"base": command.base, "new": command.new}
        with tempfile.TemporaryDirectory(prefix="carljax-compare-") as folder:
            sides = [side(command, name, Path(folder) / at) for at, name in both.items()]
            rounds = list(run_rounds(command, sides, Path(folder)))
            for line in compare(rounds):
                print(json.dumps({**line, **both}))
                print(sentence(line), flush=True)
    except CompareError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def check(command: Command) -> None:
    """Looks at numbers before anything is run.

    Raises:
      CompareError: one that makes no sense.
    """
    if command.rounds < LEAST_ROUNDS:
        raise CompareError(f"--rounds {command.rounds}: is below the least, {LEAST_ROUNDS}")
    if not command.own_scripts and not command.script.is_file():
        raise CompareError(f"--script {command.script}: there is no such file")


def side(command: Command, name: str, folder: Path) -> Side:
    """Finds what one side runs.

    Args:
      command: which benchmark.
      name: as the user gave it.
      folder: where a revision is unpacked.

    Raises:
      CompareError: there is no such side, or no benchmark of its own.
    """
    root, script = checkout(name, folder), command.script.resolve()
    if command.own_scripts:
        script = root / OWN_SCRIPT
        if not script.is_file():
            raise CompareError(f"{name}: there is no {OWN_SCRIPT} in it")
    return Side(name, root, script)


def checkout(name: str, folder: Path) -> Path:
    """The directory of one side.

    Args:
      name: a directory or a git revision of this repository.
      folder: where a revision is unpacked; it does not exist yet.

    Raises:
      CompareError: it is neither, or has no package in it.
    """
    root = Path(name).resolve()
    if not Path(name).is_dir():
        root = folder
        root.mkdir(parents=True)
        git = ["git", "-C", str(ROOT), "archive", "--format=tar", name]
        archive = subprocess.run(git, capture_output=True, check=False)
        if archive.returncode:
            raise CompareError(f"{name}: is neither a directory nor a git revision of {ROOT}")
        subprocess.run(["tar", "-x", "-C", str(root)], input=archive.stdout, check=True)
    if not (root / "carljax" / "__init__.py").is_file():
        raise CompareError(f"{name}: there is no package carljax in it")
    return root


def run_rounds(
    command: Command, sides: Sequence[Side], folder: Path
) -> Iterator[tuple[Rates, Rates]]:
    """Runs both sides in turn, the order swapped from round to round.

    Yields:
      Rates of BASE and of NEW.

    Raises:
      CompareError: a run failed.
    """
    for number in range(command.rounds):
        order = (0, 1) if number % 2 == 0 else (1, 0)
        rates = {at: run(command, sides[at], folder) for at in order}
        print(f"round {number + 1} of {command.rounds}", file=sys.stderr, flush=True)
        yield rates[0], rates[1]


def run(command: Command, side: Side, folder: Path) -> Rates:
    """Runs the benchmark once on one side, in a process of its own.

    Raises:
      CompareError: it failed, or said nothing.
    """
    env = dict(os.environ, PYTHONPATH=str(side.root))
    # Compiled once for each side, so that later rounds only measure.
    env.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder / "cache"))
    asked = ["--kinds", *command.kinds, "--repeats", str(command.repeats)]
    asked += shlex.split(command.options)
    ran = subprocess.run(
        [sys.executable, str(side.script), *asked],
        capture_output=True,
        text=True,
        env=env,
        cwd=side.root,
        check=False,
    )
    if ran.returncode:
        said = ran.stderr.strip().splitlines() or ["no message"]
        raise CompareError(f"{side.name}: {side.script.name} failed: {said[-1]}")
    rates = read_rates(ran.stdout)
    if not rates:
        raise CompareError(f"{side.name}: {side.script.name} printed no rate")
    return rates


def read_rates(output: str) -> Rates:
    """Finds the rates in a benchmark's output.

    Args:
      output: JSON lines; others are passed over.

    Returns:
      {"benchmark part unit": rate}.
    """
    rates: Rates = {}
    for text in output.splitlines():
        with contextlib.suppress(json.JSONDecodeError):
            line = json.loads(text)
            if isinstance(line, dict) and "benchmark" in line:
                name = " ".join(str(line[field]) for field in KEY if field in line)
                units = [unit for unit in line if unit.endswith("_per_s")]
                rates |= {f"{name} {unit}": line[unit] for unit in units}
    # The machine's speed is no rate of the program.
    return {name: rate for name, rate in rates.items() if "peak" not in name}


def compare(rounds: Sequence[tuple[Rates, Rates]]) -> list[dict[str, Any]]:
    """Puts the rounds together.

    Args:
      rounds: rates of BASE and NEW, at least two rounds.

    Returns:
      For each rate that both have in every round: both medians and their `ratio` NEW / BASE; the
      ratios of the rounds (`median`, `min`, `max`); and the interval in which the mean ratio lies
      with a probability of 95 %, by Student's t of the ratios' logarithms.
    """
    names = [name for name in rounds[0][0] if all(name in r for pair in rounds for r in pair)]
    lines = []
    for name in names:
        base, new = ([pair[side][name] for pair in rounds] for side in (0, 1))
        ratios = [b / a for a, b in zip(base, new, strict=True)]
        medians = statistics.median(base), statistics.median(new)
        lines.append(
            {
                "benchmark": "compare",
                "rate": name,
                "rounds": len(rounds),
                "base_median": medians[0],
                "new_median": medians[1],
                "ratio": medians[1] / medians[0],
                "paired": {
                    "median": statistics.median(ratios),
                    "min": min(ratios),
                    "max": max(ratios),
                },
                "interval_95": interval(ratios),
            }
        )
    return lines


def interval(ratios: Sequence[float]) -> list[float]:
    """Low and high end of the mean ratio's confidence interval; see `compare`."""
    logs = [math.log(ratio) for ratio in ratios]
    middle, deviation = statistics.mean(logs), statistics.stdev(logs)
    quantile = float(stats.t.ppf(0.5 + CONFIDENCE / 2, len(logs) - 1))
    reach = quantile * deviation / math.sqrt(len(logs))
    return [math.exp(middle - reach), math.exp(middle + reach)]


def sentence(line: dict[str, Any]) -> str:
    """One line of `compare` to read."""
    low, high = line["interval_95"]
    verdict = "no difference shown"
    if low > 1.0:
        verdict = "NEW is faster"
    if high < 1.0:
        verdict = "NEW is slower"
    return (
        f"{line['rate']}: NEW / BASE = {line['ratio']:.3f} "
        f"(95 % of pairs' mean: {low:.3f} to {high:.3f}, {line['rounds']} rounds): {verdict}"
    )


if __name__ == "__main__":
    sys.exit(main())
