"""Ways to keep observations: updates equal bit for bit, and the choice among them."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy_env

from carljax.ppo import obs_storage, trainer
from carljax.ppo.config import NetworkConfig, PPOConfig
from carljax.ppo.networks import ActorCritic

NETWORK = ActorCritic(
    NetworkConfig(
        encoder="patch", hidden_size=16, joint_size=16, patch_size=4, patch_features=(4, 8)
    )
)
CONFIG = PPOConfig(num_envs=8, num_steps=16, num_minibatches=2, micro_batch_size=16)
GIB = 2**30


@functools.cache
def _two_updates(name):
    """Parameters and metrics after two updates, as NumPy."""
    mesh = trainer.make_mesh(2)
    env = trainer.replicate(toy_env.make(), mesh)
    state = trainer.init(jax.random.key(0), env, NETWORK, CONFIG, mesh)
    step = trainer.make_train_step(NETWORK, CONFIG, mesh, obs_storage.STORAGES[name])
    for _ in range(2):
        state, metrics = step(env, state)
    return jax.device_get((state.params, metrics))


@pytest.mark.parametrize("name", ["pack", "rerender"])
def test_updates_do_not_depend_on_how_observations_are_kept(name):
    stored, other = _two_updates("store"), _two_updates(name)
    jax.tree.map(np.testing.assert_array_equal, stored, other)
    assert float(stored[1]["ppo/grad_norm"]) > 0.0


def test_seeds_side_by_side_draw_again_what_each_would_alone():
    mesh = trainer.make_mesh(1)
    env = trainer.replicate(toy_env.make(), mesh)

    def after_one(storage):
        keys = jax.random.key(0), jax.random.key(1)
        runs = [trainer.init(key, env, NETWORK, CONFIG, mesh) for key in keys]
        step = trainer.make_seeds_step(NETWORK, CONFIG, mesh, storage)
        return jax.device_get(step(env, trainer.stack(runs, mesh))[0].params)

    stored, again = after_one(obs_storage.STORE), after_one(obs_storage.RERENDER)
    jax.tree.map(np.testing.assert_array_equal, stored, again)


def test_to_draw_again_only_what_is_read_is_kept():
    env = toy_env.make()
    state = env.observe(env.start(jax.random.key(0)))
    kept = obs_storage.RERENDER.keep(env, state)
    assert kept.obs is None and kept.reward is None and kept.metrics["toy/distance"] is None
    assert kept.pipeline_state.x is state.pipeline_state.x
    assert kept.pipeline_state.t is state.pipeline_state.t
    again = obs_storage.RERENDER.recall(env, kept)
    jax.tree.map(np.testing.assert_array_equal, again, state.obs)


def test_packed_masks_are_an_eighth_or_less():
    env = toy_env.make()
    state = env.observe(env.start(jax.random.key(0)))
    kept = obs_storage.PACK.keep(env, state)
    assert kept.raster.shape == (toy_env.SIZE, toy_env.SIZE, 1)
    again = obs_storage.PACK.recall(env, kept)
    jax.tree.map(np.testing.assert_array_equal, again, state.obs)
    assert jnp.any(again.raster > 0)


@pytest.mark.parametrize(
    ("available", "name"),
    # 65,536 images of 256 x 256 x 10 are 40 GiB; at 5 bytes a pixel 20 GiB.
    [(80 * GIB, "store"), (80 * GIB - 1, "pack"), (40 * GIB, "pack"), (40 * GIB - 1, "rerender")],
)
def test_the_first_way_whose_images_take_half_of_the_memory_is_chosen(available, name):
    levels = ((255,),) * 6 + (None,) * 4
    assert obs_storage.choose((256, 256, 10), levels, 65_536, available).name == name
