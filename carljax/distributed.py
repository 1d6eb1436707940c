"""Several processes, on one or several hosts, that train as one: `carljax.train --distributed`.

Every process runs the same program on devices of its own, and the compiled train step exchanges
gradients and statistics. What is left to do on the hosts is here: to join, to agree on a word or on
a stop, to fail together, and to tell the first process, which alone prints and writes. All of it
works in a process on its own too, without communication.

Functions that gather must be called by all processes in the same order.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
import signal
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Annotated, Any

import jax
import numpy as np
import tyro
from jax.experimental import multihost_utils

from carljax.config import ConfigError

MAX_WORD_BYTES = 4096  # of what is gathered from each process


@dataclasses.dataclass(frozen=True)
class Distributed:
    """Processes that train together; all are given the same command but for their number."""

    asked: Annotated[bool, tyro.conf.arg(name="distributed", prefix_name=False)] = False
    """Train together with other processes, as SLURM, Kubernetes, MPI or a TPU pod tell each of them
    (docs/distributed.md); elsewhere give the three values below."""
    coordinator_address: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT")] = None
    """Where the others find process 0."""
    num_processes: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """How many there are."""
    process_id: Annotated[int | None, tyro.conf.arg(metavar="I")] = None
    """Number of this one, from 0 to N - 1."""

    @property
    def is_explicit(self) -> bool:
        """Whether the processes are told by flags instead of by their cluster."""
        return any(value is not None for value in self._values().values())

    def validate(self) -> None:
        """Checks that the flags are complete and fit together.

        Raises:
          ConfigError: naming the flag.
        """
        if not self.is_explicit:
            return
        for name, value in self._values().items():
            if value is None:
                flags = ", ".join(self._values())
                raise ConfigError(f"{name}: is missing; {flags} go together")
        address, number, count = self.coordinator_address, self.process_id, self.num_processes
        host, _, port = str(address).rpartition(":")
        if not (host and port.isdecimal() and 0 < int(port) < 65536):
            raise ConfigError(f"--distributed.coordinator-address {address}: is not HOST:PORT")
        if not (count is not None and count >= 1):
            raise ConfigError(f"--distributed.num-processes {count}: is below the least allowed, 1")
        if not (number is not None and 0 <= number < count):
            raise ConfigError(f"--distributed.process-id {number}: is not from 0 to {count - 1}")

    def _values(self) -> dict[str, Any]:
        return {
            "--distributed.coordinator-address": self.coordinator_address,
            "--distributed.num-processes": self.num_processes,
            "--distributed.process-id": self.process_id,
        }


@dataclasses.dataclass(frozen=True)
class _Ahead:
    """The part of a command line that is read before all others."""

    distributed: Distributed = Distributed()


def read(argv: Sequence[str]) -> Distributed:
    """Reads the flags of this file from a command line, ahead of the rest.

    The rest can't be read yet: the default preset depends on the devices, and JAX may not look for
    these before the processes are joined.

    Args:
      argv: all arguments.

    Returns:
      The flags, checked.

    Raises:
      ConfigError: they are incomplete or don't fit together.
    """
    if {"-h", "--help"} & set(argv):
        return Distributed()  # to be shown, with all other flags; nothing will run
    pairs_off = (tyro.conf.FlagCreatePairsOff,)
    ahead, _ = tyro.cli(
        _Ahead, args=argv, return_unknown_args=True, add_help=False, config=pairs_off
    )
    ahead.distributed.validate()
    return ahead.distributed


@contextmanager
def joined(flags: Distributed, expected: tuple[type[Exception], ...]) -> Iterator[None]:
    """Makes this process one of several, if the flags say so, until the block ends.

    An orderly end waits for the other processes. After an unforeseen error these wait for this one,
    inside of the train step; so then it ends at once, with status 1, and JAX ends the others.

    Args:
      flags: see `read`.
      expected: errors that all processes come upon, see `agreed`.

    Raises:
      ConfigError: no cluster tells who the others are, or they can't be reached.
    """
    if not (flags.asked or flags.is_explicit):
        yield
        return
    _join(flags)
    try:
        yield
    except BaseException as error:
        if isinstance(error, (*expected, SystemExit)):
            raise
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(1)


def _join(flags: Distributed) -> None:
    try:
        jax.distributed.initialize(
            coordinator_address=flags.coordinator_address,
            num_processes=flags.num_processes,
            process_id=flags.process_id,
            cluster_detection_method="deactivate" if flags.is_explicit else None,
        )
    except (ValueError, RuntimeError, KeyError) as error:
        reason = str(error).strip().split("\n", 1)[0]
        if not flags.is_explicit:
            names = ", ".join(flags._values())
            reason = f"no cluster tells who takes part ({reason}); give {names}"
        raise ConfigError(f"--distributed: {reason}") from error
    # JAX listens to SIGTERM from here on. `learn.interrupts` does so itself.
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))


def num_processes() -> int:
    """How many processes train together; 1 in one on its own."""
    return jax.process_count() if jax.distributed.is_initialized() else 1


def is_first() -> bool:
    """Whether this process is the one that prints and writes."""
    return num_processes() == 1 or jax.process_index() == 0


def gather(word: str) -> list[str]:
    """Collects a word of every process, in the order of their numbers.

    Args:
      word: of this process; cut off after `MAX_WORD_BYTES`.

    Returns:
      The words of all.
    """
    if num_processes() == 1:
        return [word]
    data = np.zeros(MAX_WORD_BYTES, np.uint8)
    raw = np.frombuffer(word.encode()[:MAX_WORD_BYTES], np.uint8)
    data[: raw.size] = raw
    rows = multihost_utils.process_allgather(data)
    return [bytes(row).rstrip(b"\0").decode(errors="ignore") for row in rows]


def any_process(flag: bool) -> bool:
    """Whether the flag is set in at least one process; waits for all of them."""
    if num_processes() == 1:
        return flag
    return bool(np.any(multihost_utils.process_allgather(np.array(flag))))


def is_shared(folder: Path | None) -> bool:
    """Whether all processes have the same folder there, and the first one can write into it.

    Args:
      folder: of this process; None if it has none.

    Returns:
      The same answer in all; True in a process on its own.
    """
    if num_processes() == 1:
        return True
    with ExitStack() as stack:
        mark = ""
        if is_first() and folder is not None:
            with suppress(OSError):
                folder.mkdir(parents=True, exist_ok=True)
                file = stack.enter_context(NamedTemporaryFile(prefix=".shared-", dir=folder))
                mark = Path(file.name).name
        mark = gather(mark)[0]
        is_here = folder is not None and mark != "" and (folder / mark).exists()
        return not any_process(not is_here)


@contextmanager
def agreed() -> Iterator[None]:
    """Lets all processes past a block, or none: an error in one of them becomes one in all.

    Nothing in the block may wait for the others.

    Raises:
      ConfigError: here there was no error, but in another process, which the message names.
    """
    failure: Exception | None = None
    try:
        yield
    except Exception as error:
        failure = error
    words = gather("" if failure is None else f"{failure}" or type(failure).__name__)
    if failure is not None:
        raise failure
    for number, word in enumerate(words):
        if word:
            raise ConfigError(f"process {number}: {word}")


def check_same(what: str, *trees: Any) -> None:
    """Checks that all processes have the same arrays and words.

    Args:
      what: they are, for the message.
      trees: pytrees of strings and of arrays that are whole in this process.

    Raises:
      ConfigError: in all processes, if one has others.
    """
    if num_processes() == 1:
        return
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(trees):
        value = np.asarray(leaf)
        digest.update(f"{value.shape}{value.dtype}".encode())
        digest.update(value.tobytes())
    digests = gather(digest.hexdigest())
    others = [number for number, other in enumerate(digests) if other != digests[0]]
    if others:
        raise ConfigError(
            f"process {others[0]} has other {what} than process 0: all processes need the same"
            " files, arguments and versions"
        )
