"""After an impact: the ego is stopped, whom it struck stays a moment and is then taken away.

CARLA's physics stop both cars and leave them where they are. Here bodies do not push each other, so
the wreck would bar the way for good: that it goes after `STAY` is ours. Which contacts are charged
is CARLA leaderboard 2.0's rule: one body counts once, one place counts once, and what runs into a
standing ego does not count.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from carljax.sim.types import (
    KIND_NONE,
    KIND_PEDESTRIAN,
    KIND_STATIC,
    KIND_VEHICLE,
    Agents,
    EgoState,
    State,
)

STAY = 3.0  # s. source: ours, long enough for cars behind to be seen to halt
# m, as long as the ego is no farther from the last charged collision, no other is charged.
# source: CARLA leaderboard 2.0, which also lets a body count once in 5 s: here it is gone by then
SAME_PLACE = 5.0
# m/s, below which the ego is not to blame for being struck. source: CARLA leaderboard 2.0
BLAME_SPEED = 0.1
# If several are struck in one step, one counts: the gravest. source: ours, CARLA takes the first
GRAVITY = (KIND_PEDESTRIAN, KIND_VEHICLE, KIND_STATIC)
FORGOTTEN = 1e6  # m, place of no collision


class Aftermath(struct.PyTreeNode):
    """What remains of collisions.

    Attributes:
      struck_s: (N,) s since the ego touched this row's body; negative where it did not.
      ego_stays_s: () s for which the ego is still held.
      charged_xy: (2,) m, where the ego was in the collision charged last; far away once it has
        left that place.
    """

    struck_s: jax.Array
    ego_stays_s: jax.Array
    charged_xy: jax.Array


def nothing(num_agents: int) -> Aftermath:
    """Before the first collision."""
    return Aftermath(
        struck_s=jnp.full(num_agents, -1.0, jnp.float32),
        ego_stays_s=jnp.zeros((), jnp.float32),
        charged_xy=jnp.full(2, FORGOTTEN, jnp.float32),
    )


def possible_action(aftermath: Aftermath, action: jax.Array) -> jax.Array:
    """(2,) the action, or full brake while the ego is held."""
    brake = jnp.array([0.0, -1.0], jnp.float32)
    return jnp.where(aftermath.ego_stays_s > 0.0, brake, action)


def settle(
    aftermath: Aftermath, before: Agents, moved: Agents, dt: float
) -> tuple[Aftermath, Agents]:
    """Keeps the struck where they are for a moment, then takes them away.

    Args:
      aftermath: up to the step before.
      before: (N,) agents before the step.
      moved: the same after the simulator's step, which knows nothing of collisions.
      dt: s.

    Returns:
      The aftermath dt later, without rows that the simulator has given to somebody else since, and
      the agents.
    """
    is_new = ~before.valid & moved.valid
    struck = (aftermath.struck_s >= 0.0) & ~is_new
    struck_s = jnp.where(struck, aftermath.struck_s + dt, -1.0)
    stays = struck & (struck_s < STAY - 0.5 * dt)

    def hold(old: jax.Array, new: jax.Array) -> jax.Array:
        return jnp.where(stays.reshape(-1, *[1] * (old.ndim - 1)), old, new)

    agents = jax.tree.map(hold, before, moved)
    agents = agents.replace(kind=jnp.where(struck & ~stays, KIND_NONE, agents.kind))
    ego_stays_s = aftermath.ego_stays_s - dt
    return aftermath.replace(
        struck_s=struck_s,
        ego_stays_s=jnp.where(ego_stays_s > 0.5 * dt, ego_stays_s, 0.0),
    ), agents


def strike(
    aftermath: Aftermath, speed: jax.Array, state: State, touched: jax.Array
) -> tuple[Aftermath, State, jax.Array]:
    """Stops the ego and whom it has just touched, and says what is charged.

    Args:
      aftermath: of this step, from `settle`.
      speed: () m/s, the ego's before the step.
      state: after the step.
      touched: (N,) bool, whom the ego touches.

    Returns:
      The aftermath and the state with the impact in them; row of the agent whose collision is
      charged to the ego, () int32, -1 for none.
    """
    sim = state.pipeline_state
    new = touched & (aftermath.struck_s < 0.0)
    is_hit = new.any()
    left = ((sim.ego.xy - aftermath.charged_xy) ** 2).sum() > SAME_PLACE**2
    place = jnp.where(left, FORGOTTEN, aftermath.charged_xy)
    charged = is_hit & (speed >= BLAME_SPEED) & left
    after = aftermath.replace(
        struck_s=jnp.where(new, 0.0, aftermath.struck_s),
        ego_stays_s=jnp.where(is_hit, STAY, aftermath.ego_stays_s),
        charged_xy=jnp.where(charged, sim.ego.xy, place),
    )
    agents = sim.agents.replace(
        speed=jnp.where(new, 0.0, sim.agents.speed),
        yaw_rate=jnp.where(new, 0.0, sim.agents.yaw_rate),
        accel=jnp.where(new, 0.0, sim.agents.accel),
    )
    stopped = sim.replace(ego=_stop(sim.ego, is_hit), agents=agents)
    whom = jnp.where(charged, _gravest(new, agents), -1)
    return after, state.replace(pipeline_state=stopped), whom


def _gravest(touched: jax.Array, agents: Agents) -> jax.Array:
    """() int32, row of the gravest among the touched, of whom there is one."""
    rank = jnp.zeros(agents.kind.shape, jnp.int32)
    for place, kind in enumerate(reversed(GRAVITY), start=1):
        rank = jnp.where(touched & (agents.kind == kind), place, rank)
    return jnp.argmax(rank).astype(jnp.int32)


def _stop(ego: EgoState, is_hit: jax.Array) -> EgoState:
    return ego.replace(
        speed=jnp.where(is_hit, 0.0, ego.speed), yaw_rate=jnp.where(is_hit, 0.0, ego.yaw_rate)
    )
