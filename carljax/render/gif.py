"""An episode as an animated GIF, driven by the deterministic policy; every third step is drawn."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

from carljax import drive
from carljax.drive import Policy
from carljax.render.episode_view import frame, read_world
from carljax.sim.env import DrivingEnv
from carljax.sim.types import State

FRAME_EVERY = 3  # simulator steps of 0.1 s
FRAME_MS = 100  # three times as fast as real
MAX_FRAMES = 400
NUM_COLOURS = 96


def save(path: Path, env: DrivingEnv, policy: Policy, episode_idx: int, seed: int = 0) -> None:
    """Drives one route and writes it as an animated GIF.

    Args:
      path: the file to write.
      env: with the route.
      policy: who drives.
      episode_idx: row of the environment's bank.
      seed: of the traffic; 0 drives what `evaluate` drives.
    """
    world = read_world(env, episode_idx)
    frames = [
        frame(env, world, state, command)
        for state, command in episode(env, policy, episode_idx, seed)
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    palette = frames[len(frames) // 2].quantize(NUM_COLOURS)
    small = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in frames]
    small[0].save(
        path, save_all=True, append_images=small[1:], duration=FRAME_MS, loop=0, optimize=True
    )


def episode(
    env: DrivingEnv, policy: Policy, episode_idx: int, seed: int = 0
) -> Iterator[tuple[State, np.ndarray]]:
    """Drives one route, giving every third state and the last.

    Args:
      env: with the route.
      policy: who drives.
      episode_idx: row of the environment's bank.
      seed: of the traffic.

    Yields:
      The unbatched state on the host, and the (2,) action that led to it.
    """
    policy = policy.replace(needs_image=True)
    step = drive.compiled(drive.step)
    run = jax.jit(drive.start)(policy, env, jnp.array([episode_idx]), jax.random.key(seed))
    for number in range(1, MAX_FRAMES * FRAME_EVERY + 1):
        run, command = step(policy, env, run)
        state = run.drive.state
        is_last = float(state.done[0]) > 0
        if is_last or number % FRAME_EVERY == 0:
            one = jax.tree.map(lambda x: x[0], state.replace(pipeline_state=_keyless(state)))
            yield jax.device_get(one), np.asarray(command[0])
        if is_last:
            return


def _keyless(state: State) -> Any:
    return state.pipeline_state.replace(key=jnp.zeros(state.done.shape))
