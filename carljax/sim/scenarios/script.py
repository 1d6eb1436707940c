"""What a scenario is to the simulator: data, whatever its kind.

A scenario is placed on a route ahead of time, on the host (one file for each kind beside this one),
and played by one engine on the device. It has a few actors and a few effects, and all that differs
between kinds is numbers here: so a new kind costs the compiled program nothing. All distances are
arc lengths on the ego's route unless they say otherwise.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from carljax.sim.scenarios import parts
from carljax.sim.scenarios.parts import Parts

NUM_CARS = 4  # actors of a scenario that drive on lanes
NUM_OTHERS = 3  # actors that stand or move straight on: pedestrians, bicycles, obstacles, doors
# Rows of cars and of others that each further scenario in play at once adds to those of the first:
# most scenarios have one car, or one or two others. source: ours
MORE_CARS, MORE_OTHERS = 2, 1
WAY_LANES = 5  # lanes of a car's way: a junction, both roads beside it and as much again
NUM_PATCHES = 3  # stretches of disturbed control

# How a car of a scenario drives.
DRIVE_LEGAL = 0  # as other traffic does
DRIVE_FLOW = 1  # at its own speed, minding only cars ahead; starts again at its source
DRIVE_MEET = 2  # likewise, but so as to be at `meet_lane_s` when the ego is at `meet_s`


class ScriptedCars(struct.PyTreeNode):
    """Actors on lanes, L = NUM_CARS rows, W = WAY_LANES; those that there are come first.

    Attributes:
      model: (L,) int32, row in the table of vehicle classes; -1 for no car.
      lanes: (L, W) int32, the lanes of its way, -1 pads.
      s: (L,) m on the first of them, where it starts.
      speed: (L,) m/s, at the start and its free speed; 0 leaves it to the limit.
      drive: (L,) int32, DRIVE_*.
      travel: (L,) m along its way from the beginning of lanes[0]: a DRIVE_FLOW car that has come so
        far starts again, at `s` and with `speed`.
      meet_s: (L,) m on the route, where its way meets the ego's.
      meet_lane_s: (L,) m along its way from the beginning of lanes[0], the same place.
      signals: (L,) int32, SIGNAL_* bits it always shows.
      from_trigger: (L,) bool, appears and drives at the trigger; else as soon as it is armed.
      delay: (L,) s after the trigger at which a car with `from_trigger` appears; the cars of a
        stream leave their source one after another.
    """

    model: jax.Array
    lanes: jax.Array
    s: jax.Array
    speed: jax.Array
    drive: jax.Array
    travel: jax.Array
    meet_s: jax.Array
    meet_lane_s: jax.Array
    signals: jax.Array
    from_trigger: jax.Array
    delay: jax.Array


class ScriptedOthers(struct.PyTreeNode):
    """Actors off the lanes, F = NUM_OTHERS rows: they stand, then move straight on, then stand.

    Those that there are come first.

    Attributes:
      kind: (F,) int32, KIND_*; KIND_NONE for nobody.
      xy: (F, 2) m, where it stands at first.
      z: (F,) m.
      yaw: (F,) rad.
      length, width: (F,) m.
      speed: (F,) m/s, once it moves; 0 stands for good.
      distance: (F,) m that it moves.
      meet_s: (F,) m on the route, where its way meets the ego's.
      start_time: (F,) s: it starts when the ego would need less than this to `meet_s`.
      start_distance: (F,) m: or when the ego is nearer to it than this.
      signals: (F,) int32, SIGNAL_* and DOOR_* bits it shows from its start on.
    """

    kind: jax.Array
    xy: jax.Array
    z: jax.Array
    yaw: jax.Array
    length: jax.Array
    width: jax.Array
    speed: jax.Array
    distance: jax.Array
    meet_s: jax.Array
    start_time: jax.Array
    start_distance: jax.Array
    signals: jax.Array


class Scenario(struct.PyTreeNode):
    """One scenario on a route (the bank holds (S, E) of them, in order of `arm_s`).

    Attributes:
      kind: () int32, place in `registry.KINDS`; -1 pads.
      arm_s: () m: when the ego comes here its actors take their places, out of sight.
      trigger_s: () m: from here on it plays.
      end_s: () m: it is over when the ego comes here.
      timeout_s: () s after the trigger; later it is over all the same, and held against the ego.
      cars: see `ScriptedCars`.
      others: see `ScriptedOthers`.
      held_junction: () int32, junction whose lights are held from the trigger on; -1 for none.
      held_green: (2,) int32, rows of the light table that are green there; -1 pads.
      brake_s: () s for which the car ahead of the ego brakes hard; 0 for no such thing.
      patches: (NUM_PATCHES, 2) m on the route, first and last of stretches where the ego's control
        is disturbed; equal ends pad.
      steer_noise, throttle_noise: () how much, in units of the action: the half-width of a uniform
        distribution drawn anew for each patch.
    """

    kind: jax.Array
    arm_s: jax.Array
    trigger_s: jax.Array
    end_s: jax.Array
    timeout_s: jax.Array
    cars: ScriptedCars
    others: ScriptedOthers
    held_junction: jax.Array
    held_green: jax.Array
    brake_s: jax.Array
    patches: jax.Array
    steer_noise: jax.Array
    throttle_noise: jax.Array


class ScenarioSlots(struct.PyTreeNode):
    """The scenarios in play, in H fixed slots, and their actors: P rows of cars, Q of others.

    Attributes:
      index: (H,) int32, row of the episode's scenarios; -1 for a free slot.
      is_leaving: (H,) bool, it is over, but some of its actors are still in sight.
      triggered_s: (H,) s since the trigger; negative while armed only.
      cars: (P,) whose the rows of cars are.
      others: (Q,) whose the rows of others are.
      has_appeared: (P,) bool, this car has taken its place.
      has_started: (Q,) bool, this actor moves or has moved.
      moved: (Q,) m it has moved.
      noise: (H, NUM_PATCHES, 2) in [-1, 1], disturbance of steering and throttle on each patch.
      braker: (H,) int32, row of the vehicle that brakes ahead of the ego; -1 before there is one.
      braked_s: (H,) s for which it has.
      next_index: () int32, the next scenario of the route to be armed.
      num_triggered: () int32, scenarios that have begun in this episode.
      ended_kind: () int32, kind of the scenario that was over in this step, -1 for none.
      has_timed_out: () bool, that scenario ended by its timeout.
      has_failed_to_yield: () bool, an emergency vehicle of that scenario was still behind the ego.
    """

    index: jax.Array
    is_leaving: jax.Array
    triggered_s: jax.Array
    cars: Parts
    others: Parts
    has_appeared: jax.Array
    has_started: jax.Array
    moved: jax.Array
    noise: jax.Array
    braker: jax.Array
    braked_s: jax.Array
    next_index: jax.Array
    num_triggered: jax.Array
    ended_kind: jax.Array
    has_timed_out: jax.Array
    has_failed_to_yield: jax.Array

    @property
    def is_armed(self) -> jax.Array:
        """(H,) bool: there, not yet triggered."""
        return (self.index >= 0) & ~self.is_leaving & (self.triggered_s < 0.0)

    @property
    def is_playing(self) -> jax.Array:
        """(H,) bool: from the trigger to the end."""
        return (self.index >= 0) & ~self.is_leaving & (self.triggered_s >= 0.0)


def num_cars(num_slots: int) -> int:
    """Returns P, the rows of cars for so many scenarios in play at once."""
    return NUM_CARS + MORE_CARS * (num_slots - 1) if num_slots else 0


def num_others(num_slots: int) -> int:
    """Returns Q, the rows of others for so many scenarios in play at once."""
    return NUM_OTHERS + MORE_OTHERS * (num_slots - 1) if num_slots else 0


def empty_slots(num_slots: int) -> ScenarioSlots:
    """Slots before the first scenario."""
    cars, others = num_cars(num_slots), num_others(num_slots)
    none = jnp.full((), -1, jnp.int32)
    false = jnp.zeros((), bool)
    return ScenarioSlots(
        index=jnp.full(num_slots, -1, jnp.int32),
        is_leaving=jnp.zeros(num_slots, bool),
        triggered_s=jnp.full(num_slots, -1.0, jnp.float32),
        cars=parts.none(cars),
        others=parts.none(others),
        has_appeared=jnp.zeros(cars, bool),
        has_started=jnp.zeros(others, bool),
        moved=jnp.zeros(others, jnp.float32),
        noise=jnp.zeros((num_slots, NUM_PATCHES, 2), jnp.float32),
        braker=jnp.full(num_slots, -1, jnp.int32),
        braked_s=jnp.zeros(num_slots, jnp.float32),
        next_index=jnp.zeros((), jnp.int32),
        num_triggered=jnp.zeros((), jnp.int32),
        ended_kind=none,
        has_timed_out=false,
        has_failed_to_yield=false,
    )


def nothing(num: int) -> Scenario:
    """`num` rows of no scenario, NumPy, for the host to fill in and to pad with."""

    def full(value: float, *shape: int, dtype: type = np.float32) -> Any:
        return np.full((num, *shape), value, dtype)

    cars, others = NUM_CARS, NUM_OTHERS
    return Scenario(
        kind=full(-1, dtype=np.int32),
        arm_s=full(np.inf),
        trigger_s=full(np.inf),
        end_s=full(np.inf),
        timeout_s=full(np.inf),
        cars=ScriptedCars(
            model=full(-1, cars, dtype=np.int32),
            lanes=full(-1, cars, WAY_LANES, dtype=np.int32),
            s=full(0, cars),
            speed=full(0, cars),
            drive=full(DRIVE_LEGAL, cars, dtype=np.int32),
            travel=full(np.inf, cars),
            meet_s=full(0, cars),
            meet_lane_s=full(0, cars),
            signals=full(0, cars, dtype=np.int32),
            from_trigger=full(False, cars, dtype=bool),
            delay=full(0, cars),
        ),
        others=ScriptedOthers(
            kind=full(0, others, dtype=np.int32),
            xy=full(0, others, 2),
            z=full(0, others),
            yaw=full(0, others),
            length=full(0, others),
            width=full(0, others),
            speed=full(0, others),
            distance=full(0, others),
            meet_s=full(0, others),
            start_time=full(0, others),
            start_distance=full(0, others),
            signals=full(0, others, dtype=np.int32),
        ),
        held_junction=full(-1, dtype=np.int32),
        held_green=full(-1, 2, dtype=np.int32),
        brake_s=full(0),
        patches=full(0, NUM_PATCHES, 2),
        steer_noise=full(0),
        throttle_noise=full(0),
    )
