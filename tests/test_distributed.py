"""Several processes train as one: joined, equal to one process, stopped, killed and continued."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import one_of_several
import pytest

from carljax import build, checkpoint, config, distributed, metrics_log, run_dir, train
from carljax.checkpoint import CheckpointError
from carljax.config import ConfigError
from carljax.ppo import trainer

TESTS = Path(__file__).resolve().parent
NUM_UPDATES = 3
TINY = [
    *("--run.eval-routes", "0", "--run.keep-checkpoints", "9", "--run.num-devices", "2"),
    *("--network.hidden-size", "8", "--network.joint-size", "8", "--network.patch-size", "4"),
    *("--network.patch-features", "4", "8", "--ppo.num-envs", "4", "--ppo.num-steps", "8"),
    *("--ppo.num-minibatches", "2", "--ppo.micro-batch-size", "None"),
    *("--ppo.total-samples", str(NUM_UPDATES * 32), "--run.checkpoint-every", "1"),
]
# Machine code need not be good; the sums that are compared are the same.
HASTY = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
# TensorBoard's writer loads PyTorch, slowly, where it is installed; not so here.
MAIN = """
import sys
sys.modules["torch"] = None
import tensorboardX
del sys.modules["torch"]
import one_of_several
sys.exit(one_of_several.main())
"""
PATHS = os.pathsep.join([str(TESTS), str(TESTS.parent)])


class Processes:
    """Processes of the command side by side, each with as many CPU devices."""

    def __init__(self, folder, num, num_devices, arguments, events=None):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self.all = []
        for number in range(num):
            when, what = (events or {}).get(number, (0, "-"))
            joined = [
                *("--distributed.coordinator-address", f"127.0.0.1:{port}"),
                *("--distributed.num-processes", str(num)),
                *("--distributed.process-id", str(number)),
            ]
            command = [sys.executable, "-c", MAIN, str(when), what]
            flags = f"{HASTY} --xla_force_host_platform_device_count={num_devices}"
            self.all.append(
                subprocess.Popen(
                    [*command, *arguments, *(joined if num > 1 else [])],
                    cwd=folder,
                    env={**os.environ, "XLA_FLAGS": flags, "PYTHONPATH": PATHS},
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    text=True,
                )
            )

    def wait(self):
        """Waits for all; exit statuses, outputs and errors in the order of their numbers."""
        try:
            texts = [process.communicate(timeout=600) for process in self.all]
        finally:
            for process in self.all:
                process.kill()
        statuses = [process.returncode for process in self.all]
        return statuses, [_own(output) for output, _ in texts], [error for _, error in texts]


def _own(output):
    """What the command has printed, without what Gloo does."""
    lines = output.splitlines(keepends=True)
    return "".join(line for line in lines if not line.startswith("[Gloo]"))


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """One process with two devices; and two with one each, killed, stopped and continued."""
    folder = tmp_path_factory.mktemp("runs")
    alone = Processes(folder, 1, 2, ["cpu", *TINY, "--run.dir", "alone"]).wait()
    kill = {0: (2, "SIGKILL"), 1: (2, "SIGKILL")}
    killed = Processes(folder, 2, 1, ["cpu", *TINY, "--run.dir", "several"], kill).wait()
    assert checkpoint.updates(folder / "several") == [1], killed
    again = ["--resume", "several"]
    stopped = Processes(folder, 2, 1, again, {1: (1, "SIGTERM")}).wait()
    assert checkpoint.updates(folder / "several") == [1, 2], stopped
    ended = Processes(folder, 2, 1, [*again, "--run.eval-routes", "1"]).wait()
    return folder, dict(alone=alone, killed=killed, stopped=stopped, ended=ended)


@pytest.mark.slow
def test_two_processes_do_what_one_does_bit_for_bit(runs):
    """A sum of two numbers has no order, so two devices add up alike in one process or two.

    Both checkpoints go onto one device here.
    """
    left, right = _restored(runs[0], "alone", "several")
    for (path, one), (_, two) in zip(left, right, strict=True):
        np.testing.assert_array_equal(one, two, err_msg=jax.tree_util.keystr(path))
    left, right = (metrics_log.read(runs[0] / name) for name in ("alone", "several"))
    assert [line["update"] for line in right] == [1, 2, 3]
    for one, two in zip(left, right, strict=True):
        for name in one:
            assert name.startswith("time/") or one[name] == two[name], name


@pytest.mark.slow
def test_a_signal_to_one_process_stops_all_after_the_same_update(runs):
    statuses, (first, second), errors = runs[1]["stopped"]
    assert statuses == [0, 0], errors
    assert "stopped; continue with: python -m carljax.train --resume several" in first
    assert second == ""


@pytest.mark.slow
def test_only_the_first_process_prints_and_writes(runs):
    statuses, (first, second), errors = runs[1]["ended"]
    assert statuses == [0, 0], errors
    assert "devices     2 x cpu, of 2 processes" in first
    assert "Driving Score" in first
    assert second == ""
    folder = runs[0] / "several"
    assert {entry.name for entry in folder.iterdir()} == {
        *("config.json", "machine.json", "metrics.jsonl", "tensorboard", "checkpoints"),
        "evaluation.json",
    }
    assert len(list((folder / "tensorboard").iterdir())) == 3  # one for each start
    assert [start["processes"] for start in run_dir.read_starts(folder)] == [2, 2, 2]


def _restored(folder, *names):
    """The newest training states of runs, on one device of this process, as NumPy."""
    values = run_dir.load_config(folder / names[0])
    like = build.initial_state(one_of_several.setup(train._with_run(values, num_devices=1)))

    def data(x):
        is_key = jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)
        return np.asarray(jax.random.key_data(x) if is_key else x)

    for name in names:
        state = checkpoint.restore(folder / name, like)
        assert int(state.update) == NUM_UPDATES
        assert len(state.env_state.done.sharding.device_set) == 1
        yield jax.tree_util.tree_leaves_with_path(jax.tree.map(data, state))


ALL = {"coordinator-address": "here:1234", "num-processes": "2", "process-id": "1"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"process-id": None}, "--distributed.process-id: is missing"),
        ({"num-processes": None}, "--distributed.num-processes: is missing"),
        ({"coordinator-address": None}, "--distributed.coordinator-address: is missing"),
        ({"coordinator-address": "here"}, "--distributed.coordinator-address here: is not HOST"),
        ({"coordinator-address": "a:b"}, "--distributed.coordinator-address a:b: is not HOST"),
        ({"num-processes": "0"}, "--distributed.num-processes 0: is below the least"),
        ({"process-id": "2"}, "--distributed.process-id 2: is not from 0 to 1"),
        ({"process-id": "-1"}, "--distributed.process-id -1: is not from 0 to 1"),
    ],
)
def test_flags_that_do_not_fit_are_said_in_one_line_first_of_all(
    changes, message, capsys, monkeypatch
):
    def never(*_, **__):
        raise AssertionError("was called")

    monkeypatch.setattr(jax.distributed, "initialize", never)
    monkeypatch.setattr(train, "parse", never)
    flags = {name: value for name, value in {**ALL, **changes}.items() if value is not None}
    given = [word for name, value in flags.items() for word in (f"--distributed.{name}", value)]
    assert train.main(["cpu", *given]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {message}") and error.count("\n") == 1


def test_flags_are_read_ahead_of_the_rest():
    given = [word for name, value in ALL.items() for word in (f"--distributed.{name}", value)]
    read = distributed.read(["atari", "--ppo.num-envs", "16", *given, "--dry-run", "--no-such"])
    assert read == distributed.Distributed(False, "here:1234", 2, 1)
    assert read.is_explicit
    assert distributed.read(["--distributed", "--run.seed", "3"]).asked
    assert distributed.read(["--distributed", "--help"]) == distributed.Distributed()


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (
            ["--distributed"],
            "no cluster tells who takes part (no address); give --distributed.coordinator",
        ),
        ([f"--distributed.{k}={v}" for k, v in ALL.items()], "no address"),
    ],
)
def test_processes_that_can_not_be_joined_are_said_in_one_line(given, reason, capsys, monkeypatch):
    def fails(**_):
        raise ValueError("no address\nmore")

    monkeypatch.setattr(jax.distributed, "initialize", fails)
    assert train.main(given) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: --distributed: {reason}") and error.count("\n") == 1


@pytest.mark.parametrize("error", [CheckpointError("told to all"), SystemExit(2)])
def test_an_error_that_all_have_ends_in_order(error, monkeypatch):
    monkeypatch.setattr(distributed, "_join", lambda flags: None)
    flags = distributed.Distributed(asked=True)
    with pytest.raises(type(error)), distributed.joined(flags, train.USER_ERRORS):
        raise error


@pytest.mark.parametrize("error", [KeyError("unforeseen"), KeyboardInterrupt()])
def test_an_error_that_one_has_ends_it_at_once(error, monkeypatch, capsys):
    class Ended(BaseException):
        pass

    def ends(status):
        raise Ended(status)

    monkeypatch.setattr(distributed, "_join", lambda flags: None)
    monkeypatch.setattr(os, "_exit", ends)
    flags = distributed.Distributed(asked=True)
    with pytest.raises(Ended, match="1"), distributed.joined(flags, train.USER_ERRORS):
        raise error
    assert type(error).__name__ in capsys.readouterr().err


def test_an_error_of_another_process_is_everybodys(monkeypatch):
    monkeypatch.setattr(distributed, "gather", lambda word: [word, "town.xodr: is not there"])
    with pytest.raises(ConfigError, match=r"^process 1: town.xodr: is not there$"):
        with distributed.agreed():
            pass


def test_an_error_of_ones_own_is_told_and_stays_what_it_was(monkeypatch):
    told = []
    monkeypatch.setattr(distributed, "gather", lambda word: told.append(word) or [word])
    with pytest.raises(config.ConfigError, match="^mine$"), distributed.agreed():
        raise ConfigError("mine")
    with pytest.raises(ZeroDivisionError), distributed.agreed():
        raise ZeroDivisionError
    assert told == ["mine", "ZeroDivisionError"]


def test_other_arrays_in_another_process_are_noticed(monkeypatch):
    def with_another(change):
        monkeypatch.setattr(distributed, "num_processes", lambda: 2)
        monkeypatch.setattr(distributed, "gather", lambda word: [word, word + change])

    with_another("")
    distributed.check_same("routes", "arguments", {"x": np.arange(3)})
    with_another("x")
    with pytest.raises(ConfigError, match="process 1 has other routes than process 0"):
        distributed.check_same("routes", "arguments", {"x": np.arange(3)})


def test_what_is_compared_tells_arrays_apart(monkeypatch):
    digests = []
    monkeypatch.setattr(distributed, "num_processes", lambda: 2)
    monkeypatch.setattr(distributed, "gather", lambda word: digests.append(word) or [word, word])
    values = [np.arange(4), np.arange(4).reshape(2, 2), np.arange(4, dtype=np.int32), "words"]
    for value in values:
        distributed.check_same("", value)
    assert len(set(digests)) == len(values)


@pytest.mark.parametrize(
    ("first", "here", "is_shared"),
    [
        ("a", "a", True),
        ("a", "b", False),
        ("a", None, False),
        (None, "a", False),
        ("file", "a", False),  # can't be written into
    ],
)
def test_a_folder_is_shared_if_what_the_first_writes_is_there(
    first, here, is_shared, tmp_path, monkeypatch
):
    """Two processes in turn, which tell each other what they have gathered."""
    (tmp_path / "file").touch()
    (tmp_path / "b").mkdir()
    first, here = (None if name is None else tmp_path / name for name in (first, here))
    answers = []

    def gather(word):
        monkeypatch.setattr(distributed, "gather", lambda _: [word, ""])
        monkeypatch.setattr(distributed, "is_first", lambda: False)
        answers.append(distributed.is_shared(here))
        return [word, ""]

    monkeypatch.setattr(distributed, "num_processes", lambda: 2)
    monkeypatch.setattr(distributed, "any_process", lambda flag: flag)
    monkeypatch.setattr(distributed, "gather", gather)
    monkeypatch.setattr(distributed, "is_first", lambda: True)
    answers.append(distributed.is_shared(first))
    assert all(answers) == is_shared
    assert not list(tmp_path.glob("a/*"))


def test_alone_nothing_is_gathered():
    assert distributed.is_first()
    assert distributed.num_processes() == 1
    assert distributed.gather("word") == ["word"]
    assert distributed.any_process(True) and not distributed.any_process(False)


@pytest.mark.parametrize(
    ("of_processes", "wanted", "chosen"),
    [
        ([0, 0, 1, 1], None, [0, 1, 2, 3]),
        ([0, 1, 0, 1], None, [0, 2, 1, 3]),  # a process's devices side by side
        ([0, 0, 1, 1], 2, [0, 2]),
        ([0, 0, 0], 2, [0, 1]),
    ],
)
def test_each_process_gives_as_many_devices(of_processes, wanted, chosen, monkeypatch):
    devices = [SimpleNamespace(process_index=process) for process in of_processes]
    monkeypatch.setattr(trainer.jax, "devices", lambda: devices)
    monkeypatch.setattr(trainer, "Mesh", lambda devices, axes: list(devices))
    assert trainer.make_mesh(wanted) == [devices[i] for i in chosen]


@pytest.mark.parametrize(("of_processes", "wanted"), [([0, 0, 1, 1], 3), ([0, 0, 0, 1], None)])
def test_unequal_shares_are_refused(of_processes, wanted, monkeypatch):
    devices = [SimpleNamespace(process_index=process) for process in of_processes]
    monkeypatch.setattr(trainer.jax, "devices", lambda: devices)
    with pytest.raises(ValueError, match="devices can't be shared equally by 2 processes"):
        trainer.make_mesh(wanted)
