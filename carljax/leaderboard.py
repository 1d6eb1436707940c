"""An evaluated drive: it goes on after a collision, a red light or a stop sign.

Training ends at every hard infraction; CARLA's leaderboard counts most of them and lets the car
drive on, so that a route's completion and its infractions are two figures. After a collision the
ego stands where it was stopped and whom it struck is taken away: the same contact counts once.
Source: CARLA leaderboard 2.0. Ours: leaving the road ends the route, where the leaderboard has the
car meet a wall or lose its route; and a struck car is gone at once.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from carljax.reward import collision
from carljax.sim.env import DrivingEnv
from carljax.sim.types import KIND_NONE, KIND_PEDESTRIAN, KIND_STATIC, KIND_VEHICLE, State

COLLISIONS = {
    "pedestrian_collision": KIND_PEDESTRIAN,
    "vehicle_collision": KIND_VEHICLE,
    "static_collision": KIND_STATIC,
}
GOES_ON = ("red_light", "stop_sign")
ENDS = ("off_road", "route_deviation", "blocked", "timeout")
INFRACTIONS = (*COLLISIONS, *GOES_ON, *ENDS)
# m/s, below which the ego is not to blame for being struck. source: CARLA leaderboard 2.0
BLAME_SPEED = 0.1


class Drive(struct.PyTreeNode):
    """One drive so far.

    Attributes:
      state: of the environment; `done` marks the end of the route, however it ended.
      counts: {name of INFRACTIONS: () int32}.
      clean_completion: () percent of the route at the first infraction, the present one before it.
    """

    state: State
    counts: dict[str, jax.Array]
    clean_completion: jax.Array


def begin(state: State) -> Drive:
    """A drive from its first state."""
    counts = {name: jnp.zeros((), jnp.int32) for name in INFRACTIONS}
    return Drive(state=state, counts=counts, clean_completion=jnp.zeros((), jnp.float32))


def advance(env: DrivingEnv, drive: Drive, action: jax.Array) -> Drive:
    """Makes one step, without an observation; a drive that has ended stays as it ended.

    Args:
      env: the environment.
      drive: before.
      action: (2,) float32 in [-1, 1].

    Returns:
      The drive after.
    """
    before = drive.state
    moved = env.advance(before, action)
    struck = struck_agents(env, moved)
    counts = {
        name: drive.counts[name] + happened.astype(jnp.int32)
        for name, happened in infractions(before, moved, struck).items()
    }
    was_clean = sum(drive.counts.values()) == 0
    completion = moved.metrics["episode/route_completion"]
    after = Drive(
        state=go_on(moved, struck),
        counts=counts,
        clean_completion=jnp.where(was_clean, completion, drive.clean_completion),
    )
    return jax.tree.map(lambda old, new: jnp.where(before.done > 0, old, new), drive, after)


def struck_agents(env: DrivingEnv, state: State) -> jax.Array:
    """(N,) bool, whom the ego touches."""
    sim = state.pipeline_state
    return collision.touched(sim.ego, sim.agents, env.vehicle, env.reward_config.z_gap)


def infractions(before: State, moved: State, struck: jax.Array) -> dict[str, jax.Array]:
    """What happened in one step, {name of INFRACTIONS: () bool}.

    Args:
      before: the state before the step.
      moved: the state after it.
      struck: (N,) bool, see `struck_agents`.
    """
    kind = moved.pipeline_state.agents.kind
    to_blame = before.pipeline_state.ego.speed >= BLAME_SPEED
    hits = {name: jnp.any(struck & (kind == of)) & to_blame for name, of in COLLISIONS.items()}
    rest = {name: moved.metrics[f"reward/{name}"] > 0 for name in (*GOES_ON, *ENDS)}
    return {**hits, **rest}


def go_on(moved: State, struck: jax.Array) -> State:
    """Halts the ego at a collision and takes the struck away; only `ENDS` and the goal end a route.

    Args:
      moved: the state after a step.
      struck: (N,) bool, see `struck_agents`.

    Returns:
      The state to drive on from.
    """
    ended = moved.metrics["reward/finished"] > 0
    for name in ENDS:
        ended |= moved.metrics[f"reward/{name}"] > 0
    sim = moved.pipeline_state
    hit = jnp.any(struck)
    halted = sim.ego.replace(
        speed=jnp.where(hit, 0.0, sim.ego.speed), yaw_rate=jnp.where(hit, 0.0, sim.ego.yaw_rate)
    )
    agents = sim.agents.replace(kind=jnp.where(struck, KIND_NONE, sim.agents.kind))
    return moved.replace(
        pipeline_state=sim.replace(ego=halted, agents=agents), done=ended.astype(jnp.float32)
    )
