"""Bundled towns, read once for all tests of the simulator."""

import pytest

from carljax.sim import town, towns


@pytest.fixture(scope="session")
def bundled():
    """{name: Town} of all towns that ship with the package."""
    return {name: town.load(towns.path(name)) for name in towns.names()}
