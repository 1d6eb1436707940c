"""Operations and bytes of a compiled program by XLA's own cost analysis, its loops taken in full.

XLA takes the body of a loop once, however often it runs. Where it knows how often that is, the
program's text says so (`known_trip_count`), and each loop adds what its body costs as often as it
runs besides that once. What a body costs is XLA's count again, of the same program with the body as
its entry. jaxlib has no public name for that: where the names below are gone, loops stay counted
once and the result says so.
"""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import jax

_COMPUTATION = re.compile(r"^(?:ENTRY )?%?([\w.\-]+) \(.*\{$")
_TRIPS = re.compile(r'"known_trip_count":\{"n":"(\d+)"\}')
_BODY = re.compile(r"\bbody=%?([\w.\-]+)")
_CALLED = re.compile(r"\b(?:calls|to_apply|body|condition|\w+_computation)=%?([\w.\-]+)")
_SEVERAL = re.compile(r"\b(?:branch|called)_computations=\{([^}]*)\}")


@dataclasses.dataclass(frozen=True)
class Loop:
    """A loop in a program's text.

    Attributes:
      body: name of its body.
      trips: how often the body runs each time, None where that is unknown.
      runs: how often the loop itself is run, with loops around it of unknown length taken once.
    """

    body: str
    trips: int | None
    runs: int


def of(compiled: Any) -> dict[str, Any] | None:
    """What a call of a compiled program costs.

    Args:
      compiled: from `jax.jit(f).lower(...).compile()`.

    Returns:
      `flops`, operations of every kind, on whole numbers too; `bytes`, read and written by fused
      operations; `loops`, "all runs" where both count bodies as often as they run, else "once"; and
      the number of `loops_of_unknown_length`, whose bodies are in it once. None where XLA says
      nothing.
    """
    try:
        whole = compiled.cost_analysis()
        computations = split(compiled.as_text())
    except NotImplementedError:
        return None
    found = loops(computations)
    try:
        more = [
            (loop.runs * (loop.trips - 1), _cost_of(computations, loop.body))
            for loop in found
            if loop.trips is not None
        ]
    except (ImportError, AttributeError, jax.errors.JaxRuntimeError):
        more = []
    unknown = sum(loop.trips is None for loop in found)

    def total(name: str) -> float:
        return whole.get(name, 0.0) + sum(times * cost.get(name, 0.0) for times, cost in more)

    return {
        "flops": total("flops"),
        "bytes": total("bytes accessed"),
        "loops": "all runs" if len(more) + unknown == len(found) else "once",
        "loops_of_unknown_length": unknown,
    }


def split(text: str) -> dict[str, list[str]]:
    """Takes the text of optimised HLO apart: {name of a computation: its lines}."""
    computations: dict[str, list[str]] = {}
    lines: list[str] = []
    for line in text.splitlines():
        if header := _COMPUTATION.match(line):
            lines = computations[header[1]] = []
        lines.append(line)
    return computations


def loops(computations: dict[str, list[str]]) -> list[Loop]:
    """Finds the loops of a compiled program.

    Args:
      computations: from `split`.
    """
    found: list[tuple[str, str, int | None]] = []
    callers: dict[str, tuple[str, int]] = {}
    for here, lines in computations.items():
        for line in lines[1:]:
            body, trips = _BODY.search(line), _TRIPS.search(line)
            for name in _called(line):
                is_body = body is not None and trips is not None and name == body[1]
                callers[name] = here, int(trips[1]) if is_body and trips else 1
            if body:
                found.append((here, body[1], int(trips[1]) if trips else None))

    def runs(name: str) -> int:
        if name not in callers:
            return 1
        caller, times = callers[name]
        return times * runs(caller)

    return [Loop(body, trips, runs(here)) for here, body, trips in found]


def _called(line: str) -> list[str]:
    """Computations that an instruction runs."""
    several = [
        name.strip().lstrip("%") for names in _SEVERAL.findall(line) for name in names.split(",")
    ]
    return [*_CALLED.findall(line), *several]


def _cost_of(computations: dict[str, list[str]], body: str) -> dict[str, float]:
    """XLA's cost of one run of a computation, the loops in it taken once."""
    from jaxlib import _hlo, _jax  # type: ignore[attr-defined]  # neither has type stubs

    needed, waiting = {body}, [body]
    while waiting:
        called = {name for line in computations[waiting.pop()][1:] for name in _called(line)}
        waiting += called - needed
        needed |= called
    parts = ["HloModule body"]
    for name, lines in computations.items():  # callees stand before their callers
        if name in needed:
            header = lines[0].removeprefix("ENTRY ")
            parts.append("\n".join([f"ENTRY {header}" if name == body else header, *lines[1:]]))
    module = _hlo.hlo_module_from_text(_without_sources("\n\n".join(parts)))
    cost: dict[str, float] = _jax.hlo_module_cost_analysis(jax.devices()[0].client, module)
    return cost


def _without_sources(text: str) -> str:
    """Drops where an instruction came from; the tables that this points to are not in the text."""
    return re.sub(r", metadata=\{(?:[^{}\"]|\"(?:[^\"\\]|\\.)*\")*\}", "", text)
