"""Eight CPU devices and one compilation cache for all tests; private data where it is present."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

# All three are read when jax is first imported, which the imports below and the test modules do.
os.environ["JAX_PLATFORMS"] = "cpu"
os.environ["XLA_FLAGS"] = (
    os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=8"
).strip()
# Tests compile the same programs again and again. Set once: workers of pytest-xdist inherit it.
OWN_CACHE = None
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    OWN_CACHE = tempfile.mkdtemp(prefix="carljax-tests-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = OWN_CACHE

import pytest  # noqa: E402

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
