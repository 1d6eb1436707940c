"""A tiny task in the environment's protocol: keep a drifting dot in the middle of a small image."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from carljax.sim.types import Observation, State

SIZE = 16  # px


@struct.dataclass
class Dot:
    """Attributes: x () position in [-1, 1]; t () int32 step of the episode."""

    x: jax.Array
    t: jax.Array


@struct.dataclass
class ToyEnv:
    """The first action moves the dot; the reward is 1 - |x|; leaving [-1, 1] terminates.

    Attributes:
      starts: (S,) positions to start from, an array argument as an episode bank is.
      limit: steps after which an episode is truncated.
    """

    starts: jax.Array
    limit: int = struct.field(pytree_node=False, default=32)

    @property
    def levels(self):
        """Both channels are masks."""
        return ((255,), (255,))

    def start(self, key: jax.Array) -> State:
        """Draws a position."""
        idx = jax.random.randint(key, (), 0, self.starts.shape[0])
        return self._state(Dot(self.starts[idx], jnp.zeros((), jnp.int32)), jnp.float32(0.0))

    def advance(self, state: State, action: jax.Array) -> State:
        """Moves the dot."""
        dot = Dot(state.pipeline_state.x + 0.25 * action[0], state.pipeline_state.t + 1)
        return self._state(dot, 1.0 - jnp.abs(dot.x), started=True)

    def observe(self, state: State) -> State:
        """Draws a bright bar at the dot's column."""
        x = state.pipeline_state.x
        columns = jnp.linspace(-1.0, 1.0, SIZE, dtype=jnp.float32)
        bar = jnp.abs(columns - x) < 0.15
        raster = jnp.broadcast_to(bar[None, :, None], (SIZE, SIZE, 2))
        fraction = state.pipeline_state.t.astype(jnp.float32) / self.limit
        return state.replace(
            obs=Observation(
                raster=raster.astype(jnp.uint8) * jnp.uint8(255),
                scalars=jnp.zeros((8,), jnp.float32),
                value_scalars=jnp.zeros((10,), jnp.float32).at[0].set(fraction),
            )
        )

    def _state(self, dot: Dot, reward: jax.Array, started: bool = False) -> State:
        out = jnp.abs(dot.x) > 1.0
        timeout = (dot.t >= self.limit) & ~out
        truncation = timeout.astype(jnp.float32)
        return State(
            pipeline_state=dot,
            obs=None,
            reward=reward,
            done=(out | timeout).astype(jnp.float32) if started else jnp.zeros_like(truncation),
            metrics={"toy/distance": jnp.abs(dot.x), "episode/length": dot.t.astype(jnp.float32)},
            info={"truncation": truncation if started else jnp.zeros_like(truncation)},
        )


def make() -> ToyEnv:
    """Returns the environment with a bank of nine starts."""
    return ToyEnv(starts=jnp.linspace(-0.8, 0.8, 9, dtype=jnp.float32))
