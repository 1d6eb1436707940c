"""The Intelligent Driver Model against a float64 oracle and what its authors say of it."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from carljax.sim import idm

PARAMS = idm.IDMParams()
WITH_AND_WITHOUT_JIT = [lambda f: f, jax.jit]


def accel_oracle(v, s, v_leader, v0, *, s0=2.0, headway=1.0, a=1.0, b=1.5, b_max=8.0, delta=4):
    """Scalar float64."""
    wanted = s0 + max(0.0, v * headway + v * (v - v_leader) / (2 * math.sqrt(a * b)))
    accel = a * (1 - math.pow(v / max(v0, 0.1), delta) - (wanted / max(s, 0.1)) ** 2)
    return max(accel, -b_max)


@pytest.mark.parametrize("variant", WITH_AND_WITHOUT_JIT)
def test_random_pairs_match_float64_oracle(variant):
    rng = np.random.default_rng(0)
    num = 300
    v, v_leader = rng.uniform(0, 30, num), rng.uniform(0, 30, num)
    s, v0 = rng.uniform(-1, 100, num), rng.uniform(0, 30, num)
    args = (jnp.asarray(x, jnp.float32) for x in (v, s, v_leader, v0))
    got = variant(lambda *a: idm.acceleration(*a, PARAMS))(*args)
    want = [accel_oracle(*args) for args in zip(v, s, v_leader, v0, strict=True)]
    assert got.dtype == jnp.float32
    np.testing.assert_allclose(got, want, rtol=2e-5, atol=2e-5)
    assert -8 < np.median(want) and min(want) == -8.0  # both branches are met


def test_other_drivers_match_float64_oracle():
    # PDM-Lite's: a 24, b 8.7, s0 4, T 0.25, and PDM-Closed's exponent 10.
    params = idm.IDMParams(4.0, 0.25, 24.0, 8.7, 50.0, 10)
    got = idm.acceleration(*(jnp.float32(x) for x in (9.0, 25.0, 6.0, 12.0)), params)
    want = accel_oracle(9, 25, 6, 12, s0=4, headway=0.25, a=24, b=8.7, b_max=50, delta=10)
    np.testing.assert_allclose(got, want, rtol=1e-5)


@pytest.mark.parametrize(
    ("speed", "gap", "leader", "desired", "expected"),
    [
        (0.0, np.inf, 0.0, 10.0, 1.0),  # free road from rest: a
        (10.0, np.inf, 0.0, 10.0, 0.0),  # free road at the desired speed
        (5.0, np.inf, 0.0, 10.0, 1 - 0.5**4),
        (0.0, 2.0, 0.0, 10.0, 0.0),  # at rest at the minimal gap
        # 10 m/s behind an equal leader at 24 m: s* = 2 + 10 = 12; 1 - 0.5^4 - (12 / 24)^2
        (10.0, 24.0, 10.0, 20.0, 1 - 0.0625 - 0.25),
        # the leader runs away: s* = 2 + max(0, 2 + 2 * (2 - 20) / 2.449) = 2
        (2.0, 4.0, 20.0, 20.0, 1 - 1e-4 - 0.25),
    ],
)
def test_by_hand(speed, gap, leader, desired, expected):
    args = (jnp.float32(x) for x in (speed, gap, leader, desired))
    np.testing.assert_allclose(idm.acceleration(*args, PARAMS), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("speed", [0.0, 3.0, 8.0, 13.0])
def test_no_acceleration_at_the_equilibrium_gap(speed):
    gap = idm.equilibrium_gap(jnp.float32(speed), jnp.float32(14.0), PARAMS)
    accel = idm.acceleration(jnp.float32(speed), gap, jnp.float32(speed), jnp.float32(14.0), PARAMS)
    np.testing.assert_allclose(accel, 0.0, atol=1e-5)


def test_no_finite_equilibrium_at_the_desired_speed():
    assert np.isinf(idm.equilibrium_gap(jnp.float32(14.0), jnp.float32(14.0), PARAMS))


def test_monotone_in_gap_leader_speed_and_own_speed():
    def accel(speed=8.0, gap=20.0, leader=7.0, desired=14.0):
        return np.asarray(
            idm.acceleration(*map(jnp.asarray, (speed, gap, leader, desired)), PARAMS)
        )

    assert np.all(np.diff(accel(gap=np.linspace(-2, 200, 100, dtype=np.float32))) >= 0)
    assert np.all(np.diff(accel(leader=np.linspace(0, 20, 100, dtype=np.float32))) >= 0)
    assert np.all(np.diff(accel(speed=np.linspace(0, 30, 100, dtype=np.float32))) <= 0)
    assert np.all(np.diff(accel(desired=np.linspace(0, 30, 100, dtype=np.float32))) >= 0)


def test_finite_at_every_extreme():
    values = jnp.array([0.0, 1e-6, 1.0, 60.0])
    gaps = jnp.array([-5.0, 0.0, 1e-6, 1.0, 1e6, jnp.inf])
    accel = idm.acceleration(
        values[:, None, None, None], gaps[:, None, None], values[:, None], values, PARAMS
    )
    assert np.all(np.isfinite(accel))
    assert accel.min() >= -PARAMS.brake_max and accel.max() <= PARAMS.accel_max


def test_follower_stops_behind_a_standing_leader_without_touching_it():
    def drive(carry, _):
        speed, gap = carry
        accel = idm.acceleration(speed, gap, jnp.float32(0), jnp.float32(14), PARAMS)
        new = jnp.maximum(speed + 0.1 * accel, 0.0)
        return (new, gap - 0.05 * (speed + new)), gap

    (speed, gap), gaps = jax.lax.scan(drive, (jnp.float32(13.0), jnp.float32(120.0)), None, 1000)
    assert gaps.min() > 1.0
    assert speed < 0.05
    np.testing.assert_allclose(gap, PARAMS.min_gap, atol=0.3)
