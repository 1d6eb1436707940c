"""Comfort metrics against SciPy's Savitzky-Golay filter and nuPlan's own unit scenes."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reward_world import DT, VEHICLE, make_ego
from scipy.signal import savgol_filter

from carljax.reward import comfort
from carljax.sim import bicycle
from carljax.sim.types import History

WITH_AND_WITHOUT_JIT = [lambda f: f, jax.jit]


def metrics_oracle(accel_lon, accel_lat, yaw, dt):
    """The newest sample of each metric, float64, by SciPy on the samples there are."""

    def smooth(samples):
        return savgol_filter(samples, 8, 2, mode="interp")

    def slope(samples):
        window = min(15, len(samples))
        return savgol_filter(samples, window, 2, deriv=1, delta=dt, mode="interp")[-1]

    yaw = np.unwrap(yaw)
    magnitude = np.hypot(accel_lon, accel_lat)
    return np.array(
        [
            smooth(accel_lon)[-1],
            smooth(accel_lat)[-1],
            slope(smooth(magnitude)),
            slope(smooth(accel_lon)),
            savgol_filter(yaw, 5, 2, deriv=1, delta=dt, mode="interp")[-1],
            savgol_filter(yaw, 5, 3, deriv=2, delta=dt, mode="interp")[-1],
        ]
    )


def history_of(accel_lon, accel_lat, yaw):
    """A history that these samples (at most 15) were pushed into."""
    num = len(yaw)

    def pad(samples, fill):
        return jnp.asarray(np.r_[np.full(15 - num, fill), samples], jnp.float32)

    return History(
        accel_lon=pad(accel_lon, 0.0),
        accel_lat=pad(accel_lat, 0.0),
        yaw=pad(np.unwrap(yaw), yaw[0]),
        num=jnp.int32(num),
    )


@pytest.mark.parametrize("variant", WITH_AND_WITHOUT_JIT)
@pytest.mark.parametrize("num", [*range(8, 16)])
def test_metrics_match_scipy_for_every_history_length(num, variant):
    rng = np.random.default_rng(num)
    accel_lon, accel_lat = rng.normal(size=(2, num)) * 4
    yaw = 3.0 + np.cumsum(rng.normal(size=num)) * 0.05  # runs over the seam at pi
    got = variant(lambda h: comfort.metrics(h, DT))(history_of(accel_lon, accel_lat, yaw))
    want = metrics_oracle(accel_lon, accel_lat, yaw, DT)
    np.testing.assert_allclose(got, want, rtol=1e-3, atol=2e-3)


@pytest.mark.parametrize("seed", range(6))
def test_random_drives_match_scipy_to_a_hundred_thousandth(seed):
    """Of each metric's limit; the samples are rounded to float32 before SciPy sees them too."""
    rng = np.random.default_rng(seed)
    limits = np.array([20, 9, 30, 30, 1, 3])
    for num in (8, 11, 15):
        samples = np.cumsum(rng.normal(size=(3, num)), axis=1) * [[0.7], [0.7], [0.03]]
        samples = samples.astype(np.float32).astype(float)
        got = comfort.metrics(history_of(*samples), DT)
        want = metrics_oracle(*samples, DT)
        np.testing.assert_allclose(got / limits, want / limits, rtol=1e-5, atol=1e-5)


def test_pushing_a_drive_keeps_the_newest_fifteen_and_unwraps_the_yaw():
    rng = np.random.default_rng(3)
    steers, pedals = rng.uniform(0.2, 1.0, 40), rng.uniform(-0.5, 1.0, 40)
    ego = make_ego(speed=6.0, yaw=2.5)
    history = comfort.empty_history(ego)
    log = []
    for steer, pedal in zip(steers, pedals, strict=True):
        controls = (steer, max(pedal, 0.0), max(-pedal, 0.0))
        ego = bicycle.step(ego, *(jnp.float32(c) for c in controls), VEHICLE, DT)
        history = comfort.push(history, ego)
        slip, centripetal = float(ego.slip), float(ego.speed * ego.yaw_rate)
        along = np.array([np.cos(slip), np.sin(slip)])
        left = np.array([-np.sin(slip), np.cos(slip)])
        log.append([*(float(ego.accel) * along + centripetal * left), float(ego.yaw)])
        if len(log) >= 8:
            newest = np.array(log[-15:]).T
            want = metrics_oracle(*newest, DT)
            np.testing.assert_allclose(comfort.metrics(history, DT), want, rtol=2e-3, atol=5e-3)
    assert int(history.num) == 40
    assert abs(float(history.yaw[-1])) > np.pi  # it went round and was not wrapped


def test_known_weights():
    # Facts about the filters: SciPy's fits at the last sample.
    np.testing.assert_allclose(
        comfort.ACCEL_WEIGHTS[-8:],
        [0.125, -1 / 24, -0.125, -0.125, -1 / 24, 0.125, 0.375, 17 / 24],
        atol=1e-6,
    )
    np.testing.assert_allclose(
        comfort.YAW_RATE_WEIGHTS[-5:] / 0.1,
        [3.71429, -3.85714, -5.71429, -1.85714, 7.71429],
        atol=1e-4,
    )
    np.testing.assert_allclose(
        comfort.YAW_ACCEL_WEIGHTS[-5:] / 0.01,
        [-71.42857, 185.71429, -28.57143, -214.28571, 128.57143],
        rtol=1e-5,
    )
    jerk = [0.70658, 0.41567, 0.13771, -0.13158, -0.37538, -0.56001, -0.63920, -0.48751]
    jerk += [-0.65942, -0.55770, -0.32126, 0.00415, 0.38564, 0.80739, 1.27491]
    np.testing.assert_allclose(comfort.JERK_WEIGHTS[-1] / 0.1, jerk, atol=1e-4)


def test_limits_are_the_paper_s_table():
    assert comfort.LIMITS["carla"] == (
        (-20, 10), (-9, 9), (-30, 30), (-30, 30), (-1.0, 1.0), (-3.0, 3.0)
    )  # fmt: skip
    assert comfort.LIMITS["nuplan"] == (
        (-4.05, 2.40), (-4.89, 4.89), (-8.37, 8.37), (-4.13, 4.13), (-0.95, 0.95), (-1.93, 1.93)
    )  # fmt: skip


@pytest.mark.parametrize(
    ("accel_lon", "accel_lat", "yaw_rate", "expected"),
    # Constant motion: accelerations as they are, no jerk, yaw rate as it is, no yaw acceleration.
    [
        (9.9, 8.9, 0.9, []),
        (10.1, 0.0, 0.0, [0]),
        (-19.0, 0.0, 0.0, []),
        (-21.0, -9.1, -1.1, [0, 1, 4]),
    ],
)
def test_constant_motion_against_carla_limits(accel_lon, accel_lat, yaw_rate, expected):
    ones = np.ones(15)
    history = history_of(accel_lon * ones, accel_lat * ones, yaw_rate * DT * np.arange(15))
    got = comfort.violated(history, comfort.LIMITS["carla"], DT)
    assert list(np.flatnonzero(got)) == expected


def test_nuplan_limits_are_stricter():
    ones = np.ones(15)
    history = history_of(2.5 * ones, 5.0 * ones, 0.97 * DT * np.arange(15))
    assert not comfort.violated(history, comfort.LIMITS["carla"], DT).any()
    got = comfort.violated(history, comfort.LIMITS["nuplan"], DT)
    assert list(np.flatnonzero(got)) == [0, 1, 4]


def test_ramps_and_parabolas_pass_the_filters_as_they_are():
    # At t = 1.4 s: a_lon = -22 + 31 t is 21.4 m/s^2; yaw = 1.6 t^2 has rate 4.48, acceleration 3.2.
    t = np.arange(15) * DT
    got = comfort.metrics(history_of(-22 + 31 * t, 0 * t, 1.6 * t**2), DT)
    np.testing.assert_allclose(got[0], 21.4, rtol=1e-4)
    np.testing.assert_allclose(got[4:], [4.48, 3.2], rtol=1e-3)


def test_jerk_of_a_ramp_reads_low_for_the_filter_s_even_window():
    # Smoothed inside half a sample late, at the ends on time: its slope is 0.826 of the ramp's.
    t = np.arange(15) * DT
    smoothed = 10 * (t + np.r_[np.zeros(4), np.full(7, 0.05), np.zeros(4)])
    want = np.polyval(np.polyder(np.polyfit(t, smoothed, 2)), 1.4)
    got = comfort.metrics(history_of(10 * t, 0 * t, 0 * t), DT)
    np.testing.assert_allclose(got[2:4], [want, want], rtol=1e-3)
    np.testing.assert_allclose(want, 8.26, atol=0.01)


def test_fewer_than_eight_samples_are_not_judged():
    for num, expected in ((7, False), (8, True)):
        ones = np.ones(num)
        history = history_of(50 * ones, 50 * ones, np.arange(num) * 1.0)
        assert bool(comfort.violated(history, comfort.LIMITS["carla"], DT).any()) is expected


def test_factor_loses_a_twelfth_per_metric():
    ticks = jnp.array([0, 3, 0, 500, 0, 0], jnp.int32)
    np.testing.assert_allclose(comfort.factor(ticks, 0.5), 1 - 0.5 * 2 / 6, rtol=1e-6)
    np.testing.assert_allclose(comfort.factor(ticks, 1.0), 4 / 6, rtol=1e-6)  # passed / 6


@pytest.mark.parametrize(
    ("scene", "metric"),
    [
        ("ego_lon_acceleration__ego_lon_acceleration", 0),
        ("ego_jerk__ego_jerk", 2),
        ("ego_yaw_rate__ego_yaw_rate", 4),
    ],
)
def test_nuplan_s_unit_scenes(shared_data, scene, metric):
    path = shared_data / "nuplan_metrics" / f"{scene}.json"
    if not path.is_file():
        pytest.skip(f"private reference data is not at {path}")
    data = json.loads(path.read_text())
    states = [data["ego"], *data["ego_future_states"]]
    accel = np.array([state["acceleration"] for state in states], float).T
    yaw = np.array([state["pose"][2] for state in states], float)
    dt = (states[1]["time_us"] - states[0]["time_us"]) / 1e6
    got = comfort.metrics(history_of(*accel, yaw), dt)[metric]
    np.testing.assert_allclose(got, data["expected"]["time_series"]["values"][-1], atol=0.0051)
