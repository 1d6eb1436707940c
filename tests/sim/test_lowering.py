"""The train step as a program for a GPU and a TPU, made on a machine that has neither."""

from __future__ import annotations

import functools
import re

import jax
import pytest
from small_world import crossing

from carljax.ppo import trainer
from carljax.ppo.config import NetworkConfig, PPOConfig
from carljax.ppo.networks import ActorCritic
from carljax.reward.config import RewardConfig
from carljax.sim import bank_padding, episodes, town
from carljax.sim.env import EnvConfig, make_env
from carljax.sim.raster_canvas import RasterConfig

RASTER = RasterConfig(height=16, width=16, pixels_per_metre=1.0, ego_from_bottom_px=4)
PPO = PPOConfig(
    total_samples=16,
    num_envs=4,
    num_steps=4,
    num_minibatches=2,
    update_epochs=2,
    micro_batch_size=4,
)


pytestmark = pytest.mark.slow


@functools.cache
def _traced(kind, encoder):
    """The train step of a tiny world, before a platform is chosen."""
    config = EnvConfig(
        num_agents=3, num_pedestrians=1, num_scenario_slots=1, observation=kind, raster=RASTER
    )
    reward = RewardConfig(name={"carla": "carl", "nuplan": "carl-nuplan"}.get(kind, kind))
    bank = episodes.make_bank([town.from_network(crossing())], 2, config.population, 0, 60.0)
    env = make_env(bank_padding.pad(bank), config, reward)
    mesh = trainer.make_mesh(1)
    network = ActorCritic(NetworkConfig(encoder=encoder, hidden_size=8, joint_size=8))
    state = jax.eval_shape(
        lambda env: trainer.init(jax.random.key(0), env, network, PPO, mesh), env
    )
    return trainer.make_train_step(network, PPO, mesh).trace(env, state)


@pytest.mark.parametrize(
    ("kind", "encoder"), [("carla", "patch"), ("roach", "carl"), ("nuplan", "carl")]
)
def test_the_train_step_is_lowered_for_accelerators(kind, encoder):
    traced = _traced(kind, encoder)
    for platform in ("cuda", "tpu"):
        text = traced.lower(lowering_platforms=(platform,)).as_text()
        called = set(re.findall(r"custom_call\s*@(\w+)", text))
        assert not {name for name in called if "callback" in name or "python" in name}, platform
        assert not re.search(r"tensor<[^>]*\?", text), platform  # a size known only at run time
        assert not re.search(r"[<x]f64\b", text), platform
        assert "stablehlo.convolution" in text or encoder == "patch"
        # The forms that are fast on a CPU alone are kept apart by these; see `conv`.
        assert "optimization_barrier" not in text, platform


def test_what_the_test_above_looks_for_is_there_on_a_cpu():
    text = _traced("carla", "patch").lower(lowering_platforms=("cpu",)).as_text()
    assert "optimization_barrier" in text
