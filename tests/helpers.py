"""What several test files use."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def once(environment: Callable[..., Any]) -> Callable[..., Any]:
    """Wraps `build.environment` so that the same routes are drawn once.

    Args:
      environment: the function itself; callers must always pass one configuration.

    Returns:
      A function that remembers its results by number of routes and seed.
    """
    drawn: dict[tuple[int, int], Any] = {}

    def cached(values: Any, loaded: Any, num_routes: int, seed: int) -> Any:
        if (num_routes, seed) not in drawn:
            drawn[num_routes, seed] = environment(values, loaded, num_routes, seed)
        return drawn[num_routes, seed]

    return cached
