"""Traffic lights as a function of time, and junctions that a scenario holds.

The controllers of a junction are served in turn: each is green, then yellow, then all wait for a
moment of red before the next one. Times are CARLA's defaults for its traffic lights: green 10 s,
yellow 3 s, red 2 s. source: CARLA documentation, traffic light defaults.

A scenario may hold a junction: the lights it names are green, the others red. Nothing jumps: what
was green turns yellow first, then all are red for a moment, and likewise when the hold ends.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.sim.road_map import RoadMap
from carljax.sim.types import LIGHT_GREEN, LIGHT_RED, LIGHT_YELLOW, LightClock

GREEN_S = 10.0
YELLOW_S = 3.0
ALL_RED_S = 2.0
SLOT_S = GREEN_S + YELLOW_S + ALL_RED_S
CLEARING_S = YELLOW_S + ALL_RED_S  # at the beginning and after the end of a hold


def clock(time: jax.Array, num_holds: int) -> LightClock:
    """A clock at which no junction is held."""
    none = jnp.full(num_holds, -1, jnp.int32)
    never = jnp.full(num_holds, -jnp.inf, jnp.float32)
    return LightClock(
        time=time,
        held_junction=none,
        held_green=jnp.full((num_holds, 2), -1, jnp.int32),
        held_from=never,
        held_until=never,
    )


def colour(light: jax.Array, clock: LightClock, road_map: RoadMap) -> jax.Array:
    """What lights show now.

    Args:
      light: (...) int32, rows of the light table.
      clock: time and holds.
      road_map: the map.

    Returns:
      (...) int32 LIGHT_*.
    """
    shown = state(clock.time, road_map.light_start[light], road_map.light_cycle[light])
    for hold in range(clock.held_junction.shape[0]):
        is_held, held, _ = _hold(light, clock, hold, road_map)
        shown = jnp.where(is_held, held, shown)
    return shown


def yellow_left_of(light: jax.Array, clock: LightClock, road_map: RoadMap) -> jax.Array:
    """(...) float32, s of yellow that remain; see `colour` and `yellow_left`."""
    left = yellow_left(clock.time, road_map.light_start[light], road_map.light_cycle[light])
    for hold in range(clock.held_junction.shape[0]):
        is_held, _, held_left = _hold(light, clock, hold, road_map)
        left = jnp.where(is_held, held_left, left)
    return left


def _hold(
    light: jax.Array, clock: LightClock, hold: int, road_map: RoadMap
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Whether a hold governs each light, what it shows then, and the seconds of yellow left."""
    begin, end = clock.held_from[hold], clock.held_until[hold]
    since, after = clock.time - begin, clock.time - end
    junction = road_map.light_junction[light]
    is_held = (junction == clock.held_junction[hold]) & (junction >= 0)
    is_held &= (since >= 0.0) & (after < CLEARING_S)
    before = state(begin, road_map.light_start[light], road_map.light_cycle[light])
    is_named = (light[..., None] == clock.held_green[hold]).any(axis=-1)
    keeps_green = is_named & ((before == LIGHT_GREEN) | (since >= CLEARING_S))
    turns_yellow = ~is_named & (before != LIGHT_RED) & (since < YELLOW_S)
    turns_yellow |= is_named & (before == LIGHT_YELLOW) & (since < YELLOW_S)
    held = jnp.where(keeps_green, LIGHT_GREEN, jnp.where(turns_yellow, LIGHT_YELLOW, LIGHT_RED))
    ending = jnp.where(is_named & (after < YELLOW_S), LIGHT_YELLOW, LIGHT_RED)
    shown = jnp.where(after >= 0.0, ending, held)
    left = jnp.clip(YELLOW_S - jnp.where(after >= 0.0, after, since), 0.0, YELLOW_S)
    return is_held, shown, left


def state(time: jax.Array, start: jax.Array, cycle: jax.Array) -> jax.Array:
    """The colour of a light.

    Args:
      time: s, the town's light clock.
      start: s, when within the cycle the light turns green.
      cycle: s, period of its junction's programme.

    Returns:
      int32 LIGHT_*, of the broadcast shape of the arguments.
    """
    since = _since_green(time, start, cycle)
    colour = jnp.where(since < GREEN_S + YELLOW_S, LIGHT_YELLOW, LIGHT_RED)
    return jnp.where(since < GREEN_S, LIGHT_GREEN, colour).astype(jnp.int32)


def yellow_left(time: jax.Array, start: jax.Array, cycle: jax.Array) -> jax.Array:
    """Seconds of yellow that remain, YELLOW_S before it begins, 0 after.

    Args:
      time: as for `state`.
      start: as for `state`.
      cycle: as for `state`.

    Returns:
      float32 in [0, YELLOW_S].
    """
    since = _since_green(time, start, cycle)
    return jnp.clip(GREEN_S + YELLOW_S - since, 0.0, YELLOW_S)


def _since_green(time: jax.Array, start: jax.Array, cycle: jax.Array) -> jax.Array:
    """Seconds of the cycle; no remainder, which is a call for each number on a CPU."""
    since = time - start
    return since - cycle * jnp.floor(since / cycle)
