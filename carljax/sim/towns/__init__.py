"""The bundled towns, as OpenDRIVE files made by tools/make_towns.py."""

from __future__ import annotations

import pathlib
from importlib import resources

# Which of the bundled towns a policy may learn in, and which are kept for scoring.
TRAINING = ("grid", "highway", "village")
HELD_OUT: tuple[str, ...] = ("suburb",)


def names() -> tuple[str, ...]:
    """The names of the bundled towns, in alphabetical order."""
    files = resources.files(__name__).iterdir()
    return tuple(sorted(file.name[:-5] for file in files if file.name.endswith(".xodr")))


def path(name: str) -> pathlib.Path:
    """Where the file of a bundled town lies.

    Args:
      name: one of `names()`.

    Returns:
      The path of its .xodr file.

    Raises:
      ValueError: if there is no such town; the message names those that exist.
    """
    if name not in names():
        raise ValueError(f"no bundled town is called {name!r}; there are: {', '.join(names())}")
    return pathlib.Path(str(resources.files(__name__) / f"{name}.xodr"))
