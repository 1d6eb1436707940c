"""The configuration of a run: frozen dataclasses, saved as JSON and read back as they were.

`TrainConfig` only gathers the parts; each part stands beside the code that it configures. The
command line is made from these classes (`carljax.train`), the paper's columns are values of them
(`carljax.presets`).
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import types
import typing
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from carljax import atomic
from carljax.compile_cache import CacheFolder
from carljax.ppo.config import NetworkConfig, PPOConfig
from carljax.reward.config import RewardConfig
from carljax.sim.env import EnvConfig

# Seed of the routes for scoring; no training run may use it.
HELD_OUT_SEED = 1_000_000_007


# What is done with the policy's distribution when its driving is scored.
Action = Literal["mean", "mode", "sample"]


class ConfigError(ValueError):
    """A configuration that can't be used: one line that names file, field and reason."""


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """What surrounds the learning: where it writes, how often it saves, what it is scored on."""

    dir: Path | None = None
    """Run directory; by default a new one, runs/DATE-TIME."""
    seed: int = 0
    """Seed of parameters, training routes, traffic and exploration."""
    routes_seed: int | None = None
    """Seed of the training routes, where runs of several seeds share them. None: run.seed."""
    maps: Annotated[
        tuple[Path, ...],
        tyro.conf.UseAppendAction,
        tyro.conf.arg(name="map", prefix_name=False, metavar="FILE.xodr"),
    ] = ()
    """OpenDRIVE file to train and be scored in; repeatable. None: the bundled ones for training."""
    num_routes: int = 512
    """Training routes drawn ahead from the seed, over all towns; with banks, theirs count."""
    routes: Annotated[
        tuple[Path, ...],
        tyro.conf.UseAppendAction,
        tyro.conf.arg(metavar="BANK.npz"),
    ] = ()
    """Bank of routes to train on, from `python -m carljax.routes make`; repeatable, one at least
    for each town. None: routes are drawn."""
    num_devices: int | None = None
    """Accelerators or CPU devices to share the environments among, of all processes together and
    equally many of each; all by default. A CPU is made to look like so many, one a core at most."""
    obs_storage: Literal["auto", "store", "pack", "rerender"] = "auto"
    """How a batch's images are kept until the update has used them: as they are, in few bits, or
    drawn again from the simulator's states. The result is the same. auto: the first of these
    whose images take no more than half of a device's memory."""
    log_every: int = 1
    """Updates between two lines of metrics.jsonl."""
    checkpoint_every: int = 50
    """Updates between two checkpoints; there is always one at the end."""
    keep_checkpoints: int = 3
    """Newest checkpoints to keep; the best one is kept besides."""
    best_window: int = 100
    """Updates over which the return is averaged to call a checkpoint the best."""
    # source: 100 iterations in the authors' trainers
    eval_routes: int = 64
    """Held-out routes driven at the end; 0 leaves the evaluation out."""
    eval_action: Action = "mean"
    """Action in that evaluation, and by default in `carljax.evaluate`: mean of the policy (CaRL),
    its mode (Roach), or a sample as in training."""
    compile_cache: CacheFolder = None
    """Folder for compiled programs, or `off` for none; the user's cache folder by default. The
    variable JAX_COMPILATION_CACHE_DIR comes before it."""

    def validate(self) -> None:
        """Checks that counts are counts.

        Raises:
          ConfigError: naming the field.
        """
        least = {"seed": 0, "num_routes": 1, "log_every": 1, "checkpoint_every": 1}
        least |= {"keep_checkpoints": 1, "best_window": 1, "eval_routes": 0}
        if self.num_devices is not None:
            least["num_devices"] = 1
        if self.routes_seed is not None:
            least["routes_seed"] = 0
        for name, minimum in least.items():
            if getattr(self, name) < minimum:
                raise ConfigError(
                    f"run.{name}: {getattr(self, name)} is below the least allowed, {minimum}"
                )
        for name in ("seed", "routes_seed"):
            if getattr(self, name) == HELD_OUT_SEED:
                raise ConfigError(f"run.{name}: {HELD_OUT_SEED} is the seed of the held-out routes")


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """Everything that a training run depends on."""

    env: EnvConfig = dataclasses.field(default_factory=EnvConfig)
    """Simulator and observation."""
    reward: RewardConfig = dataclasses.field(default_factory=RewardConfig)
    """The terms of the reward."""
    network: NetworkConfig = dataclasses.field(default_factory=NetworkConfig)
    """Encoder and heads of policy and critic."""
    ppo: PPOConfig = dataclasses.field(default_factory=PPOConfig)
    """Rollout and update."""
    run: RunConfig = dataclasses.field(default_factory=RunConfig)
    """Directory, seed, maps, checkpoints, evaluation."""

    def validate(self, num_devices: int) -> None:
        """Checks what can be checked before anything is built.

        Args:
          num_devices: devices that share the environments.

        Raises:
          ConfigError: in one line, the field and what is wrong with it.
        """
        self.run.validate()
        spacing = self.env.scenario_spacing
        if spacing is not None and not spacing >= 0.0:
            raise ConfigError(
                f"env.scenario_spacing: {spacing} is below the least allowed, 0 (no scenarios)"
            )
        try:
            self.env.validate()
            self.ppo.validate(num_devices)
        except ValueError as error:
            raise ConfigError(str(error)) from error


def save(config: TrainConfig, path: Path) -> None:
    """Writes a configuration as JSON, whole or not at all."""
    atomic.write_text(path, json.dumps(to_json(config), indent=2) + "\n")


def load(path: Path) -> TrainConfig:
    """Reads a configuration that `save` wrote.

    Args:
      path: the JSON file.

    Returns:
      The configuration; fields that the file leaves out have their defaults.

    Raises:
      ConfigError: unknown field, wrong type or bad JSON, with the file and the field.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: can't be read: {error}") from error
    except json.JSONDecodeError as error:
        raise ConfigError(f"{path}:{error.lineno}: not JSON: {error.msg}") from error
    try:
        return from_json(TrainConfig, values)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def to_json(value: Any) -> Any:
    """Turns a configuration into what `json.dumps` takes: dicts, lists, numbers and strings."""
    if dataclasses.is_dataclass(value):
        fields = dataclasses.fields(value)
        return {field.name: to_json(getattr(value, field.name)) for field in fields}
    if isinstance(value, tuple):
        return [to_json(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def from_json(kind: Any, value: Any, field: str = "") -> Any:
    """Turns parsed JSON into a value of the type that an annotation names.

    Args:
      kind: a dataclass, a plain type, `X | None`, `Literal[...]`, `tuple[X, ...]`, `tuple[X, Y]`,
        or one of these in `Annotated`.
      value: what the JSON holds.
      field: dotted name of the place, for the message.

    Returns:
      The value; an int where a float is asked for becomes one.

    Raises:
      ConfigError: the value does not fit the type.
    """
    origin = typing.get_origin(kind)
    if origin is Annotated:
        return from_json(typing.get_args(kind)[0], value, field)
    if origin in (typing.Union, types.UnionType):
        return _optional_from_json(kind, value, field)
    if origin is tuple:
        return _tuple_from_json(kind, value, field)
    if dataclasses.is_dataclass(kind):
        return _dataclass_from_json(kind, value, field)
    return _leaf_from_json(kind, value, field)


def _leaf_from_json(kind: Any, value: Any, field: str) -> Any:
    if typing.get_origin(kind) is Literal:
        if value not in typing.get_args(kind):
            choices = ", ".join(repr(choice) for choice in typing.get_args(kind))
            raise ConfigError(f"{field}: {value!r} is none of {choices}")
        return value
    if kind is float and type(value) is int:
        return float(value)
    if kind is Path and type(value) is str:
        return Path(value)
    if type(value) is not kind:
        raise ConfigError(f"{field}: {value!r} is {_named(type(value))}, not {_named(kind)}")
    return value


def _optional_from_json(kind: Any, value: Any, field: str) -> Any:
    (inner,) = (choice for choice in typing.get_args(kind) if choice is not type(None))
    return None if value is None else from_json(inner, value, field)


def _tuple_from_json(kind: Any, value: Any, field: str) -> Any:
    if not isinstance(value, list):
        raise ConfigError(f"{field}: {value!r} is {_named(type(value))}, not a list")
    kinds = typing.get_args(kind)
    if kinds[-1] is Ellipsis:
        kinds = (kinds[0],) * len(value)
    if len(kinds) != len(value):
        raise ConfigError(f"{field}: has {len(value)} values, not {len(kinds)}")
    items = zip(kinds, value, strict=True)
    return tuple(from_json(k, item, f"{field}[{i}]") for i, (k, item) in enumerate(items))


def _dataclass_from_json(kind: Any, value: Any, field: str) -> Any:
    if not isinstance(value, dict):
        raise ConfigError(f"{field or 'top'}: {value!r} is {_named(type(value))}, not an object")
    hints = typing.get_type_hints(kind, include_extras=True)
    names = [entry.name for entry in dataclasses.fields(kind)]
    prefix = f"{field}." if field else ""
    for key in value:
        if key not in names:
            near = difflib.get_close_matches(key, names, n=3, cutoff=0.5) or names
            raise ConfigError(f"{prefix}{key}: no such field; near: {', '.join(near)}")
    parts = {key: from_json(hints[key], item, prefix + key) for key, item in value.items()}
    try:
        return kind(**parts)
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"{field or 'top'}: {error}") from error


def _named(kind: Any) -> str:
    if kind is type(None):
        return "null"
    return {list: "a list", dict: "an object", str: "text"}.get(
        kind, getattr(kind, "__name__", str(kind))
    )
