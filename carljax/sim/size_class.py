"""The few lengths that arrays of a world may have, so that another world is no other program.

XLA compiles for the shapes of its arguments. How many lanes, pixels or routes there are depends on
the towns and the seed; a length of that kind is rounded up to one of few. Two worlds whose lengths
round to the same are of one class and run the same compiled program.
"""

from __future__ import annotations

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class SizeClass:
    """Lengths of one axis.

    Attributes:
      least: the shortest.
      steps: how many there are from a power of two to the next, evenly spaced. With one, at most
        half of an axis is padding; with four, at most a fifth.
    """

    least: int
    steps: int = 1

    def round_up(self, length: int) -> int:
        """The shortest length of the class that is not below `length`."""
        length = max(length, self.least)
        power = 1 << max((length - 1).bit_length() - 1, 0)  # the largest below it
        step = max(power // self.steps, 1)
        return -(-length // step) * step


def repeat_last(values: np.ndarray, num: int) -> np.ndarray:
    """Pads an array to `num` rows with its last one."""
    last = np.broadcast_to(values[-1:], (num - len(values), *values.shape[1:]))
    return np.concatenate([values, last])
