"""Who plays what: which rows of `Agents` the scenarios in play have, and for which of their actors.

Few scenarios need all the actors that one may have, and a row costs the same whether anybody is in
it or not. So the scenarios in play share rows: each gets as many as it needs when it is armed, and
they are free again when it has gone.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct


class Parts(struct.PyTreeNode):
    """P rows and whose they are.

    Attributes:
      slot: (P,) int32, the slot of the scenario that has this row; -1 for a free one.
      number: (P,) int32, which of its actors is in this row, counted from 0.
    """

    slot: jax.Array
    number: jax.Array

    @property
    def is_free(self) -> jax.Array:
        """(P,) bool, nobody's."""
        return self.slot < 0


def none(num_rows: int) -> Parts:
    """Free rows."""
    return Parts(jnp.full(num_rows, -1, jnp.int32), jnp.zeros(num_rows, jnp.int32))


def of_slots(parts: Parts, values: jax.Array, nobodys: float | bool) -> jax.Array:
    """(P,) what each row's slot has of values (H,), and something else for free rows."""
    return jnp.where(parts.is_free, nobodys, values[jnp.maximum(parts.slot, 0)])


def any_of(parts: Parts, rows: jax.Array, num_slots: int) -> jax.Array:
    """(H,) bool, one of the slot's rows is among rows (P,) bool."""
    return ((parts.slot == jnp.arange(num_slots)[:, None]) & rows).any(axis=1)


def without(parts: Parts, gone: jax.Array) -> Parts:
    """Frees the rows of slots (H,) bool."""
    return parts.replace(slot=jnp.where(of_slots(parts, gone, False), -1, parts.slot))


def num_free(parts: Parts, slot: jax.Array) -> jax.Array:
    """() int32, rows that a new scenario in a slot, () int32, could have."""
    return (parts.is_free | (parts.slot == slot)).sum()


def hand_over(parts: Parts, taken: jax.Array, num: jax.Array) -> tuple[Parts, jax.Array]:
    """Gives rows to the actors of a scenario that takes a slot; whoever had the slot loses them.

    Args:
      parts: before.
      taken: (H,) bool, the slot; False everywhere changes nothing.
      num: () int32, actors of the scenario, no more than `num_free`.

    Returns:
      Afterwards, and (P,) bool: the rows that are given or lost.
    """
    emptied = without(parts, taken)
    number = jnp.cumsum(emptied.is_free) - 1
    given = emptied.is_free & (number < num) & taken.any()
    after = Parts(
        slot=jnp.where(given, jnp.argmax(taken), emptied.slot).astype(jnp.int32),
        number=jnp.where(given, number, parts.number).astype(jnp.int32),
    )
    return after, given | (emptied.slot != parts.slot)
