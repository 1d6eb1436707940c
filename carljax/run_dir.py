"""A run's directory: config.json, machine.json, metrics.jsonl, tensorboard/ and checkpoints/."""

from __future__ import annotations

import datetime
import hashlib
import json
from pathlib import Path
from typing import Any

from carljax import atomic, checkpoint, config, machine
from carljax.config import ConfigError, TrainConfig

CONFIG_FILE = "config.json"
MACHINE_FILE = "machine.json"


def default_path() -> Path:
    """Names a new directory after the time."""
    return Path("runs") / datetime.datetime.now().strftime("%Y%m%d-%H%M%S")


def check_free(path: Path) -> None:
    """Refuses a directory in which a new run can't be made.

    Args:
      path: a directory that need not exist.

    Raises:
      ConfigError: it holds a run already, or is no directory.
    """
    if path.exists() and not path.is_dir():
        raise ConfigError(f"{path}: is no directory")
    if (path / CONFIG_FILE).exists():
        raise ConfigError(
            f"{path}: holds a run already; continue it with --resume {path}"
            " or choose another --run.dir"
        )


def create(path: Path, train_config: TrainConfig) -> None:
    """Makes a directory for a new run and writes what it is run with.

    Args:
      path: see `check_free`.
      train_config: saved in it.
    """
    config.save(train_config, path / CONFIG_FILE)
    _note_start(path, train_config)


def reopen(path: Path, train_config: TrainConfig) -> None:
    """Notes in a run's directory that it goes on, after checking that its maps are the same.

    Args:
      path: a directory with a run.
      train_config: saved over the old one.

    Raises:
      ConfigError: a map file has changed since the run began.
    """
    known = read_starts(path)[0]["maps"]
    for file, digest in map_digests(train_config).items():
        if known.get(file, digest) != digest:
            raise ConfigError(f"{file}: has changed since the run in {path} began")
    config.save(train_config, path / CONFIG_FILE)
    _note_start(path, train_config)


def load_config(path: Path) -> TrainConfig:
    """Reads a run's configuration.

    Raises:
      ConfigError: the directory holds no run.
    """
    if not (path / CONFIG_FILE).exists():
        raise ConfigError(f"{path}: holds no run (there is no {CONFIG_FILE})")
    return config.load(path / CONFIG_FILE)


def read_starts(path: Path) -> list[dict[str, Any]]:
    """Reads on what machines the run was started and continued, in order."""
    return json.loads((path / MACHINE_FILE).read_text(encoding="utf-8"))


def split_checkpoint(path: Path) -> tuple[Path, int | None]:
    """Takes a run's directory or one of its checkpoints apart.

    Args:
      path: RUN or RUN/checkpoints/UPDATE.

    Returns:
      The run's directory, and the update if the path names one.
    """
    if path.parent.name == checkpoint.FOLDER and path.name.isdigit():
        return path.parent.parent, int(path.name)
    return path, None


def map_digests(train_config: TrainConfig) -> dict[str, str]:
    """Hashes the user's maps and banks of routes: {path: SHA-256}."""
    files = (*train_config.run.maps, *train_config.run.routes)
    return {str(file): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def _note_start(path: Path, train_config: TrainConfig) -> None:
    starts = read_starts(path) if (path / MACHINE_FILE).exists() else []
    start = {
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "maps": map_digests(train_config),
        **machine.describe(),
    }
    atomic.write_text(path / MACHINE_FILE, json.dumps([*starts, start], indent=2) + "\n")
