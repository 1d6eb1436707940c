"""Draws the learning curve of a run: `python tools/learning_curve.py RUN OUT.png`.

Route completion of training episodes (sampled actions, ended by the first infraction), averaged
over the last hundred of them, and by which infraction they ended; the score of the deterministic
policy on held-out routes as a dashed line.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from carljax import evaluate, metrics_log

EPISODES = 100  # averaged over
CAUSES = ("collision", "red_light", "stop_sign", "off_road", "route_deviation", "finished")


def main(argv: Sequence[str]) -> int:
    """Draws; returns the exit status."""
    if len(argv) != 2 or not (Path(argv[0]) / metrics_log.FILE).is_file():
        print("usage: python tools/learning_curve.py RUN OUT.png", file=sys.stderr)
        return 2
    run, out = Path(argv[0]), Path(argv[1])
    lines = [line for line in metrics_log.read(run) if line.get("episode/num")]
    millions = np.array([line["env_steps"] for line in lines]) / 1e6
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.4), layout="constrained")
    left.plot(millions, average(lines, "route_completion"), label="training episodes, sampled")
    _draw_score(left, run)
    left.set(xlabel="samples, M", ylabel="route completion, %", ylim=(0, 100))
    left.legend(frameon=False)
    for cause in CAUSES:
        ended = 100 * average(lines, f"{cause}_frac")
        right.plot(millions, ended, label=cause.replace("_", " "))
    right.set(xlabel="samples, M", ylabel="training episodes ended by, %", ylim=(0, None))
    right.legend(frameon=False, fontsize="small")
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=110)
    return 0


def average(lines: Sequence[dict[str, float]], name: str) -> np.ndarray:
    """Mean of an episode metric over the last `EPISODES` episodes, at each line."""
    num = np.array([line["episode/num"] for line in lines])
    total = np.cumsum(num * [line[f"episode/{name}"] for line in lines])
    count = np.cumsum(num)
    first = np.searchsorted(count, count - EPISODES, side="right")
    before = np.where(first > 0, first - 1, 0)
    started = first > 0
    return (total - started * total[before]) / (count - started * count[before])


def _draw_score(axes: plt.Axes, run: Path) -> None:
    path = run / evaluate.FILE
    if path.is_file():
        score = json.loads(path.read_text(encoding="utf-8"))["carljax"]
        completion = score["route_completion_mean"]
        axes.axhline(completion, linestyle="--", color="C2", label="held-out, leaderboard's rules")
        clean = score["clean_completion_mean"]
        axes.axhline(clean, linestyle=":", color="C2", label="held-out, to the first infraction")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
