"""What happened on a drive, in order: a list of fixed size that grows within compiled code."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

# Most events that are told apart; counts go on beyond. source: ours, far more than any route that
# is worth reading about
CAPACITY = 64


class EventLog(struct.PyTreeNode):
    """Events, E = CAPACITY rows of which the first `num` are filled.

    Attributes:
      num: () int32, may exceed E.
      kind: (E,) int32, which of the names that the writer uses; -1 for an empty row.
      xyz: (E, 3) m, where the ego was.
      step: (E,) int32, of the simulator.
      agent: (E,) int32, row of the other road user; -1 for none.
    """

    num: jax.Array
    kind: jax.Array
    xyz: jax.Array
    step: jax.Array
    agent: jax.Array


def empty() -> EventLog:
    """A log with nothing in it."""
    none = jnp.full(CAPACITY, -1, jnp.int32)
    return EventLog(
        num=jnp.zeros((), jnp.int32),
        kind=none,
        xyz=jnp.zeros((CAPACITY, 3), jnp.float32),
        step=none,
        agent=none,
    )


def append(
    log: EventLog, happened: jax.Array, xyz: jax.Array, step: jax.Array, agent: jax.Array
) -> EventLog:
    """Adds what happened in one step.

    Args:
      log: so far.
      happened: (K,) bool by kind.
      xyz: (3,) m, where the ego is.
      step: () int32.
      agent: (K,) int32, row of the other road user; -1 for none.

    Returns:
      The log with it; what does not fit is counted only.
    """
    num_kinds = happened.shape[0]
    place = jnp.where(happened, log.num + jnp.cumsum(happened) - 1, CAPACITY)

    def write(rows: jax.Array, value: jax.Array) -> jax.Array:
        return rows.at[place].set(value, mode="drop")

    return EventLog(
        num=log.num + happened.sum().astype(jnp.int32),
        kind=write(log.kind, jnp.arange(num_kinds, dtype=jnp.int32)),
        xyz=write(log.xyz, jnp.broadcast_to(xyz, (num_kinds, 3))),
        step=write(log.step, jnp.broadcast_to(step, (num_kinds,))),
        agent=write(log.agent, agent),
    )
