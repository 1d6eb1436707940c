"""Comfort: six metrics of the ego's smoothed motion against limits.

Accelerations are smoothed by a Savitzky-Golay filter (window 8, degree 2); jerks are the derivative
(window 15 or all there is, degree 2) of the smoothed magnitude and of the smoothed longitudinal
acceleration; yaw rate and yaw acceleration come from the unwrapped yaw (window 5, degrees 2 and 3).
Ends are fitted, not padded. Only the newest filtered sample is tested, and a linear filter's newest
sample is a dot product with fixed weights, which are computed here once. source: the nuPlan comfort
metrics as the authors' code applies them at each step.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from carljax.sim.geometry import wrap_angle
from carljax.sim.types import EgoState, History

HISTORY_LENGTH = 15  # samples. source: the authors' code
MIN_SAMPLES = 8  # fewer are not judged. source: the authors' code
METRICS = ("accel_lon", "accel_lat", "jerk", "jerk_lon", "yaw_rate", "yaw_accel")

# Lower and upper limits in the order of `METRICS`; m/s^2, m/s^2, m/s^3, m/s^3, rad/s, rad/s^2.
# source: paper, table of comfort thresholds
LIMITS = {
    "carla": (
        (-20.0, 10.0),
        (-9.0, 9.0),
        (-30.0, 30.0),
        (-30.0, 30.0),
        (-1.0, 1.0),
        (-3.0, 3.0),
    ),
    "nuplan": (
        (-4.05, 2.40),
        (-4.89, 4.89),
        (-8.37, 8.37),
        (-4.13, 4.13),
        (-0.95, 0.95),
        (-1.93, 1.93),
    ),
}


def fit_weights(window: int, degree: int, place: float, derivative: int) -> np.ndarray:
    """Weights that evaluate the least-squares polynomial through a window of samples.

    Args:
      window: samples, one unit of time apart.
      degree: of the polynomial.
      place: where to evaluate it, 0 at the oldest sample.
      derivative: 0, 1 or 2.

    Returns:
      (window,) float64.
    """
    powers = np.arange(degree + 1)
    coefficients = np.linalg.pinv(np.arange(window)[:, None] ** powers * 1.0)
    basis = np.zeros(degree + 1)
    for power in powers[derivative:]:
        falling = np.prod(np.arange(power - derivative + 1, power + 1))
        basis[power] = falling * place ** (power - derivative)
    return basis @ coefficients


def smoothing_matrix(num: int) -> np.ndarray:
    """The filter of window 8, degree 2 as a matrix on `num` samples.

    An even window has no middle sample: inside, SciPy evaluates half a sample later than the sample
    filtered, and so do we. It makes the jerk of a steady ramp read 0.83 of its slope.

    Args:
      num: samples, at least 8.

    Returns:
      (num, num) float64.
    """
    window, half = 8, 4
    matrix = np.zeros((num, num))
    for i in range(num):
        start = min(max(i - half + 1, 0), num - window)
        at_end = i < half or i >= num - half
        place = i - start if at_end else half - 0.5
        matrix[i, start : start + window] = fit_weights(window, 2, place, 0)
    return matrix


def _newest(weights: np.ndarray) -> np.ndarray:
    """Weights of the newest samples, padded in front to the whole history: (15,) float32."""
    return np.pad(weights, (HISTORY_LENGTH - len(weights), 0)).astype(np.float32)


def _jerk_weights() -> np.ndarray:
    """(8, 15) weights of the jerk times dt from 8, 9, ... 15 samples."""
    rows = []
    for num in range(MIN_SAMPLES, HISTORY_LENGTH + 1):
        slope = fit_weights(num, 2, num - 1, 1)  # the window is all there is
        rows.append(_newest(slope @ smoothing_matrix(num)))
    return np.stack(rows)


ACCEL_WEIGHTS = _newest(fit_weights(8, 2, 7, 0))
YAW_RATE_WEIGHTS = _newest(fit_weights(5, 2, 4, 1))  # times dt
YAW_ACCEL_WEIGHTS = _newest(fit_weights(5, 3, 4, 2))  # times dt^2
JERK_WEIGHTS = _jerk_weights()  # times dt


def empty_history(ego: EgoState) -> History:
    """A history without samples.

    Args:
      ego: the ego at the start, whose yaw the unwrapping begins with.

    Returns:
      A history of length 15.
    """
    zeros = jnp.zeros(HISTORY_LENGTH, jnp.float32)
    yaw = jnp.broadcast_to(ego.yaw, (HISTORY_LENGTH,))
    return History(accel_lon=zeros, accel_lat=zeros, yaw=yaw, num=jnp.int32(0))


def body_acceleration(ego: EgoState) -> tuple[jax.Array, jax.Array]:
    """Acceleration along and left of the body: along the motion plus centripetal.

    The slip's own rate is left out: in this model slip follows the wheel at once, which a car's
    does not.

    Args:
      ego: the ego.

    Returns:
      Two () m/s^2.
    """
    cos, sin = jnp.cos(ego.slip), jnp.sin(ego.slip)
    centripetal = ego.speed * ego.yaw_rate
    return ego.accel * cos - centripetal * sin, ego.accel * sin + centripetal * cos


def push(history: History, ego: EgoState) -> History:
    """Appends the ego's motion and drops the oldest sample.

    Args:
      history: up to the step before.
      ego: the ego now.

    Returns:
      The history with one more sample.
    """
    accel_lon, accel_lat = body_acceleration(ego)
    yaw = history.yaw[-1] + wrap_angle(ego.yaw - history.yaw[-1])

    def append(samples: jax.Array, newest: jax.Array) -> jax.Array:
        return jnp.concatenate([samples[1:], newest[None]])

    return History(
        accel_lon=append(history.accel_lon, accel_lon),
        accel_lat=append(history.accel_lat, accel_lat),
        yaw=append(history.yaw, yaw),
        num=history.num + 1,
    )


def metrics(history: History, dt: float) -> jax.Array:
    """The six metrics at the newest sample; meaningless below 8 samples.

    Args:
      history: ego motion.
      dt: s between samples.

    Returns:
      (6,) in the order and units of `METRICS` and `LIMITS`.
    """
    magnitude = jnp.hypot(history.accel_lon, history.accel_lat)
    row = jnp.clip(history.num, MIN_SAMPLES, HISTORY_LENGTH) - MIN_SAMPLES
    jerk_weights = jnp.asarray(JERK_WEIGHTS)[row]
    yaw = history.yaw - history.yaw[-1]  # derivatives don't see it, float32 does

    def dot(weights: jax.Array | np.ndarray, samples: jax.Array) -> jax.Array:
        return jnp.sum(weights * samples)

    return jnp.stack(
        [
            dot(ACCEL_WEIGHTS, history.accel_lon),
            dot(ACCEL_WEIGHTS, history.accel_lat),
            dot(jerk_weights, magnitude) / dt,
            dot(jerk_weights, history.accel_lon) / dt,
            dot(YAW_RATE_WEIGHTS, yaw) / dt,
            dot(YAW_ACCEL_WEIGHTS, yaw) / dt**2,
        ]
    )


def violated(history: History, limits: tuple[tuple[float, float], ...], dt: float) -> jax.Array:
    """Which metrics are beyond their limits; none below 8 samples.

    Args:
      history: ego motion.
      limits: of `LIMITS`.
      dt: s between samples.

    Returns:
      (6,) bool in the order of `METRICS`.
    """
    values = metrics(history, dt)
    bounds = np.asarray(limits, np.float32)
    beyond = (values < bounds[:, 0]) | (values > bounds[:, 1])
    return beyond & (history.num >= MIN_SAMPLES)


def factor(ticks_left: jax.Array, weight: jax.Array | float) -> jax.Array:
    """Soft factor 1 - weight * #/6 with # penalties holding. source: paper, Soft Penalties.

    Args:
      ticks_left: (6,) int32, from `timer.tick`.
      weight: lost when all six hold.

    Returns:
      () in [0, 1].
    """
    return 1.0 - weight * jnp.mean(ticks_left > 0, dtype=jnp.float32)
