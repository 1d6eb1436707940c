"""What the learner keeps and passes on. Axes: T time, B environments, A = 2 action dimensions."""

from __future__ import annotations

from typing import Any

import jax
from flax import struct

from carljax.ppo.kl_patience import KLPatience
from carljax.sim.types import State


class Transition(struct.PyTreeNode):
    """Steps of a rollout, (T, B) in front.

    Attributes:
      obs: what the policy saw; raster uint8. In training what is kept of it, see `obs_storage`.
      action: (A,) float32 in (0, 1), the Beta sample.
      log_prob: () of `action`, summed over its dimensions.
      value: () the critic's estimate for `obs`.
      reward: ().
      done: () float32, 1 where the step ended the episode.
      truncation: () float32, 1 where it ended without failure.
      weight: () float32, 0 on the step that restarts an ended episode: it carries no decision.
      policy: (A,) alpha and (A,) beta of the policy that acted; None unless a KL is to be measured.
      hint: () int8, what an end at this step suggests, see `hints`; None without hints.
    """

    obs: Any
    action: jax.Array
    log_prob: jax.Array
    value: jax.Array
    reward: jax.Array
    done: jax.Array
    truncation: jax.Array
    weight: jax.Array
    policy: tuple[jax.Array, jax.Array] | None = None
    hint: jax.Array | None = None


class Minibatch(struct.PyTreeNode):
    """Samples of one gradient step, or a piece of them; (N,) in front.

    Attributes:
      obs: as in `Transition`.
      action: (A,) float32 in (0, 1).
      log_prob: () at collection.
      value: () at collection.
      advantage: () normalised if the config says so.
      target: () return that the critic learns.
      weight: () sums to 1 over the whole minibatch of all devices, so that sums are means.
      policy: as in `Transition`.
      hint: () int8, what is suggested for this step; None without hints.
    """

    obs: Any
    action: jax.Array
    log_prob: jax.Array
    value: jax.Array
    advantage: jax.Array
    target: jax.Array
    weight: jax.Array
    policy: tuple[jax.Array, jax.Array] | None = None
    hint: jax.Array | None = None


class TrainState(struct.PyTreeNode):
    """All that an exact resume needs.

    Attributes:
      params: variables of the network, replicated over devices.
      opt_state: of the optimiser, replicated.
      env_state: environment states, (B,) in front, shared out over devices.
      key: () PRNG key of the run, never changed; each update folds its number into it.
      update: () int32, updates done.
      patience: see `kl_patience`; None without that schedule.
    """

    params: Any
    opt_state: Any
    env_state: State
    key: jax.Array
    update: jax.Array
    patience: KLPatience | None = None
