"""What a run or a benchmark ran on: versions of the packages, processor, memory, devices."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

import jax
import jax.extend

PACKAGES = ("carljax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy")


def describe() -> dict[str, Any]:
    """Describes this machine in values that JSON can hold."""
    return {
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in PACKAGES},
        "system": platform.platform(),
        "cpu": _cpu_name(),
        "cores": os.cpu_count(),
        "memory_bytes": host_memory(),
        "backend": jax.default_backend(),
        "devices": [device.device_kind for device in jax.devices()],
        "processes": jax.process_count(),
    }


def host_memory() -> int:
    """Physical memory of this machine, bytes."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def device_memory() -> int:
    """Memory that one device may use, bytes; devices on the CPU share the host's."""
    stats = jax.local_devices()[0].memory_stats() if jax.default_backend() != "cpu" else None
    return stats["bytes_limit"] if stats else host_memory()


def num_cores() -> int:
    """Processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def offer_devices(num: int | None) -> None:
    """Makes the CPU look like so many devices, where JAX runs on it and sees fewer.

    A program for one device uses all cores, but has stretches that only one of them can work on.
    For the start of a command: arrays made before are lost.

    Args:
      num: devices; what is more than there are cores is not offered, nor to one of many processes.
    """
    if num is None or not jax.device_count() < num <= num_cores():
        return
    if jax.default_backend() == "cpu" and jax.process_count() == 1:
        jax.extend.backend.clear_backends()
        jax.config.update("jax_num_cpu_devices", num)


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _cpu_name() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor()
