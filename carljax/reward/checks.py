"""Checks of the rewards' numbers, on the host."""

from __future__ import annotations

import dataclasses
from typing import Any


def refuse_negative(config: Any, place: str) -> None:
    """Refuses numbers below 0; leaves that are arrays are not looked into.

    Args:
      config: a dataclass of numbers.
      place: dotted name of it, for the message.

    Raises:
      ValueError: naming the field.
    """
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if isinstance(value, int | float) and not value >= 0:
            raise ValueError(f"{place}.{field.name}: {value} is below the smallest allowed, 0")


def refuse_zero(config: Any, place: str, *names: str) -> None:
    """Refuses numbers that are divided by where they are 0.

    Args:
      config: a dataclass of numbers.
      place: dotted name of it, for the message.
      names: of those fields.

    Raises:
      ValueError: naming the field.
    """
    for name in names:
        value = getattr(config, name)
        if isinstance(value, int | float) and value == 0:
            raise ValueError(f"{place}.{name}: 0 is not above 0")


def refuse_above_one(config: Any, place: str, *names: str) -> None:
    """Refuses shares above 1.

    Args:
      config: a dataclass of numbers.
      place: dotted name of it, for the message.
      names: of those fields.

    Raises:
      ValueError: naming the field.
    """
    for name in names:
        value = getattr(config, name)
        if isinstance(value, int | float) and value > 1:
            raise ValueError(f"{place}.{name}: {value} is above the largest allowed, 1")
