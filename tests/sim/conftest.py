"""Bundled towns and small environments in them, made once for all tests of the simulator."""

import jax
import pytest
from traffic_world import World

from carljax.reward.config import RewardConfig
from carljax.sim import env as env_module
from carljax.sim import episodes, town, towns
from carljax.sim.env import EnvConfig
from carljax.sim.raster_canvas import RasterConfig

NUM_EPISODES, NUM_AGENTS, ROUTE_LENGTH = 6, 6, 200.0


@pytest.fixture(scope="session")
def bundled():
    """{name: Town} of all towns that ship with the package."""
    return {name: town.load(towns.path(name)) for name in towns.names()}


@pytest.fixture(scope="session")
def world():
    """The hand-made towns of `traffic_world` in one map."""
    return World()


@pytest.fixture(scope="session")
def small_env(bundled):
    """Short routes, alternately in the grid and in the village, few cars, small images."""
    there = [bundled["grid"], bundled["village"]]
    config = EnvConfig(
        num_agents=NUM_AGENTS,
        num_pedestrians=0,
        num_scenario_slots=0,
        route_length=ROUTE_LENGTH,
        raster=RasterConfig(32, 32, pixels_per_metre=0.5, ego_from_bottom_px=12),
    )
    bank = episodes.make_bank(there, NUM_EPISODES, config.population, 0, ROUTE_LENGTH)
    return env_module.make_env(bank, config, RewardConfig())


@pytest.fixture(scope="session")
def empty_env(small_env):
    """The same without traffic."""
    agents = small_env.bank.agents
    nobody = agents.replace(kind=jax.numpy.zeros_like(agents.kind))
    return small_env.replace(bank=small_env.bank.replace(agents=nobody))


@pytest.fixture(scope="session")
def reset(small_env):
    """The small environment's reset by seed, compiled once."""
    one = jax.jit(lambda env, key: env.reset(key))
    return lambda seed: one(small_env, jax.random.key(seed))
