"""Where the numbers of a run go: metrics.jsonl, TensorBoard and a progress bar.

A line of metrics.jsonl is one JSON object: `update`, `env_steps` and the metrics by name; a number
that is not finite (a mean over no episode) is null. docs/metrics.md says what each name means.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from tensorboardX import SummaryWriter

from carljax import atomic

FILE = "metrics.jsonl"
TENSORBOARD_FOLDER = "tensorboard"


class MetricsLog:
    """Writes metrics of one run; a context manager.

    Attributes:
      path: the JSONL file.
    """

    def __init__(self, run_dir: Path, start_update: int = 0):
        """Opens the logs, dropping lines past the update at which a resumed run starts.

        Args:
          run_dir: the run's directory.
          start_update: updates that were made before; 0 for a new run.
        """
        self.path = run_dir / FILE
        keep = [line for line in read(run_dir) if line["update"] <= start_update]
        atomic.write_text(self.path, "".join(json.dumps(line) + "\n" for line in keep))
        self._file = self.path.open("a", encoding="utf-8")
        self._board = SummaryWriter(
            logdir=str(run_dir / TENSORBOARD_FOLDER), purge_step=start_update + 1
        )

    def write(self, update: int, env_steps: int, metrics: Mapping[str, float]) -> None:
        """Writes one line.

        Args:
          update: updates made so far.
          env_steps: environment steps made so far.
          metrics: {name: value}.
        """
        values = {name: value if math.isfinite(value) else None for name, value in metrics.items()}
        self._file.write(json.dumps({"update": update, "env_steps": env_steps, **values}) + "\n")
        self._file.flush()
        for name, value in values.items():
            if value is not None:
                self._board.add_scalar(name, value, update)

    def close(self) -> None:
        """Closes both files."""
        self._file.close()
        self._board.close()

    def __enter__(self) -> MetricsLog:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def read(run_dir: Path) -> list[dict[str, float]]:
    """Reads a run's metrics; a last line that was cut off is left out.

    Args:
      run_dir: the run's directory.

    Returns:
      One dict per line; empty where there is no file.
    """
    path = run_dir / FILE
    if not path.exists():
        return []
    lines = []
    for text in path.read_text(encoding="utf-8").splitlines():
        try:
            lines.append(json.loads(text))
        except json.JSONDecodeError:
            break
    return lines


class WindowMean:
    """Mean of a metric's last values; NaN until there is one.

    What "best checkpoint" compares; it can be refilled from metrics.jsonl when a run is resumed.
    """

    def __init__(self, size: int, values: list[float | None] | None = None):
        self._values: deque[float] = deque(maxlen=size)
        for value in values or []:
            self.add(value)

    def add(self, value: float | None) -> None:
        """Adds a value unless it is missing or not finite."""
        if value is not None and math.isfinite(value):
            self._values.append(value)

    @property
    def mean(self) -> float:
        """The mean over the window."""
        return sum(self._values) / len(self._values) if self._values else math.nan


def progress_bar(console: Console) -> Progress:
    """Makes the bar of a training run: updates, reward, route completion, speed and time left.

    Args:
      console: where it is drawn; where that is no terminal, only the last state is printed.

    Returns:
      A `rich` progress; its task needs the fields `reward`, `completion` and `speed` (text).
    """
    return Progress(
        TextColumn("update"),
        MofNCompleteColumn(),
        BarColumn(bar_width=None),
        TextColumn("reward {task.fields[reward]}"),
        TextColumn("route {task.fields[completion]}"),
        TextColumn("{task.fields[speed]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
        expand=True,
    )
