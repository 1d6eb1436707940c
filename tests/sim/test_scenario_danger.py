"""Every kind of scenario is dangerous to a passive driver and can be mastered by a careful one."""

import dataclasses
import importlib.util
import sys
from pathlib import Path

import pytest

from carljax.sim.scenarios import registry

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "scenarios.py"
NUM = 40


@pytest.fixture(scope="module")
def benchmark():
    spec = importlib.util.spec_from_file_location("scenarios_benchmark", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.fixture(scope="module")
def drives(benchmark, bundled):
    """The figures of a kind and a driver."""
    command = dataclasses.replace(benchmark.Command(), num=NUM)
    towns = [bundled[name] for name in ("grid", "village", "suburb")]
    routes = {kind: benchmark.draw(towns, kind, NUM, 0) for kind in registry.KINDS}

    def measure(kind, driver):
        return benchmark.measure(towns, routes[kind], kind, driver, command)

    return measure


@pytest.mark.slow
@pytest.mark.parametrize("kind", registry.KINDS)
def test_it_is_dangerous_to_whoever_does_not_react(drives, kind):
    got = drives(kind, "passive")
    assert got["began"] == got["num"] == NUM
    # There is nobody to run into where the car goes astray: it ends in the other lane or the ditch.
    harm = "left_lane_frac" if kind == "ControlLoss" else "collided_frac"
    assert got[harm] >= 0.5


@pytest.mark.slow
@pytest.mark.parametrize("kind", registry.KINDS)
def test_a_careful_driver_survives_it(drives, kind):
    got = drives(kind, "pdm-lite")
    assert got["began"] == NUM and got["survived_frac"] >= 0.8 and got["left_road_frac"] == 0.0
