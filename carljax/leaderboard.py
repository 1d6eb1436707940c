"""An evaluated drive: what counts against the car, what ends its route, by CARLA leaderboard 2.0.

Training ends at every hard infraction; the leaderboard counts most of them and lets the car drive
on, so that a route's completion and its infractions are two figures. Its limits hold whatever the
policy was trained with (`RULES`). Ours: leaving the road ends the route, where CARLA has walls and
kerbs; and what follows a collision (`aftermath`). `scores` makes a score of a drive.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from carljax import aftermath, event_log, min_speed
from carljax.aftermath import Aftermath
from carljax.event_log import EventLog
from carljax.min_speed import MinSpeed
from carljax.reward import blocked, collision
from carljax.reward.config import RewardConfig
from carljax.sim import population
from carljax.sim.env import DrivingEnv
from carljax.sim.types import KIND_PEDESTRIAN, KIND_STATIC, KIND_VEHICLE, SimState, State

COLLISIONS = {
    "pedestrian_collision": KIND_PEDESTRIAN,
    "vehicle_collision": KIND_VEHICLE,
    "static_collision": KIND_STATIC,
}
GOES_ON = ("red_light", "stop_sign")
OF_SCENARIOS = ("scenario_timeout", "failed_to_yield")
ENDS = ("off_road", "route_deviation", "blocked", "timeout")
# What happens at a moment. Speed and lanes are measured over the route instead.
EVENTS = (*COLLISIONS, *GOES_ON, *OF_SCENARIOS, *ENDS)
# What ends an episode of training.
HARD = (*COLLISIONS, *GOES_ON, *ENDS)

# The rules: where the ego is off its lanes, runs a light, has lost its route. The CaRL reward looks
# at just that, with the leaderboard's numbers by default; a policy may have been trained with
# another.
RULES = RewardConfig(name="carl")
BLOCKED_S = 180.0  # s. source: CARLA leaderboard 2.0
BLOCKED_SPEED = 0.1  # m/s. source: CARLA leaderboard 2.0
# The route's time: so much, and for every metre that at this fraction of the speed limit.
# source: CARLA leaderboard 2.0
TIME_S, TIME_SPEED_FRAC = 300.0, 0.1
# A route is finished past this completion and this near its goal. source: CARLA leaderboard 2.0
GOAL_PERCENT, GOAL_DISTANCE = 99.0, 10.0


class Drive(struct.PyTreeNode):
    """One drive so far.

    Attributes:
      state: of the environment; `done` marks the end of the route, however it ended.
      aftermath: of collisions.
      min_speed: the ego's speed against the traffic's.
      log: the events with their places; kinds are places in `EVENTS`.
      counts: {name of EVENTS: () int32}.
      completion: () percent of the route, 100 once it is finished.
      clean_completion: () percent of the route at the first infraction of `HARD`, the present one
        before it.
      driven_m: () m, driven by the ego.
      outside_m: () m of the route that it passed outside lanes.
      stopped_s: () s it has stood without a break.
      time_limit_s: () s, the route's time so far.
    """

    state: State
    aftermath: Aftermath
    min_speed: MinSpeed
    log: EventLog
    counts: dict[str, jax.Array]
    completion: jax.Array
    clean_completion: jax.Array
    driven_m: jax.Array
    outside_m: jax.Array
    stopped_s: jax.Array
    time_limit_s: jax.Array


def start(env: DrivingEnv, episode: jax.Array, key: jax.Array) -> State:
    """The first state of an episode under the rules, without an observation.

    Args:
      env: the environment; its reward does not matter.
      episode: () int32, row of its bank.
      key: PRNG key of what the episode leaves open.
    """
    return env.replace(reward_config=RULES).start_episode(episode, key)


def begin(state: State) -> Drive:
    """A drive from its first state, which is one of `start`."""
    zero = jnp.zeros((), jnp.float32)
    return Drive(
        state=state,
        aftermath=aftermath.nothing(state.pipeline_state.agents.kind.shape[0]),
        min_speed=min_speed.start(),
        log=event_log.empty(),
        counts={name: jnp.zeros((), jnp.int32) for name in EVENTS},
        completion=zero,
        clean_completion=zero,
        driven_m=zero,
        outside_m=zero,
        stopped_s=zero,
        time_limit_s=jnp.full((), TIME_S, jnp.float32),
    )


def advance(env: DrivingEnv, drive: Drive, action: jax.Array) -> Drive:
    """Makes one step, without an observation; a drive that has ended stays as it ended.

    Args:
      env: the environment; its reward does not matter.
      drive: before.
      action: (2,) float32 in [-1, 1].

    Returns:
      The drive after.
    """
    before, dt = drive.state, env.config.dt
    env = env.replace(reward_config=RULES)
    moved = env.advance(before, aftermath.possible_action(drive.aftermath, action))
    remains, moved, struck = _collide(env, drive, moved)
    sim = moved.pipeline_state
    old_s, route_s, limit = _progress(env, before.pipeline_state, sim)
    after = drive.replace(
        state=moved,
        aftermath=remains,
        driven_m=drive.driven_m + 0.5 * (before.pipeline_state.ego.speed + sim.ego.speed) * dt,
        outside_m=drive.outside_m
        + jnp.where(moved.metrics["reward/outside_lanes"] < 1.0, route_s - old_s, 0.0),
        stopped_s=blocked.standing_time(drive.stopped_s, sim.ego.speed, BLOCKED_SPEED, dt),
        time_limit_s=drive.time_limit_s + (route_s - old_s) / (TIME_SPEED_FRAC * limit),
        min_speed=_measure_speed(env, drive.min_speed, sim, route_s),
    )
    after = _conclude(env, after, route_s, struck)
    return jax.tree.map(lambda old, new: jnp.where(before.done > 0, old, new), drive, after)


def _collide(env: DrivingEnv, drive: Drive, moved: State) -> tuple[Aftermath, State, jax.Array]:
    """The aftermath, the state with all who are struck halted, and whose collision is charged."""
    before, sim = drive.state.pipeline_state, moved.pipeline_state
    remains, agents = aftermath.settle(drive.aftermath, before.agents, sim.agents, env.config.dt)
    touched = collision.touched(sim.ego, agents, env.vehicle, RULES.z_gap)
    moved = moved.replace(pipeline_state=sim.replace(agents=agents))
    return aftermath.strike(remains, before.ego.speed, moved, touched)


def _progress(
    env: DrivingEnv, before: SimState, after: SimState
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Progress on the route before and after a step, m, and the speed limit there, m/s."""
    routes, episode = env.bank.routes, after.episode_idx
    limit = routes.speed_limit[episode, after.route_idx]
    return routes.s[episode, before.route_idx], routes.s[episode, after.route_idx], limit


def _measure_speed(
    env: DrivingEnv, measured: MinSpeed, sim: SimState, route_s: jax.Array
) -> MinSpeed:
    traffic = population.rows(sim.agents, env.config.population.traffic)
    length = env.bank.routes.length[sim.episode_idx]
    return min_speed.update(measured, sim.ego, traffic, route_s, length)


def _conclude(env: DrivingEnv, drive: Drive, route_s: jax.Array, struck: jax.Array) -> Drive:
    """Notes what happened in a step and whether the route has ended with it.

    Args:
      env: the environment.
      drive: after the step.
      route_s: () m, progress on the route.
      struck: () int32, row of the agent whose collision is charged, -1 for none.

    Returns:
      The drive with its counts, its log and its end.
    """
    state, sim = drive.state, drive.state.pipeline_state
    length = env.bank.routes.length[sim.episode_idx]
    completion = 100.0 * route_s / length
    finished = (completion > GOAL_PERCENT) & (_goal_distance(env, sim) < GOAL_DISTANCE)
    happened = infractions(drive, struck, env.config.dt)
    ended = finished
    for name in ENDS:
        happened[name] &= ~finished
        ended |= happened[name]
    completion = jnp.where(finished, 100.0, completion)
    was_clean = sum(drive.counts[name] for name in HARD) == 0
    whom = [struck if name in COLLISIONS else jnp.full((), -1, jnp.int32) for name in EVENTS]
    return drive.replace(
        state=state.replace(done=ended.astype(jnp.float32)),
        counts={name: drive.counts[name] + happened[name].astype(jnp.int32) for name in EVENTS},
        log=event_log.append(
            drive.log,
            jnp.stack([happened[name] for name in EVENTS]),
            jnp.append(sim.ego.xy, sim.ego.z),
            sim.step_count,
            jnp.stack(whom),
        ),
        completion=completion,
        clean_completion=jnp.where(was_clean, completion, drive.clean_completion),
        min_speed=min_speed.finish_where(ended, drive.min_speed, route_s, length),
    )


def infractions(drive: Drive, struck: jax.Array, dt: float) -> dict[str, jax.Array]:
    """What happened in the step that led to a drive, {name of EVENTS: () bool}.

    Args:
      drive: after the step.
      struck: () int32, row of the agent whose collision is charged, -1 for none.
      dt: s.
    """
    metrics, sim = drive.state.metrics, drive.state.pipeline_state
    kind = sim.agents.kind[jnp.maximum(struck, 0)]
    return {
        **{name: (struck >= 0) & (kind == of) for name, of in COLLISIONS.items()},
        **{name: metrics[f"reward/{name}"] > 0 for name in (*GOES_ON, "off_road")},
        "scenario_timeout": sim.scenarios.has_timed_out,
        "failed_to_yield": sim.scenarios.has_failed_to_yield,
        "route_deviation": metrics["reward/route_deviation"] > 0,
        "blocked": blocked.is_blocked(drive.stopped_s, BLOCKED_S, dt),
        "timeout": sim.step_count.astype(jnp.float32) * dt > drive.time_limit_s + 0.5 * dt,
    }


def _goal_distance(env: DrivingEnv, sim: SimState) -> jax.Array:
    """() m, from the ego to the last point of its route."""
    routes = env.bank.routes
    goal = routes.xy[sim.episode_idx, routes.num_points[sim.episode_idx] - 1]
    return jnp.sqrt(((sim.ego.xy - goal) ** 2).sum())
