"""How cost grows: `python benchmarks/scaling.py`, one JSON line a point and one for each axis.

Along each axis one size grows and all else stays; a line has the cost of a step of all environments
(for devices: of a training update) and its ratio to the point before. Calls of both are timed in
turn (devices: one after the other), since many a machine does not keep its speed. Doubling
environments, agents or images may cost 2.2 times as much at most once the cores are full, that is
from the first size on whose throughput is within a fifth of the best on its axis. The status is 1
where it costs more.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import measure
import numpy as np
import tyro
import workloads
from measure import UsageError, Workload

from carljax import presets
from carljax.sim import towns as bundled
from carljax.sim.raster_canvas import RasterConfig
from carljax.sim.road_network import MapError
from carljax.sim.route_generator import RouteError
from carljax.sim.town import Town, load

Axis = Literal["agents", "envs", "image", "maps", "devices"]

FULL = 0.8  # of the best throughput, from which on the cores are full
MOST_FOR_DOUBLE = 2.2
THROUGHPUT = Path(__file__).with_name("throughput.py")
IMAGE_AGENTS = 50  # in the scene of the images


@dataclasses.dataclass(frozen=True)
class Command:
    """What to measure."""

    axes: tuple[Axis, ...] = ("agents", "envs", "image", "maps", "devices")
    """Which sizes to let grow, one after the other."""
    agents: tuple[int, ...] = (8, 16, 32, 64, 128, 256)
    """Vehicles of traffic around each ego; simulator alone."""
    envs: tuple[int, ...] = (1, 4, 16, 64, 128, 256, 512, 1024, 2048, 4096)
    """Environments; simulator alone."""
    sides: tuple[int, ...] = (64, 90, 128, 181, 256)
    """Sides of the image at 2 px/m, by default each with twice the pixels of the one before;
    observation alone."""
    maps: tuple[str, ...] = ("village", "grid")
    """Bundled towns by name, or paths of .xodr files, the smaller first; both simulator and
    observation."""
    devices: tuple[int, ...] = (1, 2, 4, 8)
    """Devices that this machine's CPU is made to look like, which share a whole training update of
    the preset `cpu` among them."""
    num_envs: int = 64
    """Environments where they do not grow."""
    num_agents: int = 32
    """Agents where they do not grow."""
    num_steps: int = 10
    """Steps of a timed call."""
    num_routes: int = 32
    """Routes in the bank."""
    repeats: int = 15
    """Timed calls, at least 5."""


Point = dict[str, Any]
Last = dict[str, measure.Ready]


def main() -> int:
    """Measures and prints."""
    command = tyro.cli(Command, description=__doc__)
    holds = True
    try:
        check(command)
        for axis in command.axes:
            points = []
            for made in with_ratios(AXES[axis](command)):
                measure.emit({**made, "axis": axis})
                points.append(made)
            verdict = judge(axis, points)
            holds &= verdict["holds"] is not False
            measure.emit(verdict)
    except (UsageError, RouteError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0 if holds else 1


def check(command: Command) -> None:
    """Looks at the sizes before anything is measured.

    Raises:
      UsageError: one that can't be.
    """
    measure.check_repeats(command.repeats)
    for name in ("agents", "envs", "sides", "devices"):
        sizes = getattr(command, name)
        if not sizes or min(sizes) < 1 or list(sizes) != sorted(set(sizes)):
            raise UsageError(f"--{name} {' '.join(map(str, sizes))}: must rise from 1 or more")
    for name in ("num_envs", "num_agents", "num_steps", "num_routes"):
        if getattr(command, name) < 1:
            raise UsageError(f"--{name.replace('_', '-')} {getattr(command, name)}: is below 1")
    if "maps" in command.axes:
        for name in command.maps:
            town(name)


def with_ratios(points: Iterator[Point]) -> Iterator[Point]:
    """Adds to each point how many times the cost and the size of the one before it has.

    Args:
      points: with `size`, `cost_s` and `series`; the first of a series has nothing before it. With
        a `cost_ratio` of their own if both were timed in turn.
    """
    last: dict[str, Point] = {}
    for point in points:
        before = last.get(point["series"])
        last[point["series"]] = point
        yield {
            "cost_ratio": point["cost_s"] / before["cost_s"] if before else None,
            "size_ratio": point["size"] / before["size"] if before else None,
            **point,
        }


def judge(axis: str, points: Sequence[Point]) -> dict[str, Any]:
    """Holds an axis against the criterion.

    Args:
      axis: its name.
      points: of one series, from `with_ratios`.

    Returns:
      The size from which the cores are full and the largest ratio of costs from there on, brought
      to a doubling where sizes grow by another factor; `holds` is None where nothing is doubled
      beyond it, or where the axis is none of agents, environments and images.
    """
    line = {"benchmark": "scaling", "axis": axis, "most_for_double": MOST_FOR_DOUBLE, "holds": None}
    if axis not in ("agents", "envs", "image") or not points:
        return line
    speed = [point["size"] / point["cost_s"] for point in points]
    full = next(i for i, s in enumerate(speed) if s >= FULL * max(speed))
    ratios = [per_double(point) for point in points[full + 1 :]]
    if not ratios:
        return {**line, "full_from": points[full]["size"]}
    worst = max(ratios)
    return {
        **line,
        "full_from": points[full]["size"],
        "largest_for_double": worst,
        "holds": worst <= MOST_FOR_DOUBLE,
    }


def per_double(point: Point) -> float:
    """What doubling would cost if every doubling on the way to this point cost as much."""
    # x 4 in size at x 4.4 in cost is two doublings of sqrt(4.4) each.
    return 2.0 ** (math.log(point["cost_ratio"]) / math.log(point["size_ratio"]))


def agents(command: Command) -> Iterator[Point]:
    """The simulator with more and more traffic."""
    towns = [load(bundled.path(name)) for name in bundled.TRAINING]
    last: Last = {}
    for num in command.agents:
        env = workloads.environment(presets.CPU, towns, command.num_routes, num)
        yield point(command, workloads.sim(env, command.num_envs, command.num_steps), num, last)


def envs(command: Command) -> Iterator[Point]:
    """The simulator with more and more environments."""
    towns = [load(bundled.path(name)) for name in bundled.TRAINING]
    env = workloads.environment(presets.CPU, towns, command.num_routes, command.num_agents)
    last: Last = {}
    for num in command.envs:
        yield point(command, workloads.sim(env, num, command.num_steps), num, last)


def image(command: Command) -> Iterator[Point]:
    """The observation with more and more pixels; a smaller image sees less far."""
    towns = [load(bundled.path(name)) for name in bundled.TRAINING]
    last: Last = {}
    for side in command.sides:
        raster = RasterConfig(side, side, ego_from_bottom_px=round(side * 100 / 256))
        env = workloads.environment(
            presets.CPU, towns, command.num_routes, IMAGE_AGENTS, raster=raster
        )
        workload = workloads.render(env, command.num_envs, command.num_steps)
        yield point(command, workload, side * side, last)


def maps(command: Command) -> Iterator[Point]:
    """Simulator and observation in one town after the other; sizes are kilometres of lane."""
    towns = [town(name) for name in command.maps]
    last: Last = {}
    for there in towns:
        kilometres = float(there.lanes.length.sum()) / 1000.0
        env = workloads.environment(
            presets.CPU, [there], command.num_routes, command.num_agents, raster=RasterConfig()
        )
        for make in (workloads.sim, workloads.render):
            made = point(command, make(env, command.num_envs, command.num_steps), kilometres, last)
            pixels = np.asarray(env.bank.road_map.picture_size)[0].tolist()
            yield {**made, "map": there.network.name, "atlas_shape": pixels}


@functools.cache
def town(name: str) -> Town:
    """Reads a bundled town by name, or a file.

    Raises:
      UsageError: it is neither.
    """
    try:
        return load(bundled.path(name) if name in bundled.names() else Path(name))
    except (MapError, OSError) as error:
        raise UsageError(f"--maps: {error}") from error


def devices(command: Command) -> Iterator[Point]:
    """A training update shared among devices; each number of them is a process of its own."""
    for num in command.devices:
        flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={num}"
        asked = ["--kinds", "end_to_end", "--num-devices", str(num)]
        asked += ["--repeats", str(command.repeats), "--num-routes", str(command.num_routes)]
        ran = subprocess.run(
            [sys.executable, str(THROUGHPUT), *asked],
            env={**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags.strip()},
            capture_output=True,
            text=True,
            check=False,
        )
        if ran.returncode:
            said = ran.stderr.strip().splitlines() or ["no message"]
            raise UsageError(f"--devices {num}: {THROUGHPUT.name} failed: {said[-1]}")
        line = json.loads(ran.stdout)
        cost = line["seconds"]["median"]
        yield {**line, "benchmark": "scaling", "series": "end_to_end", "size": num, "cost_s": cost}


def point(command: Command, workload: Workload, size: float, last: Last) -> Point:
    """Measures one point of an axis; its cost is that of a step of all environments.

    Args:
      command: what to measure.
      workload: the program.
      size: the point.
      last: the point before of each series, which is timed in turn with this one; this one then.
    """
    ready, before = measure.prepare(workload), last.get(workload.name)
    last[workload.name] = ready
    seconds, ratios = measure.call(ready, 1), []
    for _ in range(command.repeats - 1):
        between = measure.call(before, 1, warm_up=0)[0] if before else None
        seconds += measure.call(ready, 1, warm_up=0)
        if between:
            ratios.append(0.5 * (seconds[-2] + seconds[-1]) / between)
    line = {**measure.describe(ready, seconds), "series": workload.name, "size": size}
    line["cost_s"] = line["seconds"]["median"] / command.num_steps
    if ratios:
        line["cost_ratio"] = measure.spread(ratios)["median"]
    return {**line, "benchmark": "scaling"}


AXES: dict[Axis, Callable[[Command], Iterator[Point]]] = {
    "agents": agents,
    "envs": envs,
    "image": image,
    "maps": maps,
    "devices": devices,
}


if __name__ == "__main__":
    sys.exit(main())
