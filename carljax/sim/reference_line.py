"""Reference lines of OpenDRIVE roads: cubics over s, and the five planView geometries.

Source: ASAM OpenDRIVE 1.8, sections 8.2-8.7 (line, arc, spiral, poly3, paramPoly3) and 9.2
  (cubics).
Everything is float64 NumPy over vectors of arc lengths; angles rad, lengths m.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.special import fresnel

# Below this change of heading over a piece, its curvature counts as constant (error < length *
# this).
_SPIRAL_EPS = 1e-9
# Cells of the arc length tables of poly3 and paramPoly3.
_TABLE_STEP, _TABLE_MIN, _TABLE_MAX = 0.5, 16, 4096
_GAUSS_X, _GAUSS_W = np.polynomial.legendre.leggauss(6)


@dataclasses.dataclass(frozen=True)
class Cubics:
    """Records a + b ds + c ds^2 + d ds^3, each valid from its start to the next record's.

    Attributes:
      start: (N,) float64 ascending, m; of equal starts the last record holds.
      coeff: (N, 4) float64, a b c d.
    """

    start: np.ndarray
    coeff: np.ndarray

    def at(self, s: np.ndarray, pick: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values and slopes at `s` of the records in force at `pick`; 0 before the first record.

        `pick` differs from `s` at a section's end alone, where the record that ends there still
        holds.
        """
        if not len(self.start):
            return np.zeros_like(s), np.zeros_like(s)
        row = np.searchsorted(self.start, pick, side="right") - 1
        before = row < 0
        row = np.maximum(row, 0)
        a, b, c, d = self.coeff[row].T
        ds = s - self.start[row]
        value = a + ds * (b + ds * (c + ds * d))
        slope = b + ds * (2.0 * c + ds * 3.0 * d)
        return np.where(before, 0.0, value), np.where(before, 0.0, slope)


@dataclasses.dataclass(frozen=True)
class PlanarCurve:
    """A curve (u(p), v(p)) of cubics with a table of its arc length: poly3 and paramPoly3.

    Attributes:
      u, v: (4,) float64, coefficients in p.
      p: (T,) float64, table of the parameter.
      arc: (T,) float64, arc length at each of them, m.
      scale: arc length of the curve over the length that the file gives it.
    """

    u: np.ndarray
    v: np.ndarray
    p: np.ndarray
    arc: np.ndarray
    scale: float


@dataclasses.dataclass(frozen=True)
class ReferenceLine:
    """The planView of one road.

    Attributes:
      start, x, y, hdg, length: (N,) float64 as in the file.
      curvature, curvature_rate: (N,) float64, 1/m at the start and 1/m^2 (lines, arcs, spirals).
      curves: piece index -> curve, for poly3 and paramPoly3.
    """

    start: np.ndarray
    x: np.ndarray
    y: np.ndarray
    hdg: np.ndarray
    length: np.ndarray
    curvature: np.ndarray
    curvature_rate: np.ndarray
    curves: dict[int, PlanarCurve]


def _cubic(coeff: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Value, first and second derivative of a cubic."""
    a, b, c, d = coeff
    return a + p * (b + p * (c + p * d)), b + p * (2 * c + p * 3 * d), 2 * c + p * 6 * d


def _slope(coeff: np.ndarray, p: np.ndarray) -> np.ndarray:
    """First derivative of a cubic."""
    return coeff[1] + p * (2 * coeff[2] + p * (3 * coeff[3]))


def _arc_between(u: np.ndarray, v: np.ndarray, p0: np.ndarray, p1: np.ndarray) -> np.ndarray:
    """Arc lengths from each p0 to its p1 by 6-point Gauss-Legendre quadrature."""
    half = (p1 - p0) / 2
    p = (p0 + p1)[:, None] / 2 + half[:, None] * _GAUSS_X
    return half * (np.hypot(_slope(u, p), _slope(v, p)) @ _GAUSS_W)


def planar_curve(u: np.ndarray, v: np.ndarray, p_max: float, length: float | None) -> PlanarCurve:
    """Tabulates the arc length of (u(p), v(p)) over p in [0, p_max].

    Args:
      u: (4,) coefficients along the start's heading.
      v: (4,) coefficients to its left.
      p_max: end of the parameter's range.
      length: the length given for this very range (paramPoly3: s is stretched so that the piece
        ends at p_max), or None where the range only bounds the piece (poly3: s is true arc length).
    """
    estimate = p_max if length is None else length
    cells = int(np.clip(np.ceil(estimate / _TABLE_STEP), _TABLE_MIN, _TABLE_MAX))
    p = np.linspace(0.0, p_max, cells + 1)
    arc = np.concatenate([[0.0], np.cumsum(_arc_between(u, v, p[:-1], p[1:]))])
    scale = float(arc[-1] / length) if length else 1.0
    return PlanarCurve(u, v, p, arc, scale)


def _parameter_at(curve: PlanarCurve, ds: np.ndarray) -> np.ndarray:
    """The parameter at arc lengths from the piece's start: table, then Newton's method."""
    arc = ds * curve.scale
    row = np.clip(np.searchsorted(curve.arc, arc, side="right") - 1, 0, len(curve.p) - 2)
    p0, arc0 = curve.p[row], curve.arc[row]
    cell = np.maximum(curve.arc[row + 1] - arc0, 1e-300)
    step = curve.p[1] - curve.p[0]
    p = p0 + (arc - arc0) / cell * step
    for _ in range(3):
        speed = np.hypot(_slope(curve.u, p), _slope(curve.v, p))
        miss = arc - arc0 - _arc_between(curve.u, curve.v, p0, p)
        p = np.clip(p + miss / np.maximum(speed, 1e-9), p0 - step, p0 + 2 * step)
    return p


def _curve_at(curve: PlanarCurve, ds: np.ndarray) -> tuple[np.ndarray, ...]:
    """Local u, v, heading and curvature at arc lengths from the piece's start."""
    p = _parameter_at(curve, ds)
    u, du, ddu = _cubic(curve.u, p)
    v, dv, ddv = _cubic(curve.v, p)
    speed = np.maximum(np.hypot(du, dv), 1e-9)
    return u, v, np.arctan2(dv, du), (du * ddv - dv * ddu) / speed**3


def _arc_at(ds: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Local u, v of a circle of curvature k (a line for 0)."""
    half = k * ds / 2
    chord = ds * np.sinc(half / np.pi)  # np.sinc(x) = sin(pi x) / (pi x)
    return chord * np.cos(half), chord * np.sin(half)


def _spiral_at(ds: np.ndarray, k: np.ndarray, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Local u, v of a clothoid: curvature k at its start, growing by `rate` per metre.

    heading(t) = k t + rate t^2 / 2 = rate / 2 (t + k / rate)^2 - k^2 / (2 rate), so that the
    position is a difference of Fresnel integrals turned by the constant part.
    """
    size = np.sqrt(np.pi / np.abs(rate))
    from_t, sign = k / rate, np.sign(rate)
    s1, c1 = fresnel((ds + from_t) / size)
    s0, c0 = fresnel(from_t / size)
    turn = -k * k / (2 * rate)
    a, b = size * (c1 - c0), size * sign * (s1 - s0)
    return a * np.cos(turn) - b * np.sin(turn), a * np.sin(turn) + b * np.cos(turn)


def evaluate(
    line: ReferenceLine, s: np.ndarray, pick: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, heading and curvature of the reference line.

    Args:
      line: the road's planView.
      s: (P,) float64, arc length, m; beyond the last piece it goes on as that piece does.
      pick: (P,) float64, arc length that chooses the piece (see `Cubics.at`).

    Returns:
      xy (P, 2) m, heading (P,) rad not wrapped, curvature (P,) 1/m.
    """
    row = np.clip(np.searchsorted(line.start, pick, side="right") - 1, 0, None)
    ds = s - line.start[row]
    k, rate = line.curvature[row], line.curvature_rate[row]
    u, v = _arc_at(ds, k)
    spiral = np.abs(rate) * line.length[row] ** 2 > _SPIRAL_EPS
    if spiral.any():
        u[spiral], v[spiral] = _spiral_at(ds[spiral], k[spiral], rate[spiral])
    turn, bend = ds * (k + ds * rate / 2), k + ds * rate
    for piece, curve in line.curves.items():
        here = row == piece
        if here.any():
            u[here], v[here], turn[here], bend[here] = _curve_at(curve, ds[here])
    hdg = line.hdg[row]
    cos, sin = np.cos(hdg), np.sin(hdg)
    xy = np.stack([line.x[row] + cos * u - sin * v, line.y[row] + sin * u + cos * v], axis=-1)
    return xy, hdg + turn, bend
