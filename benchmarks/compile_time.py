"""How long compiling takes: `python benchmarks/compile_time.py`, one JSON line.

The train step of a preset is traced, lowered and compiled in a fresh process with an empty cache on
disk (cold) and in another one that finds it there (warm). Reading towns, drawing routes and the
first training state, which compile small programs of their own, are timed apart, as `setup_s`.
"""

from __future__ import annotations

import dataclasses
import json
import multiprocessing
import os
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from typing import Any, Literal

import jax
import tyro

from carljax import build, machine, presets
from carljax.compile_cache import VARIABLE
from carljax.ppo import trainer

MIB = 1 << 20


@dataclasses.dataclass(frozen=True)
class Command:
    """What to compile."""

    preset: Literal["cpu", "carl-carla", "carl-nuplan", "roach", "atari"] = "cpu"
    """Configuration of the train step."""
    num_routes: int = 64
    """Routes in the bank."""


def main() -> int:
    """Measures and prints."""
    command = tyro.cli(Command, description=__doc__)
    with tempfile.TemporaryDirectory(prefix="carljax-compile-") as folder:
        # Read by JAX when the other processes import it.
        os.environ[VARIABLE] = folder
        cold, warm = in_fresh_process(command), in_fresh_process(command)
        stored = sum(entry.stat().st_size for entry in os.scandir(folder))
    print(json.dumps(line(command, cold, warm, stored)))
    return 0


def in_fresh_process(command: Command) -> dict[str, Any]:
    """What `measure` returns in a process of its own."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=1, mp_context=context) as pool:
        return pool.submit(measure, command).result()


def measure(command: Command) -> dict[str, Any]:
    """Times each stage from configuration to executable, s, and the size of the program."""
    seconds, of_cpu = {}, {}
    since = time.perf_counter(), time.process_time()

    def lap(stage: str) -> None:
        nonlocal since
        now = time.perf_counter(), time.process_time()
        seconds[stage], of_cpu[stage] = now[0] - since[0], now[1] - since[1]
        since = now

    config = presets.PRESETS[command.preset].config
    run = dataclasses.replace(config.run, num_routes=command.num_routes, num_devices=1)
    made = build.setup(dataclasses.replace(config, run=run))
    state = jax.block_until_ready(build.initial_state(made))
    lap("setup")
    step: Any = trainer.make_train_step(made.network, config.ppo, made.mesh, made.storage)
    traced = step.trace(made.env, state)
    lap("trace")
    lowered = traced.lower()
    lap("lower")
    compiled = lowered.compile()
    lap("compile")
    return {
        "seconds": seconds,
        "cpu_seconds": of_cpu,
        "stablehlo_ops": lowered.as_text().count(" = "),
        "hlo_instructions": compiled.as_text().count(" = "),
        "machine": machine.describe(),
    }


def line(
    command: Command, cold: dict[str, Any], warm: dict[str, Any], stored: int
) -> dict[str, Any]:
    """The line that is printed; seconds of the cold process unless they say otherwise."""
    first, again = ({k: round(v, 2) for k, v in x["seconds"].items()} for x in (cold, warm))
    return {
        "benchmark": "compile_time",
        "preset": command.preset,
        "trace_s": first["trace"],
        "lower_s": first["lower"],
        "compile_cold_s": first["compile"],
        "compile_warm_s": again["compile"],
        # Of all threads: what other work on the machine changes little.
        "compile_cold_cpu_s": round(cold["cpu_seconds"]["compile"], 2),
        "setup_s": first["setup"],
        "setup_warm_s": again["setup"],
        "stablehlo_ops": cold["stablehlo_ops"],
        "hlo_instructions": cold["hlo_instructions"],
        "cache_mib": round(stored / MIB, 1),
        "num_routes": command.num_routes,
        "machine": cold["machine"],
    }


if __name__ == "__main__":
    sys.exit(main())
