"""Four CPU devices for every test, and the folder of private data where it is present."""

from __future__ import annotations

import os
from pathlib import Path

# Both are read when jax is first imported, which the imports below and the test modules do.
os.environ["JAX_PLATFORMS"] = "cpu"
os.environ["XLA_FLAGS"] = (
    os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=4"
).strip()

import pytest  # noqa: E402

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real maps and reference results, which is not part of the repository."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"private reference data is not at {SHARED_DATA}")
    return SHARED_DATA
