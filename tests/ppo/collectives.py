"""What a compiled program sends between devices, read from its HLO text."""

from __future__ import annotations

import dataclasses
import math
import re

BYTES = {"pred": 1, "s8": 1, "u8": 1, "bf16": 2, "f16": 2, "s32": 4, "u32": 4, "f32": 4, "f64": 8}

_COMPUTATION = re.compile(r"^(?:ENTRY )?%?([\w.\-]+) .*\{$")
_COLLECTIVE = re.compile(
    r"= (.*?) (all-reduce|all-gather|ragged-all-to-all|all-to-all|collective-permute"
    r"|collective-broadcast|reduce-scatter|send|recv)(?:-start)?\("
)
_SHAPE = re.compile(r"(\w+)\[([\d,]*)\]")
_CALLED = re.compile(r"(body|condition|calls|to_apply|\w+_computations?)=(\{[^}]*\}|%?[\w.\-]+)")
_TRIPS = re.compile(r'"known_trip_count":\{"n":"(\d+)"\}')


@dataclasses.dataclass(frozen=True)
class Collective:
    """One instruction that sends between devices.

    Attributes:
      kind: as HLO names it, e.g. "all-reduce".
      shapes: of its results on one device, (dtype, dimensions).
      times: how often it runs, from the trip counts of the loops that it is in.
    """

    kind: str
    shapes: tuple[tuple[str, tuple[int, ...]], ...]
    times: int

    @property
    def num_bytes(self) -> int:
        """Bytes of its results, one time."""
        return sum(BYTES[dtype] * math.prod(shape) for dtype, shape in self.shapes)


def find(hlo: str) -> list[Collective]:
    """Finds all of a program's collectives.

    Args:
      hlo: text of a compiled module.

    Returns:
      They; one in a computation that is used in two places is there twice.

    Raises:
      ValueError: one is in a loop without a known trip count.
    """
    computations, entry = _split(hlo)
    return _within(entry, computations, 1)


def _split(hlo: str) -> tuple[dict[str, list[str]], str]:
    """Computations by name, as lines, and the name of the first to run."""
    computations: dict[str, list[str]] = {}
    entry = name = ""
    for line in hlo.splitlines():
        head = _COMPUTATION.match(line)
        if head:
            name = head[1]
            computations[name] = []
            entry = name if line.startswith("ENTRY") else entry
        elif name:
            computations[name].append(line)
    return computations, entry


def _within(name: str, computations: dict[str, list[str]], times: int | None) -> list[Collective]:
    found = []
    for line in computations[name]:
        sent = _COLLECTIVE.search(line)
        if sent:
            if times is None:
                raise ValueError(f"in a loop of unknown length: {line.strip()}")
            shapes = tuple(
                (dtype, tuple(int(n) for n in dims.split(",") if n))
                for dtype, dims in _SHAPE.findall(sent[1])
            )
            found.append(Collective(sent[2], shapes, times))
            continue
        trips = _TRIPS.search(line)
        for role, names in _CALLED.findall(line):
            inner = times
            if role in ("body", "condition"):
                inner = times * int(trips[1]) if trips and times is not None else None
            for called in re.findall(r"[\w.\-]+", names):
                found += _within(called, computations, inner)
    return found
