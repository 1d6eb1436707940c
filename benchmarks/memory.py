"""How much memory a training takes: `python benchmarks/memory.py`, one JSON line.

Beside one another: the estimate that training prints before it begins, what XLA says of the
compiled train step, and what the updates really took: what was on the device before them, and by
how much the process grew (on a CPU) or the device's allocator says that it did.
"""

from __future__ import annotations

import ctypes
import dataclasses
import json
import re
import resource
import sys
import time
from pathlib import Path
from typing import Any, Literal

import jax
import tyro

from carljax import build, machine, memory, presets
from carljax.config import ConfigError, TrainConfig
from carljax.ppo import trainer

_CLEAR_PEAK = "5"  # source: proc(5), /proc/[pid]/clear_refs


@dataclasses.dataclass(frozen=True)
class Command:
    """What to train."""

    preset: Literal["cpu", "carl-carla", "carl-nuplan", "roach", "atari"] = "cpu"
    """Configuration."""
    obs_storage: Literal["auto", "store", "pack", "rerender"] = "auto"
    """How images are kept."""
    num_envs: int | None = None
    """Environments; those of the preset by default."""
    num_steps: int | None = None
    """Steps of each; those of the preset by default."""
    micro_batch_size: int | None = None
    """Samples whose gradients are computed at once; those of the preset by default."""
    update_epochs: int | None = None
    """Epochs; memory does not depend on them, time does."""
    num_routes: int = 64
    """Routes in the bank."""
    updates: int = 1
    """Updates to make."""


def main() -> int:
    """Measures and prints."""
    command = tyro.cli(Command, description=__doc__)
    try:
        line = measure(command, configure(command))
    except ConfigError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(json.dumps({**line, "machine": machine.describe()}))
    return 0


def configure(command: Command) -> TrainConfig:
    """The preset with what the command changes."""
    config = presets.PRESETS[command.preset].config
    names = ("num_envs", "num_steps", "micro_batch_size", "update_epochs")
    given = {name: getattr(command, name) for name in names}
    ppo = dataclasses.replace(config.ppo, **{k: v for k, v in given.items() if v is not None})
    run = dataclasses.replace(
        config.run,
        num_routes=command.num_routes,
        num_devices=1,
        obs_storage=command.obs_storage,
    )
    return dataclasses.replace(config, ppo=ppo, run=run)


def measure(command: Command, config: TrainConfig) -> dict[str, Any]:
    """Trains and reads off the memory.

    Raises:
      ConfigError: sizes that do not go together.
    """
    made = build.setup(config)
    _, estimate = memory.estimate(made)
    step: Any = trainer.make_train_step(made.network, config.ppo, made.mesh, made.storage)
    state = build.initial_state(made)
    compiled = step.lower(made.env, state).compile()
    there = memory.tree_bytes((made.env, state))
    before = start_watching()
    since = time.perf_counter()
    for _ in range(command.updates):
        state, _ = jax.block_until_ready(compiled(made.env, state))
    seconds = time.perf_counter() - since
    measured = peak() - before + there
    stats = compiled.memory_analysis()
    raster = config.env.raster
    return {
        "benchmark": "memory",
        "preset": command.preset,
        "obs_storage": made.storage.name,
        "samples": config.ppo.batch_size,
        "shape": [raster.height, raster.width, len(config.env.channels)],
        "num_envs": config.ppo.num_envs,
        "micro_batch_size": config.ppo.micro_batch_size,
        "estimate_bytes": estimate.total,
        "estimate_parts": estimate.parts,
        "xla_bytes": stats.argument_size_in_bytes + stats.temp_size_in_bytes,
        "measured_bytes": measured,
        "estimate_over_measured": estimate.total / measured,
        "process_peak_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
        "samples_per_s": command.updates * config.ppo.batch_size / seconds,
    }


def start_watching() -> int:
    """Forgets the peak so far; returns the bytes in use now."""
    if jax.default_backend() != "cpu":
        return _on_device("bytes_in_use")
    # What the compiler has freed would be used again and so not be seen to grow.
    ctypes.CDLL(None).malloc_trim(0)
    Path("/proc/self/clear_refs").write_text(_CLEAR_PEAK)
    return _of_process("VmRSS")


def peak() -> int:
    """The most bytes in use at once since `start_watching`."""
    return (
        _of_process("VmHWM") if jax.default_backend() == "cpu" else _on_device("peak_bytes_in_use")
    )


def _of_process(name: str) -> int:
    found = re.search(rf"{name}:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1]) * 1024


def _on_device(name: str) -> int:
    stats = jax.local_devices()[0].memory_stats()
    assert stats is not None
    return stats[name]


if __name__ == "__main__":
    sys.exit(main())
