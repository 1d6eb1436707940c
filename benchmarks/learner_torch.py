"""Our PPO update against PyTorch's: `python benchmarks/learner_torch.py` (extra `bench`).

The same network, batch, minibatches and losses on the same cores, in turn. Before anything is timed
outputs, gradients and the parameters after a small update are compared from copied weights; the
status is 1 where they differ. One JSON line for each network.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import os
import sys
from collections.abc import Callable
from typing import Any

import learner_cases
import measure
import numpy as np
import tyro
from learner_cases import CASES, RATE, Case, Name
from measure import UsageError

from carljax import timing

MINIBATCH = 1024


@dataclasses.dataclass(frozen=True)
class Command:
    """What to measure."""

    networks: tuple[Name, ...] = ("cpu", "roach", "carl")
    """The `cpu` preset's network, Roach's at 192 x 192 x 15 and CaRL's at 256 x 256 x 10."""
    samples: int | None = None
    """Samples of the batch; 8,192 for `cpu` and 1,024 for the others by default."""
    minibatch: int = MINIBATCH
    """Samples of a gradient step."""
    micro: int | None = None
    """Samples whose gradients are computed at once on our side; 256 or 64 by default."""
    torch_micro: int | None = None
    """The same on PyTorch's side; as ours by default."""
    repeats: int = 7
    """Timed updates of each side, at least 5, in turn."""


def main() -> int:
    """Checks, times and prints."""
    command = tyro.cli(Command, description=__doc__)
    status = 0
    try:
        check(command)
        for name in command.networks:
            line = compare(name, case_of(name, command), command)
            measure.emit(line)
            status |= not line["agrees"]
    except UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return status


def check(command: Command) -> None:
    """Looks at the numbers and for PyTorch.

    Raises:
      UsageError: something does not fit or is missing.
    """
    measure.check_repeats(command.repeats)
    if importlib.util.find_spec("torch") is None:
        raise UsageError("PyTorch is not installed: pip install -e '.[bench]'")
    for name in command.networks:
        case_of(name, command)


def case_of(name: Name, command: Command) -> Case:
    """A network with the sizes that were asked for.

    Raises:
      UsageError: they don't divide evenly.
    """
    case = CASES[name]
    samples, micro = command.samples or case.samples, command.micro or case.micro
    learner_cases.sized(case, samples, command.minibatch, command.torch_micro or micro)
    return learner_cases.sized(case, samples, command.minibatch, micro)


def compare(name: str, case: Case, command: Command) -> dict[str, Any]:
    """Compares both sides' results and then their speed; one line."""
    import torch  # here, so that a missing PyTorch is said in one line
    import torch_agreement

    threads = len(os.sched_getaffinity(0))
    torch.set_num_threads(threads)
    agreement = torch_agreement.agree(case)
    given = learner_cases.arguments(case)
    program = learner_cases.our_update(case)
    torch_micro = command.torch_micro or case.micro
    theirs = their_update(case, given, torch_micro)
    ours_s, theirs_s = [], []
    timing.call_seconds(program, lambda _: given, 1, warm_up=0)
    timing.call_seconds(theirs, lambda _: (), 1, warm_up=0)
    for _ in range(command.repeats):
        ours_s += timing.call_seconds(program, lambda _: given, 1, warm_up=0)
        theirs_s += timing.call_seconds(theirs, lambda _: (), 1, warm_up=0)
    ratios = np.array(theirs_s) / np.array(ours_s)
    return {
        "benchmark": "learner_torch",
        "network": name,
        "ours_samples_per_s": case.samples / float(np.median(ours_s)),
        "torch_samples_per_s": case.samples / float(np.median(theirs_s)),
        "ours_over_torch": measure.spread(list(ratios)),
        **agreement,
        "ours_seconds": measure.spread(ours_s),
        "torch_seconds": measure.spread(theirs_s),
        "samples": case.samples,
        "minibatch_size": command.minibatch,
        "micro_batch_size": case.micro,
        "torch_micro_batch_size": torch_micro,
        "encoder": case.network.encoder,
        "shape": list(case.image),
        "threads": threads,
        "torch": torch.__version__,
    }


def their_update(case: Case, given: tuple, micro: int) -> Callable[[], None]:
    """The update in PyTorch from the same parameters, on samples shuffled anew in each call."""
    import torch
    import torch_agreement
    import torch_ppo

    network = torch_agreement.network_of(case, given[0])
    samples = torch_ppo.samples_of(given[2])
    optimizer = torch_ppo.make_optimizer(network, RATE, case.ppo)

    def run() -> None:
        rows = torch.randperm(case.samples).reshape(case.ppo.num_minibatches, -1)
        torch_ppo.update(network, optimizer, samples, rows, case.ppo, micro)

    return run


if __name__ == "__main__":
    sys.exit(main())
