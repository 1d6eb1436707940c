"""Tests compile cheaply, for eight CPU devices, with one cache; private data where there is any."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

# Tests compile more than they run: with these flags XLA:CPU takes 0.45 of the time for a step of an
# environment. CARLJAX_TEST_XLA_FLAGS="" tests what users compile, as .ci/run does with a part.
CHEAP_XLA_FLAGS = (
    "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0"
    " --xla_llvm_disable_expensive_passes=true"
)
# All are read when jax is first imported, which the imports below and the test modules do.
os.environ["JAX_PLATFORMS"] = "cpu"
if "PYTEST_XDIST_WORKER" not in os.environ:  # workers inherit what is set once
    os.environ["XLA_FLAGS"] = " ".join(
        [
            os.environ.get("XLA_FLAGS", ""),
            os.environ.get("CARLJAX_TEST_XLA_FLAGS", CHEAP_XLA_FLAGS),
            "--xla_force_host_platform_device_count=8",
        ]
    ).strip()
# Tests compile the same programs again and again. Set once: workers of pytest-xdist inherit it.
OWN_CACHE = None
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    OWN_CACHE = tempfile.mkdtemp(prefix="carljax-tests-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = OWN_CACHE

import jax  # noqa: E402
import pytest  # noqa: E402

# Linux gives a process 65,530 memory maps by default. A compiled program takes about a dozen, and
# XLA crashes when there are none left.
MAX_MEMORY_MAPS = 20_000
SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def pytest_unconfigure() -> None:
    """Removes the compilation cache of this test run."""
    if OWN_CACHE is not None:
        shutil.rmtree(OWN_CACHE, ignore_errors=True)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real maps and reference results, which is not part of the repository."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"private reference data is not at {SHARED_DATA}")
    return SHARED_DATA


@pytest.fixture(scope="module", autouse=True)
def _compiled_programs_go_when_they_are_many():
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_bytes().splitlines()) > MAX_MEMORY_MAPS:
        jax.clear_caches()
