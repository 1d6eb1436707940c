"""How long calls of a compiled function take, apart from compilation and first calls."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import jax


def call_seconds(
    function: Callable[..., Any],
    arguments: Callable[[Any], tuple],
    repeats: int,
    warm_up: int = 1,
) -> list[float]:
    """Times calls one by one, each waited for; making its arguments is not counted.

    Args:
      function: returns arrays; jitted or compiled.
      arguments: makes a call's arguments from the last call's result, None before the first.
      repeats: timed calls.
      warm_up: calls before those, which compile or fill caches.

    Returns:
      Seconds of each timed call, in order.
    """
    result, seconds = None, []
    for _ in range(warm_up + repeats):
        taken, result = timed(function, *arguments(result))
        seconds.append(taken)
    return seconds[warm_up:]


def timed(function: Callable[..., Any], *given: Any) -> tuple[float, Any]:
    """Calls a function once, when its arguments are there, and waits for what it returns.

    Args:
      function: returns arrays; jitted or compiled.
      *given: its arguments.

    Returns:
      Seconds, and what the function returned.
    """
    jax.block_until_ready(given)
    since = time.perf_counter()
    result = jax.block_until_ready(function(*given))
    return time.perf_counter() - since, result
