"""The benchmark of traffic by itself: its checks find what they are to find; a few kilometres."""

import importlib.util
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_world import cars, f32

from carljax.sim import lights, road_map_builder

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "traffic.py"


@pytest.fixture(scope="module")
def benchmark():
    spec = importlib.util.spec_from_file_location("traffic_benchmark", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.mark.parametrize("name", ["grid", "highway", "village"])
def test_ten_kilometres_without_a_scratch(benchmark, bundled, name):
    command = benchmark.Command(km=10.0, density=10.0, warm_up=0.0)
    got = benchmark.measure(bundled[name], command)
    assert got["km"] >= 10 and got["map"] == name
    for count in ("collisions", "red_lights_run", "stop_signs_run", "off_road"):
        assert got[count] == 0
    assert got["last_tenth_speed"] >= 0.8 * got["first_tenth_speed"]


def test_cars_that_touch_are_found(benchmark, world):
    row = world.row("road", 0)
    for gap, touches in ((3.9, True), (4.1, False)):
        agents = cars(
            world,
            {"lanes": (row, -1, -1), "lane_s": 10.0},
            {"lanes": (row, -1, -1), "lane_s": 10.0 + gap},
        )
        assert bool(benchmark.overlaps(agents).any()) == touches


def crossed(benchmark, world, name, speed, time=0.0, has_halted=False):
    """What is noted of a car whose front passes the line of its arm from the north."""
    lanes = world.way(name, "north", "straight")
    before = cars(world, {"lanes": lanes, "lane_s": 77.9, "speed": speed})
    clock, halted = lights.clock(f32(time), 0), jnp.full(before.speed.shape, has_halted)
    got = benchmark.lines(before, before, halted, world.map, clock)
    return [bool(x[0]) for x in got]


@pytest.mark.parametrize(("since", "runs"), [(1.0, False), (11.0, False), (14.0, True)])
def test_a_red_light_run_is_found(benchmark, world, since, runs):
    start, _ = world.light("north")
    assert crossed(benchmark, world, "lights", 5.0, start + since)[1:] == [runs, False]
    # too slow to pass the line in this step
    assert crossed(benchmark, world, "lights", 0.5, start + since)[1:] == [False, False]


def test_a_stop_sign_run_is_found(benchmark, world):
    assert crossed(benchmark, world, "signs", 5.0)[1:] == [False, True]
    assert crossed(benchmark, world, "signs", 5.0, has_halted=True)[1:] == [False, False]
    assert crossed(benchmark, world, "signs", 0.2)[0]  # halts near the line


def test_cars_off_the_road_are_found(benchmark, world, bundled):
    road_map = road_map_builder.build([bundled["village"]])
    agents = cars(world, {"lanes": (0, -1, -1)})
    on = np.asarray(road_map.point_xy[int(road_map.lane_start[0]) + 20])
    there = jax.tree.map(lambda x: x, agents).replace(xy=jnp.zeros_like(agents.xy) + f32(on))
    assert not benchmark.off_road(there, road_map)[0]
    assert benchmark.off_road(there.replace(xy=there.xy + 1e4), road_map)[0]
