"""Configuration of the learner and of its network.

The defaults are the paper's CARLA column (300 M samples). source: CaRL paper, table of PPO
hyperparameters; the batch is 65,536 samples on any number of devices.
"""

from __future__ import annotations

import dataclasses
from typing import Literal


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """The actor-critic: an image encoder, a joint trunk, a Beta policy head and a value head."""

    encoder: Literal["carl", "roach", "patch"] = "carl"
    """Image encoder: the paper's seven convolutions, Roach's six, or patches (fast on a CPU)."""
    layer_norm: bool = True
    """LayerNorm after every linear layer and convolution, before the ReLU; Roach has none."""
    conv_init: Literal["xavier", "torch"] = "xavier"
    """First values of the convolutions: Xavier with bias 0.1 (Roach, CaRL on CARLA), or PyTorch's
    default (CaRL on nuPlan)."""
    asymmetric_critic: bool = True
    """Show the critic, and it alone, the numbers of `Observation.value_scalars`; Roach does not."""
    beta_min: float = 1.0
    """Lower bound of the Beta parameters; 1 keeps the density finite, Roach used 0."""
    hidden_size: int = 256
    """Width of the scalar branch, of the joint features and of both heads."""
    joint_size: int = 512
    """Width of the first layer that sees image and scalars together."""
    patch_size: int = 8
    """Side of the square patches that the patch encoder maps to features, px."""
    patch_features: tuple[int, int] = (32, 64)
    """Features of a patch, and of the 2 x 2 patches that are joined after it."""
    compute_dtype: Literal["float32", "bfloat16"] = "float32"
    """Type of activations and products. Parameters, the statistics of LayerNorms, the last layer of
    each head and the losses stay float32; bfloat16 pays on GPUs and TPUs, not on CPUs."""


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimisation."""

    total_samples: int = 300_000_000
    """Environment steps of the whole run; rounded up to whole updates."""
    num_envs: int = 128
    """Environments stepped together, over all devices."""
    num_steps: int = 512
    """Steps of each environment per update."""
    num_minibatches: int = 4
    """Minibatches (gradient steps) per epoch."""
    update_epochs: int = 3
    """Times that each sample is used."""
    micro_batch_size: int | None = None
    """Samples per device whose gradients are computed at once and added up to the minibatch's; the
    result is the same. Small ones fit a CPU's cache or a small GPU's memory. None: all at once."""
    learning_rate: float = 2.5e-4
    """Step size of Adam at the start."""
    anneal_lr: bool = True
    """Lower the learning rate linearly to zero over the run."""
    lr_schedule: Literal["linear", "late"] = "linear"
    """How: lr (1 - u / N) for update u = 0 ... N - 1, or an update later, lr (1 - (u - 1) / N), as
    the authors' Python trainer has it."""
    kl_patience: int | None = None
    """End an update after the epoch in which the policy has moved by more than `target_kl`, and
    halve the learning rate when that has happened so many times (Roach: 8). None: neither."""
    target_kl: float = 0.015
    """Mean KL(old policy || new policy) of an action dimension that ends an update."""
    # source: Roach, 1.5 x 0.01
    adam_eps: float = 1e-5
    """Adam's epsilon."""
    max_grad_norm: float = 0.5
    """Global norm to which gradients are clipped."""
    gamma: float = 0.99
    """Discount per step."""
    gae_lambda: float = 0.95
    """Decay of generalised advantage estimation."""
    bootstrap_truncated: bool = True
    """Value what would have followed an episode that ended without failure. The authors' code does
    not: there every end is worth zero. No matter for `carl` before episodes reach the time limit,
    which none did in ten minutes of the preset `cpu` (docs/experiments.md)."""
    clip_coef: float = 0.1
    """Range of the probability ratio around 1."""
    clip_vloss: float | None = 0.1
    """Range of the value around the one at collection, in units of return; None: not clipped."""
    norm_adv: bool = True
    """Normalise advantages to mean 0 and deviation 1."""
    norm_adv_scope: Literal["all", "device", "late"] = "all"
    """Over each minibatch of all devices together; or each device over its own part of it, as the
    authors' code does for nuPlan; or over the whole batch from the second epoch on, while the first
    sees them as they are, as in Roach's code."""
    ent_coef: float = 0.01
    """Weight of the entropy bonus."""
    entropy_reduction: Literal["sum", "mean"] = "sum"
    """Over the dimensions of the action in that bonus; Roach takes the mean."""
    hint_coef: float = 0.0
    """Weight of the loss by exploration hints (Roach: 0.05); 0: there are none."""
    vf_coef: float = 0.5
    """Weight of the value loss."""
    vloss_half: bool = True
    """Let the value loss be half the squared error; Roach takes all of it."""

    @property
    def batch_size(self) -> int:
        """Samples per update, over all devices."""
        return self.num_envs * self.num_steps

    @property
    def minibatch_size(self) -> int:
        """Samples per gradient step, over all devices."""
        return self.batch_size // self.num_minibatches

    @property
    def num_updates(self) -> int:
        """Updates of the whole run."""
        return -(-self.total_samples // self.batch_size)

    def validate(self, num_devices: int = 1) -> None:
        """Checks that environments, minibatches and micro-batches divide evenly.

        Args:
          num_devices: devices that share the environments.

        Raises:
          ValueError: naming both numbers.
        """
        for field in ("total_samples", "num_envs", "num_steps", "num_minibatches", "update_epochs"):
            if getattr(self, field) < 1:
                raise ValueError(f"ppo.{field} must be at least 1, not {getattr(self, field)}")
        if self.kl_patience is not None and self.kl_patience < 1:
            raise ValueError(f"ppo.kl_patience must be at least 1, not {self.kl_patience}")
        if not self.hint_coef >= 0.0:
            raise ValueError(f"ppo.hint_coef must be at least 0, not {self.hint_coef}")
        _check_divides("ppo.num_envs", self.num_envs, "devices", num_devices)
        local_batch = self.batch_size // num_devices
        name = f"the batch of one of {num_devices} device(s) (num_envs x num_steps / devices)"
        _check_divides(name, local_batch, "ppo.num_minibatches", self.num_minibatches)
        if self.micro_batch_size is not None:
            name = f"the minibatch of one of {num_devices} device(s)"
            local_minibatch = local_batch // self.num_minibatches
            _check_divides(name, local_minibatch, "ppo.micro_batch_size", self.micro_batch_size)


def _check_divides(name: str, total: int, part_name: str, part: int) -> None:
    if part < 1 or total % part != 0:
        raise ValueError(f"{name} is {total}, which {part_name} = {part} does not divide")
