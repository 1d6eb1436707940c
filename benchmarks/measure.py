"""What the speed benchmarks share: timing, costs, this machine's peak, one line of JSON each.

Compilation and a first call are left out, every call is waited for, and a figure is the median of
at least five calls with their spread beside it. A line carries sizes, versions, hardware and the
machine's load, so that it can stand by itself.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import matmul_flops
import numpy as np
import xla_cost

from carljax import machine, timing
from carljax.ppo import trainer

LEAST_REPEATS = 5
# Sides of the square products among which the fastest one is the peak, and operations of a call.
_CPU_PRODUCTS = (512, 1024, 2048), 16e9
_ACCELERATOR_PRODUCTS = (2048, 4096, 8192), 1e13


# How busy the machine was with other things.
_LOAD_BEFORE = os.getloadavg()[0]


class UsageError(ValueError):
    """What a user asked for can't be measured; one line."""


@dataclasses.dataclass(frozen=True)
class Workload:
    """A program to time, and what one call of it makes.

    Attributes:
      name: of the benchmark.
      program: jitted.
      given: arguments of the first call.
      units: {name: how many of them one call makes}; the first is the one that counts.
      sizes: what else the line should say.
      follow: makes the arguments of the next call from the last result; the same ones by default.
      num_devices: that it runs on.
    """

    name: str
    program: Any
    given: tuple
    units: Mapping[str, int]
    sizes: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    follow: Callable[[Any], tuple] | None = None
    num_devices: int = 1


@dataclasses.dataclass(frozen=True)
class Ready:
    """A workload that is compiled; the operations of its products and convolutions in a call."""

    workload: Workload
    compiled: Any
    matmul_flops: float


def prepare(workload: Workload) -> Ready:
    """Compiles a workload."""
    traced = workload.program.trace(*workload.given)
    flops = matmul_flops.of_traced(traced, jax.default_backend())
    return Ready(workload, traced.lower().compile(), flops)


def call(ready: Ready, repeats: int, warm_up: int = 1) -> list[float]:
    """Times calls, each on what follows from the one before; see `timing.call_seconds`."""
    workload = ready.workload

    def arguments(result: Any) -> tuple:
        if result is None or workload.follow is None:
            return workload.given
        return workload.follow(result)

    return timing.call_seconds(ready.compiled, arguments, repeats, warm_up)


def describe(ready: Ready, seconds: Sequence[float]) -> dict[str, Any]:
    """Describes a workload whose calls took so many seconds; see `run`."""
    workload, taken = ready.workload, spread(seconds)
    # Devices made on a CPU share its cores.
    num_peaks = 1 if jax.default_backend() == "cpu" else workload.num_devices
    speed = ready.matmul_flops / taken["median"]
    return {
        "benchmark": workload.name,
        **{f"{unit}_per_s": num / taken["median"] for unit, num in workload.units.items()},
        "seconds": taken,
        "matmul_flops": ready.matmul_flops,
        "matmul_peak_share": speed / (num_peaks * matmul_peak()),
        "xla": xla_cost.of(ready.compiled),
        **workload.sizes,
    }


def run(workload: Workload, repeats: int) -> dict[str, Any]:
    """Compiles, times and describes one workload.

    Args:
      workload: the program.
      repeats: timed calls, at least `LEAST_REPEATS`.

    Returns:
      Values that JSON can hold: `benchmark`, a rate for each unit at the median, `seconds` of a
      call (see `spread`), `matmul_flops` of a call and what share of the peak they are (see
      `matmul_peak`), XLA's own counts (see `xla_cost.of`), and the sizes.

    Raises:
      UsageError: too few repeats.
    """
    check_repeats(repeats)
    ready = prepare(workload)
    return describe(ready, call(ready, repeats))


def check_repeats(repeats: int) -> None:
    """Refuses a number of repeats of which a median says nothing.

    Raises:
      UsageError: fewer than `LEAST_REPEATS`.
    """
    if repeats < LEAST_REPEATS:
        raise UsageError(f"--repeats {repeats}: a median needs at least {LEAST_REPEATS}")


def spread(values: Sequence[float]) -> dict[str, float]:
    """Median, extremes and quartiles (interpolated) of some values, and how many they are."""
    least, low, median, high, most = (float(x) for x in np.percentile(values, (0, 25, 50, 75, 100)))
    return {
        "median": median,
        "min": least,
        "q1": low,
        "q3": high,
        "max": most,
        "num": len(values),
    }


def jit(function: Callable[..., Any]) -> Any:
    """Compiles with the options of the train step."""
    return jax.jit(function, compiler_options=trainer.compiler_options(jax.default_backend()))


@functools.cache
def matmul_peak() -> float:
    """Measures float32 matrix products at the default precision, as the networks use it.

    Returns:
      Operations per second on one device (on a CPU: with all its cores), of the fastest of
      `LEAST_REPEATS` calls with square products of each of several sizes.
    """
    on_cpu = jax.default_backend() == "cpu"
    sides, operations = _CPU_PRODUCTS if on_cpu else _ACCELERATOR_PRODUCTS
    return max(_product_speed(side, operations) for side in sides)


def _product_speed(side: int, operations: float) -> float:
    """A call makes several products, so that what a call costs besides does not count."""
    num = max(1, int(operations / (2 * side**3)))
    x = jnp.ones((side, side), jnp.float32)
    y = jnp.full((side, side), 1.0 / side, jnp.float32)
    products = jit(lambda x, y: jax.lax.fori_loop(0, num, lambda _, x: x @ y, x))
    seconds = timing.call_seconds(products, lambda _: (x, y), LEAST_REPEATS)
    return 2.0 * num * side**3 / min(seconds)


def emit(line: Mapping[str, Any]) -> None:
    """Prints one line of JSON with what it ran on.

    Args:
      line: from `run`, or alike. Added are the peak of matrix products, the machine, and its mean
        load in the minute before this process began.
    """
    beside: dict[str, Any] = {
        "matmul_peak_flops_per_s": matmul_peak(),
        "load_before": round(_LOAD_BEFORE, 2),
    }
    beside["machine"] = machine.describe()
    # What a line says already, of another process, stays.
    print(json.dumps({**line, **beside, **line}), flush=True)
