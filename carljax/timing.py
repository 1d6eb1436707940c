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
        given = jax.block_until_ready(arguments(result))
        since = time.perf_counter()
        result = jax.block_until_ready(function(*given))
        seconds.append(time.perf_counter() - since)
    return seconds[warm_up:]
