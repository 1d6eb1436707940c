"""Configurations by name: the paper's columns, and one that learns on two CPU cores in minutes."""

from __future__ import annotations

import dataclasses

import jax

from carljax.config import RunConfig, TrainConfig
from carljax.ppo.config import NetworkConfig, PPOConfig
from carljax.reward.config import RewardConfig
from carljax.sim.env import EnvConfig, ObservationKind
from carljax.sim.raster_canvas import RasterConfig


@dataclasses.dataclass(frozen=True)
class Preset:
    """A configuration and what it is for, in one line."""

    description: str
    config: TrainConfig


# source: CaRL paper, table of PPO hyperparameters, column CaRL (CARLA); these are also the defaults
# of PPOConfig, NetworkConfig, RewardConfig and RasterConfig. Pieces of 1,024 samples leave the
# gradient as it is and keep the activations of a minibatch of 16,384 within one accelerator.
CARL_CARLA = TrainConfig(
    env=EnvConfig(),
    network=NetworkConfig(encoder="carl"),
    ppo=PPOConfig(
        total_samples=300_000_000,
        num_envs=128,
        num_steps=512,
        num_minibatches=4,
        update_epochs=3,
        micro_batch_size=1024,
        learning_rate=2.5e-4,
        anneal_lr=True,
        gamma=0.99,
        gae_lambda=0.95,
        clip_coef=0.1,
        clip_vloss=0.1,
        norm_adv=True,
        ent_coef=0.01,
        vf_coef=0.5,
        max_grad_norm=0.5,
    ),
    run=RunConfig(num_routes=4096),
)

# source: CaRL paper, table of PPO hyperparameters, column Atari (after Huang et al. 2023). The
# column has values of PPO alone; observation, reward and network stay those of carl-carla.
ATARI = dataclasses.replace(
    CARL_CARLA,
    ppo=dataclasses.replace(
        CARL_CARLA.ppo,
        total_samples=10_000_000,
        num_envs=8,
        num_steps=128,
        num_minibatches=4,
        update_epochs=4,
        micro_batch_size=None,
    ),
    run=RunConfig(num_routes=4096, checkpoint_every=500),
)

# What the columns below see and are paid for. source: Roach's code; the authors' code, whose run of
# 1 B has the additive reward
ROACH_ENV = EnvConfig(observation="roach")
ROACH_REWARD = RewardConfig(name="roach")
NUPLAN_ENV = EnvConfig(observation="nuplan")
NUPLAN_REWARD = RewardConfig(name="carl-nuplan-survival")
NUPLAN_TUNED_REWARD = RewardConfig(name="carl-nuplan-tuned")

# source: CaRL paper, table of PPO hyperparameters, column Roach; what the table leaves open (KL
# patience, targets of the hints, loss terms, initialisation, the mode as action) from Roach's code.
# Six environments go on one device.
ROACH = TrainConfig(
    env=ROACH_ENV,
    reward=ROACH_REWARD,
    network=NetworkConfig(encoder="roach", layer_norm=False, asymmetric_critic=False, beta_min=0.0),
    ppo=PPOConfig(
        total_samples=10_000_000,
        num_envs=6,
        num_steps=2048,
        num_minibatches=48,
        update_epochs=20,
        learning_rate=1e-5,
        anneal_lr=False,
        kl_patience=8,
        target_kl=0.015,
        gamma=0.99,
        gae_lambda=0.9,
        clip_coef=0.2,
        clip_vloss=None,
        norm_adv=False,
        ent_coef=0.01,
        entropy_reduction="mean",
        hint_coef=0.05,
        vf_coef=0.5,
        vloss_half=False,
        max_grad_norm=0.5,
    ),
    run=RunConfig(num_routes=4096, num_devices=1, eval_action="mode"),
)

# source: CaRL paper, table of PPO hyperparameters, column CaRL (nuPlan), 500 M; the authors' code
# leaves the convolutions as PyTorch makes them. What is not set is as in carl-carla.
CARL_NUPLAN = TrainConfig(
    env=NUPLAN_ENV,
    reward=NUPLAN_REWARD,
    network=NetworkConfig(encoder="carl", conv_init="torch"),
    ppo=dataclasses.replace(
        CARL_CARLA.ppo,
        total_samples=500_000_000,
        num_envs=512,
        num_steps=32,
        num_minibatches=4,
        update_epochs=4,
        micro_batch_size=512,  # what is left of a minibatch on one of eight devices
    ),
    run=RunConfig(num_routes=4096, checkpoint_every=500),
)

# source: the same column, 1 B
CARL_NUPLAN_1B = dataclasses.replace(
    CARL_NUPLAN,
    reward=NUPLAN_TUNED_REWARD,
    ppo=dataclasses.replace(CARL_NUPLAN.ppo, total_samples=1_000_000_000, num_envs=1024),
)

# Ours: the same reward and loss for minutes on two cores. A small image (48 m ahead, 20 m to the
# sides) that shows the whole route, a patch encoder, and for a run this short larger steps, wider
# clipping, and a discount under which waiting out a red light is worth while (0.99 halves the value
# of what comes after in 7 s). Samples are cheap here, so each is used once, in small minibatches.
# docs/experiments.md has the runs behind these values.
CPU = TrainConfig(
    env=EnvConfig(
        raster=RasterConfig(
            height=64, width=40, pixels_per_metre=1.0, ego_from_bottom_px=16, route_everywhere=True
        )
    ),
    network=NetworkConfig(encoder="patch", hidden_size=128, joint_size=256),
    ppo=PPOConfig(
        total_samples=4_000_000,
        num_envs=128,
        num_steps=64,
        num_minibatches=32,
        update_epochs=1,
        learning_rate=5e-4,
        gamma=0.997,
        clip_coef=0.2,
        clip_vloss=None,
        vf_coef=0.1,
    ),
    run=RunConfig(num_devices=1),
)

PRESETS = {
    "cpu": Preset("Small image and network: learns on two CPU cores in minutes.", CPU),
    "carl-carla": Preset(
        "The paper's CARLA column: 256 px, seven convolutions, 300 M.", CARL_CARLA
    ),
    "carl-nuplan": Preset(
        "The paper's nuPlan column: its view and reward, 512 environments, 500 M.", CARL_NUPLAN
    ),
    "carl-nuplan-1b": Preset(
        "The same with the tuned reward and 1,024 environments, 1 B.", CARL_NUPLAN_1B
    ),
    "roach": Preset(
        "Roach: its view and reward, KL patience, exploration hints, 6 environments, 10 M.", ROACH
    ),
    "atari": Preset("PPO as for Atari, else as carl-carla: 8 environments, 10 M.", ATARI),
}


def seen_as(kind: ObservationKind) -> dict[str, Preset]:
    """The presets with another observation, each in its authors' size unless the preset says one.

    Args:
      kind: of `observation.KINDS`.

    Returns:
      Presets of the same names.
    """
    return {
        name: dataclasses.replace(
            preset,
            config=dataclasses.replace(preset.config, env=preset.config.env.with_observation(kind)),
        )
        for name, preset in PRESETS.items()
    }


def default_name() -> str:
    """Names the preset for this machine: `carl-carla` with an accelerator, else `cpu`."""
    return "cpu" if jax.default_backend() == "cpu" else "carl-carla"
