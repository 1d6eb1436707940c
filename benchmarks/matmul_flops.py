"""Floating-point operations of a program's matrix products and convolutions, from its trace.

What is neither product nor convolution is left out, so that the number can be compared with the
speed of a plain matrix product. A trace says how often each scan runs its body.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jax.extend.core import Jaxpr, JaxprEqn, jaxprs_in_params
from jax.interpreters.partial_eval import dce_jaxpr


def of_traced(traced: Any, platform: str) -> float:
    """Counts a multiplication with its addition as two.

    Args:
      traced: from `jax.jit(f).trace(...)`.
      platform: of the device it is for; decides between alternatives for different platforms.

    Returns:
      Operations on all devices together, those left out whose result nobody uses. The body of a
      loop of unknown length counts once, of a conditional's branches the largest.
    """
    jaxpr = traced.jaxpr.jaxpr
    return float(count(dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))[0], platform))


def count(jaxpr: Jaxpr, platform: str) -> float:
    """Counts those of all equations; see `of_traced`."""
    return sum(_of(equation, platform) for equation in jaxpr.eqns)


def _of(equation: JaxprEqn, platform: str) -> float:
    params = equation.params
    match equation.primitive.name:
        case "dot_general":
            return _product(equation)
        case "conv_general_dilated":
            return _convolution(equation)
        case "cond":
            inner = [count(branch.jaxpr, platform) for branch in params["branches"]]
            row = _row(params.get("branches_platforms"), platform)
            return max(inner) if row is None else inner[row]
        case "scan":
            times = params["length"]
        case "shard_map":
            times = params["mesh"].size
        case _:
            times = 1
    return times * sum(count(inner, platform) for inner in jaxprs_in_params(params))


def _row(platforms: tuple[tuple[str, ...] | None, ...] | None, platform: str) -> int | None:
    """Which branch of `lax.platform_dependent` a platform takes; None for any other conditional."""
    if platforms is None:
        return None
    names = {"gpu": {"gpu", "cuda", "rocm"}}.get(platform, {platform})
    return next(i for i, those in enumerate(platforms) if those is None or names & set(those))


def _product(equation: JaxprEqn) -> float:
    (contracted, _), _ = equation.params["dimension_numbers"]
    (left, _), out = _shapes(equation)
    return 2.0 * math.prod(left[axis] for axis in contracted) * math.prod(out)


def _convolution(equation: JaxprEqn) -> float:
    """Leaves out products with padding and with the zeros of a dilated input, as XLA does."""
    params, numbers = equation.params, equation.params["dimension_numbers"]
    (image, kernel), out = _shapes(equation)
    axes = zip(numbers.lhs_spec[2:], numbers.rhs_spec[2:], numbers.out_spec[2:], strict=True)
    taps = 1
    for i, (image_axis, kernel_axis, out_axis) in enumerate(axes):
        at = np.arange(out[out_axis])[:, None] * params["window_strides"][i]
        at = at + np.arange(kernel[kernel_axis]) * params["rhs_dilation"][i]
        at, between = np.divmod(at - params["padding"][i][0], params["lhs_dilation"][i])
        taps *= int(((between == 0) & (at >= 0) & (at < image[image_axis])).sum())
    samples = out[numbers.out_spec[0]] * out[numbers.out_spec[1]]
    return 2.0 * samples * kernel[numbers.rhs_spec[1]] * taps


def _shapes(equation: JaxprEqn) -> tuple[list[tuple[int, ...]], tuple[int, ...]]:
    """Of what goes in and of what comes out."""
    given: list[Any] = [x.aval for x in equation.invars]
    made: Any = equation.outvars[0].aval
    return [x.shape for x in given], made.shape
