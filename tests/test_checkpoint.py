"""Checkpoints: exact, kept by age and score, restored onto other devices, clear when missing."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import struct
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from carljax import checkpoint


@struct.dataclass
class SmallState:
    """Has what a training state has: parameters, optimiser, batched keys, a counter, bytes."""

    params: Any
    opt_state: Any
    keys: jax.Array
    raster: jax.Array
    update: jax.Array


def make_state(value: float, num_devices: int = 1) -> SmallState:
    mesh = Mesh(np.array(jax.devices()[:num_devices]), ("data",))
    batched = NamedSharding(mesh, PartitionSpec("data"))
    copied = NamedSharding(mesh, PartitionSpec())
    params = jax.device_put({"dense": {"kernel": jnp.full((3, 2), value)}}, copied)
    return SmallState(
        params=params,
        opt_state=jax.device_put(optax.adam(1e-3).init(params), copied),
        keys=jax.device_put(jax.random.split(jax.random.key(int(value)), 4), batched),
        raster=jax.device_put(jnp.full((4, 2, 2), int(value), jnp.uint8), batched),
        update=jax.device_put(jnp.int32(value), copied),
    )


def assert_same(left: SmallState, right: SmallState) -> None:
    for a, b in zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True):
        assert a.dtype == b.dtype
        if jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(a, b)


def test_restores_every_leaf_exactly(tmp_path):
    saved = make_state(7)
    checkpoint.save(tmp_path, saved, update=7, score=0.5, keep=2)
    assert_same(checkpoint.restore(tmp_path, make_state(0)), saved)


def test_arrays_without_elements_come_back(tmp_path):
    """As those of a world without pedestrians or scenarios."""
    empty = jnp.zeros((4, 0, 2), jnp.uint8)
    saved = make_state(7).replace(raster=empty)
    checkpoint.save(tmp_path, saved, update=7, score=0.5, keep=2)
    restored = checkpoint.restore(tmp_path, make_state(0).replace(raster=empty))
    assert_same(restored, saved)
    assert restored.raster.shape == (4, 0, 2)


@struct.dataclass
class LaterState(SmallState):
    """The same with a part that a run may lack."""

    patience: Any = None


def test_a_part_that_a_run_lacks_is_not_asked_for(tmp_path):
    """Neither of a state that was saved before there was such a part."""
    rest = {name: getattr(make_state(7), name) for name in make_state(7).__dataclass_fields__}
    checkpoint.save(tmp_path, make_state(7), update=7, score=0.5, keep=2)
    assert_same(checkpoint.restore(tmp_path, LaterState(**rest)), make_state(7))
    checkpoint.save(tmp_path, LaterState(**rest, patience=jnp.int32(3)), 8, 0.5, keep=2)
    like = LaterState(**rest, patience=jnp.int32(0))
    assert int(checkpoint.restore(tmp_path, like).patience) == 3


def test_parameters_can_be_restored_alone(tmp_path):
    checkpoint.save(tmp_path, make_state(7), update=7, score=0.5, keep=2)
    params = checkpoint.restore_params(tmp_path, make_state(0).params)
    np.testing.assert_array_equal(params["dense"]["kernel"], np.full((3, 2), 7.0))


@pytest.mark.parametrize(("saved_on", "restored_on"), [(4, 1), (1, 4), (4, 2)])
def test_restores_onto_another_number_of_devices(tmp_path, saved_on, restored_on):
    checkpoint.save(tmp_path, make_state(3, saved_on), update=3, score=0.0, keep=1)
    restored = checkpoint.restore(tmp_path, make_state(0, restored_on))
    assert_same(restored, make_state(3, saved_on))
    assert len(restored.raster.sharding.device_set) == restored_on
    assert len(restored.keys.sharding.device_set) == restored_on


def test_keeps_the_newest_and_the_best(tmp_path):
    # Scores by update: 1 has none, 2 is the best, 3 to 5 are worse. With two kept: 4 and 5, and 2.
    for update, score in [(1, math.nan), (2, 9.0), (3, 1.0), (4, 2.0), (5, 3.0)]:
        checkpoint.save(tmp_path, make_state(update), update, score, keep=2)
    assert checkpoint.updates(tmp_path) == [2, 4, 5]
    assert checkpoint.best(tmp_path) == 2
    assert int(checkpoint.restore(tmp_path, make_state(0), update=2).update) == 2
    assert int(checkpoint.restore(tmp_path, make_state(0)).update) == 5


def test_the_newest_counts_as_best_while_there_is_no_score(tmp_path):
    checkpoint.save(tmp_path, make_state(1), update=1, score=math.nan, keep=2)
    checkpoint.save(tmp_path, make_state(2), update=2, score=math.nan, keep=2)
    assert checkpoint.best(tmp_path) == 2


def test_saving_the_same_update_twice_keeps_the_first(tmp_path):
    checkpoint.save(tmp_path, make_state(1), update=1, score=0.0, keep=2)
    checkpoint.save(tmp_path, make_state(2), update=1, score=0.0, keep=2)
    assert int(checkpoint.restore(tmp_path, make_state(0)).update) == 1


def test_what_is_missing_is_said_in_one_line(tmp_path):
    assert checkpoint.updates(tmp_path) == []
    assert checkpoint.best(tmp_path) is None
    with pytest.raises(checkpoint.CheckpointError, match=r"no checkpoint in checkpoints/"):
        checkpoint.restore(tmp_path, make_state(0))
    checkpoint.save(tmp_path, make_state(1), update=1, score=0.0, keep=2)
    with pytest.raises(checkpoint.CheckpointError, match=r"update 5; there are \[1\]"):
        checkpoint.restore(tmp_path, make_state(0), update=5)


def test_another_shape_is_refused_in_one_line(tmp_path):
    checkpoint.save(tmp_path, make_state(1), update=1, score=0.0, keep=2)
    with pytest.raises(checkpoint.CheckpointError, match="does not fit") as caught:
        checkpoint.restore_params(tmp_path, {"dense": {"kernel": jnp.zeros((5, 2))}})
    assert "\n" not in str(caught.value)


def test_reading_makes_no_folder(tmp_path):
    with pytest.raises(checkpoint.CheckpointError):
        checkpoint.restore_params(tmp_path / "nowhere", make_state(0).params)
    assert not (tmp_path / "nowhere").exists()
