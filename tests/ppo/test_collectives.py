"""Weak scaling: what devices tell each other is gradients and numbers, however many environments.

Read from the compiled programs, so that what the compiler adds on its own counts as well.
"""

from __future__ import annotations

import dataclasses

import collectives
import jax
import jax.numpy as jnp
import pytest
import toy_env
from jax.sharding import PartitionSpec
from test_trainer import CONFIG as TRAINER_CONFIG
from test_trainer import HASTY, NETWORK

from carljax.ppo import trainer
from carljax.ppo.update import AXIS

NUM_DEVICES = 4
EPOCHS, MINIBATCHES = 3, 2
CONFIG = dataclasses.replace(
    TRAINER_CONFIG, update_epochs=EPOCHS, num_minibatches=MINIBATCHES, micro_batch_size=16
)
MAX_NUMBERS_PER_STEP = 16  # means and counts of one gradient step
MAX_NUMBERS_PER_UPDATE = 32  # and of a rollout


def sent_in_train_step():
    """Compiles the train step; what it sends, and the shapes of the parameters."""
    mesh = trainer.make_mesh(NUM_DEVICES)
    env = trainer.replicate(toy_env.make(), mesh)
    state = jax.eval_shape(lambda env: _first(env, mesh), env)
    placed = jax.tree.map(
        lambda place, part: jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=place), part
        ),
        trainer.shardings(mesh),
        state,
    )
    compiled = trainer.make_train_step(NETWORK, CONFIG, mesh).lower(env, placed).compile(HASTY)
    params = [("f32", leaf.shape) for leaf in jax.tree.leaves(state.params)]
    return collectives.find(compiled.as_text()), params


def _first(env, mesh):
    return trainer.init(jax.random.key(0), env, NETWORK, CONFIG, mesh)


def check_only_gradients_and_numbers(sent, params):
    """Asserts that once per gradient step all gradients are summed, and else scalars alone."""
    assert {one.kind for one in sent} == {"all-reduce"}
    shapes = [(shape, one.times) for one in sent for shape in one.shapes]
    arrays = sorted((shape, times) for shape, times in shapes if shape[1] != ())
    assert arrays == sorted((shape, EPOCHS * MINIBATCHES) for shape in params)
    numbers = sum(times for shape, times in shapes if shape[1] == ())
    assert numbers <= EPOCHS * MINIBATCHES * MAX_NUMBERS_PER_STEP + MAX_NUMBERS_PER_UPDATE


def test_devices_exchange_gradients_and_numbers_alone():
    check_only_gradients_and_numbers(*sent_in_train_step())


def test_nothing_is_sent_to_start():
    mesh = trainer.make_mesh(NUM_DEVICES)
    env = trainer.replicate(toy_env.make(), mesh)
    compiled = jax.jit(lambda env: _first(env, mesh)).lower(env).compile(HASTY)
    assert collectives.find(compiled.as_text()) == []


@pytest.mark.parametrize(
    ("send", "kind", "num_bytes"),
    [
        (lambda x: jax.lax.all_gather(x, AXIS), "all-gather", 4 * 2 * 6),
        (lambda x: jax.lax.ppermute(x, AXIS, [(0, 1), (1, 0)]), "collective-permute", 2 * 6),
        (lambda x: jax.lax.psum(x, AXIS), "all-reduce", 4 * 2 * 6),
    ],
    ids=["gathered", "passed on", "summed"],
)
def test_it_is_noticed_when_observations_are_sent(send, kind, num_bytes):
    """Beside the sum of a gradient of (3, 2) numbers in each of all steps."""

    def local(obs):
        def step(total, _):
            return total + jax.lax.psum(total * total[0], AXIS), None

        total, _ = jax.lax.scan(step, jnp.ones((3, 2)), None, length=EPOCHS * MINIBATCHES)
        return total, send(obs)

    mesh, spec = trainer.make_mesh(NUM_DEVICES), PartitionSpec(AXIS)
    program = jax.shard_map(local, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    obs = jnp.zeros((2 * NUM_DEVICES, 6), jnp.int32 if kind == "all-reduce" else jnp.uint8)
    sent = collectives.find(jax.jit(program).lower(obs).compile().as_text())
    found = {(one.kind, one.num_bytes, one.times) for one in sent}
    assert found == {("all-reduce", 3 * 2 * 4, EPOCHS * MINIBATCHES), (kind, num_bytes, 1)}
    gradient = [("f32", (3, 2))]
    check_only_gradients_and_numbers([one for one in sent if one.times > 1], gradient)
    with pytest.raises(AssertionError):
        check_only_gradients_and_numbers(sent, gradient)
