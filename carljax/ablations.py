"""The tables of the paper's method, and one of ours, as data: what a cell trains, how it is scored.

A cell is a preset with a few values changed; the preset is the user's, so that the same table can
be made on a laptop and on a node of GPUs. Where the paper gives a size (a minibatch of 256) that is
what is trained; where it scales (thirty times the samples) the ratio is kept.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from carljax import presets
from carljax.config import Action, ConfigError, TrainConfig
from carljax.sim import observation


@dataclasses.dataclass(frozen=True)
class Times:
    """A value of the preset, multiplied; a whole number stays whole, and 1 at least."""

    factor: float


@dataclasses.dataclass(frozen=True)
class Cell:
    """One training of a table.

    Attributes:
      name: its row.
      changes: {dotted name of a field of `TrainConfig`: value or `Times`}.
      minibatch: samples of a gradient step, reached by longer or shorter rollouts, so that an
        epoch keeps its number of gradient steps; None leaves the preset's.
      samples_frac: of the samples asked for.
      actions: what is done with the policy's distribution when it is scored; a row for each.
    """

    name: str
    changes: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    minibatch: int | None = None
    samples_frac: float = 1.0
    actions: tuple[Action, ...] = ("mean",)


@dataclasses.dataclass(frozen=True)
class Ablation:
    """One table.

    Attributes:
      title: what it asks, and where it stands in the paper.
      cells: in the paper's order.
      preset: the one that it is about; None for the user's.
    """

    title: str
    cells: tuple[Cell, ...]
    preset: str | None = None


def _input(kind: str, encoder: str) -> dict[str, Any]:
    """An observation in its authors' size with the encoder made for it."""
    raster = observation.KINDS[kind].raster
    return {"env.observation": kind, "env.raster": raster, "network.encoder": encoder}


# source: the paper's tables; their labels there stand in each title
ABLATIONS: dict[str, Ablation] = {
    "reward-minibatch": Ablation(
        "Reward and minibatch size (tab:reward)",
        tuple(
            Cell(f"{label}, minibatch {size}", {"reward.name": name}, minibatch=size)
            for label, name in (("Roach", "roach"), ("CaRL", "carl"))
            for size in (256, 1024)
        ),
    ),
    # As in the paper, before it changes the reward: both sets with Roach's.
    "hyperparameters": Ablation(
        "Hyperparameter set and statistic of the output (tab:hyperparameter_performance)",
        (
            Cell(
                "Roach's set",
                {"reward.name": "roach", "ppo": presets.ROACH.ppo},
                actions=("mode",),
            ),
            Cell(
                "Atari's set",
                {"reward.name": "roach", "ppo": presets.ATARI.ppo},
                actions=("mode", "mean"),
            ),
        ),
    ),
    # 10 M against 300 M samples, with 16 times as many environments.
    "scale": Ablation(
        "Samples and parallel environments (tab:scale)",
        (
            Cell(
                "a 30th of the samples",
                {"ppo.num_envs": Times(1 / 16), "ppo.micro_batch_size": None},
                samples_frac=1 / 30,
            ),
            Cell("all samples"),
        ),
    ),
    "epochs": Ablation(
        "Epochs (tab:epochs)",
        tuple(Cell(f"{number} epochs", {"ppo.update_epochs": number}) for number in (4, 3)),
    ),
    "architecture": Ablation(
        "Architecture (tab:architecture)",
        (
            Cell("plain", {"network.layer_norm": False, "network.asymmetric_critic": False}),
            Cell("+ LayerNorm", {"network.layer_norm": True, "network.asymmetric_critic": False}),
            Cell(
                "+ asymmetric critic",
                {"network.layer_norm": True, "network.asymmetric_critic": True},
            ),
        ),
    ),
    "action-distribution": Ablation(
        "Range of the Beta parameters (tab:action_distribution)",
        tuple(
            Cell(f"alpha, beta above {least:.0f}", {"network.beta_min": least})
            for least in (0.0, 1.0)
        ),
    ),
    "input": Ablation(
        "Input (tab:input)",
        (
            Cell("Roach, 192 x 192 x 15", _input("roach", "roach")),
            Cell("CaRL, 256 x 256 x 10", _input("carla", "carl")),
        ),
    ),
    # Ours: to judge the values of the preset `cpu` by. With --minutes each cell has the same time.
    "cpu-preset": Ablation(
        "The cpu preset with one thing changed",
        (
            Cell("as it is"),
            Cell("no value at truncation", {"ppo.bootstrap_truncated": False}),
            Cell("64 x 64 px", {"env.raster.width": 64}),
            Cell(
                "96 x 60 px, 1.5 px/m",
                {
                    "env.raster.height": 96,
                    "env.raster.width": 60,
                    "env.raster.pixels_per_metre": 1.5,
                    "env.raster.ego_from_bottom_px": 24,
                },
            ),
            Cell("convolutions", {"network.encoder": "carl"}),
            Cell("256 environments", {"ppo.num_envs": 256}),
            Cell("batch of 128 steps", {"ppo.num_steps": 128}),
            Cell("3 epochs, minibatch 1024", {"ppo.update_epochs": 3, "ppo.num_minibatches": 8}),
        ),
        preset="cpu",
    ),
}


def configure(cell: Cell, base: TrainConfig, samples: int) -> TrainConfig:
    """The configuration of a cell.

    Args:
      cell: of a table.
      base: the preset.
      samples: environment steps that are asked for.

    Returns:
      The preset with the cell's changes.

    Raises:
      ConfigError: the cell's minibatch can't be reached with the preset's environments.
    """
    config = base
    for name, value in cell.changes.items():
        config = changed(config, name.split("."), value)
    ppo = config.ppo
    if cell.minibatch is not None:
        num_steps, rest = divmod(cell.minibatch * ppo.num_minibatches, ppo.num_envs)
        if rest or num_steps < 1:
            raise ConfigError(
                f"{cell.name}: {ppo.num_minibatches} minibatches of {cell.minibatch} samples are no"
                f" whole number of steps of {ppo.num_envs} environments"
            )
        micro = ppo.micro_batch_size
        if micro is not None and cell.minibatch % micro:
            micro = None
        ppo = dataclasses.replace(ppo, num_steps=num_steps, micro_batch_size=micro)
    ppo = dataclasses.replace(ppo, total_samples=max(round(samples * cell.samples_frac), 1))
    return dataclasses.replace(config, ppo=ppo)


def changed(part: Any, path: list[str], value: Any) -> Any:
    """A configuration with one field changed, in it or in its parts.

    Args:
      part: a dataclass.
      path: names of fields, from the outside in.
      value: new value, or `Times`.
    """
    first, *rest = path
    old = getattr(part, first)
    if rest:
        new = changed(old, rest, value)
    elif isinstance(value, Times):
        whole = isinstance(old, int)
        new = max(round(old * value.factor), 1) if whole else old * value.factor
    else:
        new = value
    return dataclasses.replace(part, **{first: new})
