"""Where the numbers of a run go: metrics.jsonl, TensorBoard and a progress bar.

A line of metrics.jsonl is one JSON object: `update`, `env_steps` and the metrics by name; a number
that is not finite (a mean over no episode) is null. docs/metrics.md says what each name means.
"""

from __future__ import annotations

import json
import math
import time
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
LINE_EVERY_S = 20.0  # between two lines where there is no terminal for a bar


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


def _shown(value: float, form: str) -> str:
    """A number for people; a dash where there is none yet."""
    return format(value, form) if math.isfinite(value) else "-"


class Report:
    """Shows how training goes: a bar on a terminal, a line now and then elsewhere.

    Both give reward per step, route completion, samples per second and the time left.
    """

    def __init__(self, console: Console, start_update: int, num_updates: int):
        """Prepares the report.

        Args:
          console: where it is shown.
          start_update: updates made before.
          num_updates: updates of the whole run.
        """
        self._console = console
        self._last_update = num_updates
        self._last_line = -math.inf
        self._bar = Progress(
            TextColumn("update"),
            MofNCompleteColumn(),
            BarColumn(bar_width=None),
            TextColumn("{task.description}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=console,
            expand=True,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("compiling", total=num_updates, completed=start_update)

    def show(self, update: int, metrics: Mapping[str, float]) -> None:
        """Shows the state after an update.

        Args:
          update: updates made so far.
          metrics: of that update.
        """
        text = (
            f"reward {metrics['rollout/reward']:.3f}"
            f"  route {_shown(metrics['episode/route_completion'], '.1f')} %"
            f"  {_shown(metrics.get('time/env_steps_per_s', math.nan), ',.0f')} samples/s"
        )
        self._bar.update(self._task, completed=update, description=text)
        now = time.monotonic()
        due = now - self._last_line > LINE_EVERY_S or update == self._last_update
        if due and not self._console.is_terminal:
            self._last_line = now
            self._console.print(f"update {update}/{self._last_update}  {text}{self._left()}")

    def _left(self) -> str:
        left = self._bar.tasks[self._task].time_remaining
        return "" if left is None else f"  {left:.0f} s left"

    def __enter__(self) -> Report:
        self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.stop()
