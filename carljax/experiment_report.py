"""What an experiment has shown: one table and one plot, mean and deviation over seeds."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from carljax import atomic, machine, metrics_log
from carljax.score_table import RATES
from carljax.scores import mean_and_std

TABLE_FILE, NUMBERS_FILE, PLOT_FILE = "table.md", "results.json", "plot.png"
SHARES = ("DS", "RC", "clean")  # in %; a terminal of 80 columns has room for these
COLUMNS = (*SHARES, "Ped", "Veh", "Stat", "Red", "Stop", "Dev", "Block")
CURVE_POINTS = 40  # of a learning curve: means over a fortieth of the training


@dataclasses.dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes:
      name: of the cell.
      action: statistic of the policy that drove.
      num_samples: of each training.
      files: scores, one for each seed, each in its run's directory.
    """

    name: str
    action: str
    num_samples: int
    files: tuple[Path, ...]

    @property
    def label(self) -> str:
        """What the row is called; the mean, CaRL's own, goes without saying."""
        return self.name if self.action == "mean" else f"{self.name}, {self.action}"


def values(path: Path) -> dict[str, float]:
    """The columns of one file of scores."""
    scores = json.loads(path.read_text(encoding="utf-8"))["carljax"]
    per_km = scores["infractions_per_km"]
    rates = {head: sum(per_km[name] for name in names) for head, names in RATES.items()}
    return {
        "DS": scores["driving_score_mean"],
        "RC": scores["route_completion_mean"],
        "clean": scores["clean_completion_mean"],
        **{head: rate for head, rate in rates.items() if head in COLUMNS},
    }


def table(rows: Sequence[Row]) -> list[tuple[str, dict[str, tuple[float, float]]]]:
    """Label and {column: (mean, sample standard deviation over seeds)} of each row."""
    found = []
    for row in rows:
        runs = [values(path) for path in row.files]
        spread = {name: mean_and_std([run[name] for run in runs]) for name in COLUMNS}
        found.append((row.label, spread))
    return found


def write(rows: Sequence[Row], title: str, folder: Path) -> None:
    """Writes table, numbers and plot.

    Args:
      rows: of the table.
      title: of the experiment.
      folder: where.
    """
    found = table(rows)
    heads = ("", "seeds", "samples", *COLUMNS)
    lines = [f"# {title}", "", _line(heads), _line(["---"] * len(heads))]
    for row, (label, spread) in zip(rows, found, strict=True):
        cells = [_text(name, *spread[name], len(row.files)) for name in COLUMNS]
        lines.append(_line([label, str(len(row.files)), f"{row.num_samples:,}", *cells]))
    lines += ["", "Mean ± sample standard deviation over seeds, on carljax-36. DS, RC, clean: %;"]
    lines += ["the others per km."]
    atomic.write_text(folder / TABLE_FILE, "\n".join(lines) + "\n")
    numbers = [
        {
            "row": label,
            "action": row.action,
            "num_samples": row.num_samples,
            "runs": [str(path.parent.relative_to(folder)) for path in row.files],
            **{name: {"mean": mean, "std": std} for name, (mean, std) in spread.items()},
            "each": [values(path) for path in row.files],
        }
        for row, (label, spread) in zip(rows, found, strict=True)
    ]
    content = {"title": title, "rows": numbers, "machine": machine.describe()}
    atomic.write_text(folder / NUMBERS_FILE, json.dumps(content, indent=2) + "\n")
    _plot(rows, found, title, folder / PLOT_FILE)


def show(rows: Sequence[Row], title: str, console: Console) -> None:
    """Prints the table without infractions, which `write` has."""
    shown = Table(title=title, title_justify="left", box=box.SIMPLE, padding=(0, 1, 0, 0))
    shown.add_column("")
    shown.add_column("samples", justify="right", no_wrap=True)
    for name in SHARES:
        shown.add_column(name, justify="right", no_wrap=True)
    for row, (label, spread) in zip(rows, table(rows), strict=True):
        cells = [_text(name, *spread[name], len(row.files)) for name in SHARES]
        shown.add_row(label, f"{row.num_samples:,}", *cells)
    console.print(shown, highlight=False)


def _text(name: str, mean: float, std: float, num_seeds: int) -> str:
    """Returns a cell of the table; a single seed has no deviation."""
    digits = 1 if name in SHARES else 2
    return f"{mean:.{digits}f}" + (f" ± {std:.{digits}f}" if num_seeds > 1 else "")


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _plot(
    rows: Sequence[Row],
    found: Sequence[tuple[str, dict[str, tuple[float, float]]]],
    title: str,
    path: Path,
) -> None:
    """Driving Scores as bars with a dot for each seed, and how the trainings went."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    for number, (row, (label, spread)) in enumerate(zip(rows, found, strict=True)):
        mean, std = spread["DS"]
        colour = f"C{number}"
        left.barh(number, mean, xerr=std, color=colour, alpha=0.6, capsize=3)
        each = [values(file)["DS"] for file in row.files]
        left.plot(each, [number] * len(each), "o", color="black", markersize=3)
        if row.name not in [earlier.name for earlier in rows[:number]]:
            curves = [curve(file.parent) for file in row.files]
            _draw_curves(right, curves, colour, label)
    left.set_yticks(range(len(rows)), [label for label, _ in found])
    left.invert_yaxis()
    left.set(xlabel="Driving Score on carljax-36, %", xlim=(0, None))
    right.set(xlabel="samples, M", ylabel="route completion of training episodes, %", ylim=(0, 100))
    right.legend(frameon=False, fontsize="small")
    figure.suptitle(title)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _draw_curves(
    axes: Any, curves: Sequence[tuple[np.ndarray, np.ndarray]], colour: str, label: str
) -> None:
    for number, (millions, completion) in enumerate(curves):
        name = label if number == 0 else None
        axes.plot(millions, completion, color=colour, label=name, linewidth=1, alpha=0.8)


def curve(run: Path) -> tuple[np.ndarray, np.ndarray]:
    """Route completion of a run's training episodes by samples.

    Args:
      run: its directory.

    Returns:
      Millions of samples and percent, each (n,): means over parts of the training, by the number of
      episodes that ended.
    """
    lines = [line for line in metrics_log.read(run) if line.get("episode/num")]
    parts = [part for part in np.array_split(np.arange(len(lines)), CURVE_POINTS) if len(part)]
    millions, completion = [], []
    for part in parts:
        num = np.array([lines[i]["episode/num"] for i in part])
        value = np.array([lines[i]["episode/route_completion"] for i in part])
        millions.append(lines[part[-1]]["env_steps"] / 1e6)
        completion.append((num * value).sum() / num.sum())
    return np.array(millions), np.array(completion)
