"""One PPO update in PyTorch, with the losses of `carljax.ppo.loss`, for `learner_torch.py`."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import torch
from torch_network import Network

from carljax.ppo.beta import EDGE
from carljax.ppo.config import PPOConfig
from carljax.ppo.types import Minibatch


@dataclasses.dataclass(frozen=True)
class Samples:
    """A batch, (N,) in front; fields as those of `carljax.ppo.types.Minibatch`, all weights 1."""

    raster: torch.Tensor
    scalars: torch.Tensor
    value_scalars: torch.Tensor
    action: torch.Tensor
    log_prob: torch.Tensor
    value: torch.Tensor
    advantage: torch.Tensor
    target: torch.Tensor

    def rows(self, rows: torch.Tensor) -> Samples:
        """Some of the samples."""
        fields = dataclasses.fields(self)
        return Samples(**{field.name: getattr(self, field.name)[rows] for field in fields})

    def double(self) -> Samples:
        """The same in float64; images stay bytes."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return Samples(**{k: v if k == "raster" else v.double() for k, v in values.items()})


def samples_of(minibatch: Minibatch) -> Samples:
    """Our samples as PyTorch's tensors."""

    def tensor(array: jax.Array) -> torch.Tensor:
        return torch.from_numpy(np.array(array))

    names = ("action", "log_prob", "value", "advantage", "target")
    return Samples(
        raster=tensor(minibatch.obs.raster),
        scalars=tensor(minibatch.obs.scalars),
        value_scalars=tensor(minibatch.obs.value_scalars),
        **{name: tensor(getattr(minibatch, name)) for name in names},
    )


def make_optimizer(network: Network, rate: float, config: PPOConfig) -> torch.optim.Optimizer:
    """Adam, in one pass over all parameters."""
    return torch.optim.Adam(network.parameters(), lr=rate, eps=config.adam_eps, fused=True)


def update(
    network: Network,
    optimizer: torch.optim.Optimizer,
    samples: Samples,
    rows: torch.Tensor,
    config: PPOConfig,
    micro: int,
) -> None:
    """Runs gradient steps on one batch.

    Args:
      network: is changed.
      optimizer: likewise.
      samples: (N,).
      rows: (S, M) int64, the samples of each gradient step.
      config: of plain PPO: no KL patience, no hints, advantages normalised by minibatch or not.
      micro: samples whose gradients are computed at once and added up to the minibatch's.
    """
    for minibatch in rows:
        advantage = samples.advantage[minibatch]
        if config.norm_adv:
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        optimizer.zero_grad(set_to_none=True)
        pieces = zip(minibatch.split(micro), advantage.split(micro), strict=True)
        for piece, piece_advantage in pieces:
            part = dataclasses.replace(samples.rows(piece), advantage=piece_advantage)
            loss(network, part, config, len(minibatch)).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), config.max_grad_norm)
        optimizer.step()


def loss(network: Network, samples: Samples, config: PPOConfig, num: int) -> torch.Tensor:
    """() policy, value and entropy loss of a piece: sums over it, divided by the whole minibatch.

    Args:
      network: actor and critic.
      samples: the piece, its advantages normalised.
      config: clip ranges and coefficients.
      num: samples of the minibatch.
    """
    alpha, beta, value = network(samples.raster, samples.scalars, samples.value_scalars)
    ratio = torch.exp(log_prob(samples.action, alpha, beta) - samples.log_prob)
    clipped = ratio.clamp(1.0 - config.clip_coef, 1.0 + config.clip_coef)
    policy_loss = torch.maximum(-samples.advantage * ratio, -samples.advantage * clipped)
    error = (value - samples.target).square()
    if config.clip_vloss is not None:
        moved = (value - samples.value).clamp(-config.clip_vloss, config.clip_vloss)
        error = torch.maximum(error, (samples.value + moved - samples.target).square())
    value_coef = config.vf_coef * (0.5 if config.vloss_half else 1.0)
    entropy_coef = config.ent_coef
    if config.entropy_reduction == "mean":
        entropy_coef = entropy_coef / alpha.shape[1]
    each = policy_loss + value_coef * error - entropy_coef * entropy(alpha, beta)
    return each.sum() / num


def log_prob(x: torch.Tensor, alpha: torch.Tensor, beta: torch.Tensor) -> torch.Tensor:
    """(N,) log density of (N, A) actions, summed over their dimensions."""
    x = x.clamp(EDGE, 1.0 - EDGE)
    terms = (alpha - 1.0) * x.log() + (beta - 1.0) * torch.log1p(-x) - _log_b(alpha, beta)
    return terms.sum(dim=1)


def entropy(alpha: torch.Tensor, beta: torch.Tensor) -> torch.Tensor:
    """(N,) differential entropy, summed over the action's dimensions."""
    both = alpha + beta
    terms = (
        _log_b(alpha, beta)
        - (alpha - 1.0) * torch.digamma(alpha)
        - (beta - 1.0) * torch.digamma(beta)
        + (both - 2.0) * torch.digamma(both)
    )
    return terms.sum(dim=1)


def _log_b(alpha: torch.Tensor, beta: torch.Tensor) -> torch.Tensor:
    return torch.lgamma(alpha) + torch.lgamma(beta) - torch.lgamma(alpha + beta)
