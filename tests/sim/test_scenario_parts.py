"""Rows that scenarios share, against lists of them in plain Python."""

import jax
import jax.numpy as jnp
import numpy as np

from carljax.sim.scenarios import parts

NUM_ROWS, NUM_SLOTS, NUM_STEPS = 8, 3, 400


@jax.jit
def hand_over(rows, slot, num):
    return parts.hand_over(rows, jnp.arange(NUM_SLOTS) == slot, num)


def played(owners, rng):
    """One change at random to a list of (slot, number) or None; what it was, and the rows of it."""
    slot, num = int(rng.integers(NUM_SLOTS)), int(rng.integers(1, 5))
    lost = [row for row, owner in enumerate(owners) if owner and owner[0] == slot]
    free = [row for row, owner in enumerate(owners) if not owner or owner[0] == slot]
    if rng.random() < 0.3:
        return "leave", slot, 0, [None if row in lost else x for row, x in enumerate(owners)], lost
    if len(free) < num:
        return "wait", slot, num, owners, []
    after = [None if row in lost else owner for row, owner in enumerate(owners)]
    for number, row in enumerate(free[:num]):
        after[row] = (slot, number)
    return "arm", slot, num, after, sorted(set(lost) | set(free[:num]))


def test_rows_are_given_and_freed_as_in_a_list():
    rng = np.random.default_rng(0)
    rows, owners, seen = parts.none(NUM_ROWS), [None] * NUM_ROWS, set()
    for _ in range(NUM_STEPS):
        kind, slot, num, after, changed = played(owners, rng)
        seen.add(kind)
        if kind == "leave":
            rows = parts.without(rows, jnp.arange(NUM_SLOTS) == slot)
        else:
            enough = bool(parts.num_free(rows, jnp.int32(slot)) >= num)
            assert enough == (kind == "arm")
            rows, differ = hand_over(rows, slot if enough else -1, num)
            assert np.flatnonzero(differ).tolist() == changed
        owners = after
        assert rows.slot.tolist() == [owner[0] if owner else -1 for owner in owners]
        assert all(rows.number[i] == owner[1] for i, owner in enumerate(owners) if owner)
        weight = jnp.arange(10.0, 10.0 + NUM_SLOTS)
        of_rows = parts.of_slots(rows, weight, -1.0).tolist()
        assert of_rows == [10.0 + owner[0] if owner else -1.0 for owner in owners]
        first = parts.any_of(rows, rows.number == 0, NUM_SLOTS).tolist()
        assert first == [any(owner == (slot, 0) for owner in owners) for slot in range(NUM_SLOTS)]
    assert seen == {"leave", "wait", "arm"}
