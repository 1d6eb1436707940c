"""How fast it runs: `python benchmarks/throughput.py`, one JSON line for each measurement.

What each field means, and how the figures of the documentation are made: docs/performance.md.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator
from typing import Any, Literal

import measure
import tyro
import workloads
from measure import UsageError

from carljax import build, machine, presets
from carljax.config import TrainConfig
from carljax.ppo import trainer
from carljax.sim.env import ObservationKind
from carljax.sim.observation import KINDS
from carljax.sim.raster_canvas import RasterConfig
from carljax.sim.town import Town

SIM_ENVS, SIM_AGENTS, SIM_STEPS = 64, 32, 50
TRAFFIC_ENVS = 512
RENDER_ENVS, RENDER_AGENTS, RENDER_STEPS = 32, 50, 20

Kind = Literal["sim", "traffic", "render", "rollout", "update", "end_to_end"]


@dataclasses.dataclass(frozen=True)
class Command:
    """What to measure."""

    preset: Literal["cpu", "carl-carla", "atari"] = "cpu"
    """Configuration of rollout, update and end_to_end."""
    kinds: tuple[Kind, ...] = ("sim", "traffic", "render", "rollout", "update", "end_to_end")
    """Measurements to make."""
    repeats: int = 7
    """Timed calls, at least 5."""
    num_routes: int = 64
    """Routes in the bank."""
    observation: ObservationKind = "carla"
    """What `render` draws, at the size of the preset `cpu` and at its authors' size."""
    num_envs: int | None = None
    """Environments of rollout, update and end_to_end; the preset's by default."""
    num_steps: int | None = None
    """Steps of each in a rollout; the preset's by default."""
    num_devices: int = 1
    """Devices of end_to_end; a CPU is made to look like so many, one a core at most."""


def main() -> int:
    """Measures and prints."""
    command = tyro.cli(Command, description=__doc__)
    try:
        measure.check_repeats(command.repeats)
        config = configure(command)
        for line in lines(command, config, build.load_towns(config.run.maps)):
            measure.emit(line)
    except UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def configure(command: Command) -> TrainConfig:
    """The preset with the sizes that were asked for.

    Micro-batches are the preset's, or what a device has of a minibatch where that is less.

    Raises:
      UsageError: they don't go together, or there are fewer devices.
    """
    config = presets.PRESETS[command.preset].config
    asked = {"num_envs": command.num_envs, "num_steps": command.num_steps}
    given: dict[str, Any] = {name: value for name, value in asked.items() if value is not None}
    try:
        ppo = dataclasses.replace(config.ppo, **given)
        if ppo.micro_batch_size is not None:
            share = max(ppo.minibatch_size // max(command.num_devices, 1), 1)
            ppo = dataclasses.replace(ppo, micro_batch_size=min(ppo.micro_batch_size, share))
        machine.offer_devices(command.num_devices)
        trainer.make_mesh(command.num_devices)
        ppo.validate(command.num_devices)
    except ValueError as error:
        raise UsageError(str(error)) from error
    if command.num_devices > 1 and set(command.kinds) & {"rollout", "update"}:
        raise UsageError(f"--num-devices {command.num_devices}: is for --kinds end_to_end alone")
    return dataclasses.replace(config, ppo=ppo)


def lines(command: Command, config: TrainConfig, towns: list[Town]) -> Iterator[dict[str, Any]]:
    """Makes the measurements that were asked for, one line each."""
    repeats = command.repeats
    if "sim" in command.kinds:
        env = workloads.environment(config, towns, command.num_routes, SIM_AGENTS)
        yield measure.run(workloads.sim(env, SIM_ENVS, SIM_STEPS), repeats)
    if "traffic" in command.kinds:
        alone = {"num_pedestrians": 0, "num_scenario_slots": 0}
        env = workloads.environment(config, towns, command.num_routes, SIM_AGENTS, **alone)
        made = measure.run(workloads.sim(env, TRAFFIC_ENVS, SIM_STEPS), repeats)
        yield {**made, "benchmark": "traffic"}
    if "render" in command.kinds:
        for name, raster in rasters(command.observation):
            seen = {"raster": raster, "observation": command.observation}
            env = workloads.environment(config, towns, command.num_routes, RENDER_AGENTS, **seen)
            workload = workloads.render(env, RENDER_ENVS, RENDER_STEPS)
            yield {"raster": name, **measure.run(workload, repeats)}
    makers = {
        "rollout": workloads.collect,
        "update": workloads.learn,
        "end_to_end": workloads.train,
    }
    chosen = [make for kind, make in makers.items() if kind in command.kinds]
    if not chosen:
        return
    learner = workloads.learner(config, towns, command.num_routes, command.num_devices)
    for make in chosen:
        yield {"preset": command.preset, **measure.run(make(learner), repeats)}


def rasters(kind: ObservationKind) -> tuple[tuple[str, RasterConfig], tuple[str, RasterConfig]]:
    """The image of the preset `cpu`, and an observation's image as its authors have it."""
    full = "carl-carla" if kind == "carla" else kind
    return ("cpu", presets.CPU.env.raster), (full, KINDS[kind].raster)


if __name__ == "__main__":
    sys.exit(main())
