"""What must hold of every reward under random driving; the benchmark finds what does not."""

import importlib.util
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from carljax.reward.config import RewardConfig

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "reward_invariants.py"
# Enough to see most ends. The script itself drives a million steps of every reward, with scenarios:
# those, and the rewards that share their factors and ends with one of these, only cost compilation.
NUM_ENVS, NUM_STEPS = 64, 32_000
REWARDS = ("carl", "carl-nuplan-survival", "roach")


@pytest.fixture(scope="module")
def benchmark():
    spec = importlib.util.spec_from_file_location("reward_invariants", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.fixture(scope="module")
def env(benchmark):
    return benchmark.environment(num_routes=8, seed=0, num_scenario_slots=0)


@pytest.mark.slow
@pytest.mark.parametrize("name", REWARDS)
def test_random_driving_breaks_nothing(benchmark, env, name):
    got = benchmark.measure(env, name, NUM_ENVS, NUM_STEPS)
    assert got["steps"] == NUM_STEPS and got["episodes"] >= NUM_ENVS
    assert set(got["broken"].values()) == {0}, got
    assert sum(count > 0 for count in got["ends"].values()) >= 3
    assert got["return"][0] < got["return"][2]


@pytest.fixture(scope="module")
def ended(env):
    """A state of CaRL's reward that has ended with a collision, by what is logged of it."""
    state = jax.jit(lambda env: env.start(jax.random.key(0)))(env)
    one = jnp.ones((), jnp.float32)
    metrics = {name: jnp.zeros_like(value) for name, value in state.metrics.items()}
    metrics |= {"reward/collision": one, "reward/penalty": one}
    return state.replace(metrics=metrics, done=one)


def broken(benchmark, state, **sums):
    values = {"reward": 1.0, "progress": 2.0, "penalty": 1.0} | sums
    num = jnp.int32(values.pop("num_penalties", 1))
    values = {name: jnp.float32(value) for name, value in values.items()}
    tally = benchmark.check(
        state, benchmark.Sums(**values, num_penalties=num), RewardConfig(name="carl")
    )
    return {what for what, value in tally.broken.items() if bool(value)}


def test_the_checks_find_what_is_wrong(benchmark, ended):
    def logged(**changes):
        values = {key.replace("__", "/"): jnp.float32(value) for key, value in changes.items()}
        return ended.replace(metrics=ended.metrics | values)

    assert broken(benchmark, ended) == set()
    assert broken(benchmark, ended, progress=100.5) == {"progress"}
    assert broken(benchmark, ended, progress=-0.1) == {"progress"}
    assert broken(benchmark, ended, reward=100.5) == {"return"}
    assert broken(benchmark, ended, num_penalties=2) == {"penalty"}
    assert broken(benchmark, ended, num_penalties=0) == {"penalty"}
    assert broken(benchmark, ended, penalty=2.0) == {"penalty_size"}
    assert broken(benchmark, logged(reward__lane=1.1)) == {"soft"}
    assert broken(benchmark, logged(reward__ttc=-0.1)) == {"soft"}
    assert broken(benchmark, logged(episode__route_completion=101.0)) == {"completion"}
    assert broken(benchmark, logged(ego__speed=float("nan"))) == {"finite"}
    running = ended.replace(done=jnp.zeros((), jnp.float32))
    assert broken(benchmark, running) == {"end", "penalty"}
