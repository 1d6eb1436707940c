"""Random numbers that are written out are JAX's own, bit for bit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from carljax.sim import threefry

DRAWS = {
    "split": lambda key: jax.random.key_data(jax.random.split(key, (2, 3))),
    "fold_in": lambda key: jax.random.key_data(jax.random.fold_in(key, 7)),
    "uniform": lambda key: jax.random.uniform(key, (5, 2)),
    "one": lambda key: jax.random.uniform(key, ()),
    "normal": lambda key: jax.random.normal(key, (7,)),
    "randint": lambda key: jax.random.randint(key, (9,), 0, 1000),
    "bernoulli": lambda key: jax.random.bernoulli(key, 0.3, (20,)),
    "bytes": lambda key: jax.random.bits(key, (6,), "uint8"),
    "permutation": lambda key: jax.random.permutation(key, 10),
    "from a split": lambda key: jax.random.uniform(jax.random.split(key)[1], (3,)),
}


@pytest.mark.parametrize("name", DRAWS)
def test_draws_what_jax_draws(name):
    for seed in (0, 1, 2**31 - 1):
        key = jax.random.key(seed)
        want, got = DRAWS[name](key), jax.jit(DRAWS[name])(threefry.written_out(key))
        assert got.dtype == want.dtype
        np.testing.assert_array_equal(got, want)


def test_many_keys_at_once():
    keys = jax.random.split(jax.random.key(3), 4)
    want = jax.vmap(jax.random.uniform)(keys)
    np.testing.assert_array_equal(jax.vmap(jax.random.uniform)(threefry.written_out(keys)), want)


def test_goes_back_to_the_key_it_was():
    key = jax.random.key(5)
    back = threefry.like(threefry.written_out(key), key)
    assert back.dtype == key.dtype
    np.testing.assert_array_equal(jax.random.key_data(back), jax.random.key_data(key))


def test_other_generators_stay():
    key = jax.random.key(0, impl="rbg")
    assert threefry.written_out(key) is key
    twice = threefry.written_out(threefry.written_out(jax.random.key(0)))
    assert twice.dtype == threefry.written_out(jax.random.key(0)).dtype


def test_compiles_to_no_loop():
    def draw(key):
        return jax.random.uniform(threefry.written_out(key), (8,))

    text = jax.jit(draw).lower(jax.random.key(0)).compile().as_text()
    assert "while(" not in text
    assert jnp.isfinite(draw(jax.random.key(0))).all()
