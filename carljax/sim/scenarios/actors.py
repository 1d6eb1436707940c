"""The actors of scenarios: cars that drive on lanes, and others that stand and move straight on.

Traffic moves the cars, as all that is on lanes; here they are told how to drive, take their places
and are taken away. Which rows are whose, `parts` says.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from carljax.sim import geometry, vehicles
from carljax.sim.population import Population
from carljax.sim.respawn import VIEW_BACK, VIEW_FRONT, VIEW_SIDE
from carljax.sim.right_of_way import EgoPlace
from carljax.sim.road_map import Pose, RoadMap, pose_at
from carljax.sim.scenarios.script import (
    DRIVE_FLOW,
    DRIVE_LEGAL,
    DRIVE_MEET,
    ScriptedCars,
    ScriptedOthers,
)
from carljax.sim.types import KIND_NONE, KIND_VEHICLE, Agents, EgoState

CAR_GAP = 9.0  # m kept free before and behind a car that takes its place. source: as for respawn
OTHER_GAP = 0.5  # m kept free around those off the lanes. source: ours, they only have to fit
ETA_SPEED_MIN = 0.5  # m/s, an ego at rest is taken to be about to go. source: ours
MEET_FRAC = (0.5, 1.5)  # of its own speed, within which a car times itself. source: ours
COMMIT_S = 2.0  # s before the meeting from which it holds its speed. source: ours


class Scene(struct.PyTreeNode):
    """What the actors find around them.

    Attributes:
      ego: the ego.
      ego_length: () m.
      ego_place: its place on the lane graph.
      route_s: () m, where on its route it is.
      road_map: the map.
      is_start: the episode is about to begin: nobody sees yet who appears; static.
      rows: which rows of the agents are whose; static.
    """

    ego: EgoState
    ego_length: jax.Array
    ego_place: EgoPlace
    route_s: jax.Array
    road_map: RoadMap
    is_start: bool = struct.field(pytree_node=False)
    rows: Population = struct.field(pytree_node=False)


class Cues(struct.PyTreeNode):
    """What the actors go by, one row an actor.

    Attributes:
      is_active: bool, its scenario is armed or plays.
      triggered_s: s since its trigger, negative before.
    """

    is_active: jax.Array
    triggered_s: jax.Array


def is_hidden(xy: jax.Array, scene: Scene) -> jax.Array:
    """Bool of xy's leading shape: outside of what the ego sees."""
    seen = geometry.to_frame(xy, scene.ego.xy, scene.ego.yaw)
    ahead, left = seen[..., 0], seen[..., 1]
    return (ahead > VIEW_FRONT) | (ahead < -VIEW_BACK) | (jnp.abs(left) > VIEW_SIDE)


def may_appear(
    xy: jax.Array, length: jax.Array, gap: float, agents: Agents, scene: Scene
) -> jax.Array:
    """Whether each place is out of sight and nobody is in it.

    Args:
      xy: (n, 2) m.
      length: (n,) m, of whoever would stand there.
      gap: m to keep free around it.
      agents: (N,) whoever may be in the way.
      scene: see `Scene`.

    Returns:
      (n,) bool.
    """
    apart = geometry.squared_distance(agents.xy[None], xy[:, None])
    needed = 0.5 * (agents.length[None] + length[:, None]) + gap
    clear = (~agents.valid[None] | (apart > needed**2)).all(axis=1)
    from_ego = geometry.squared_distance(scene.ego.xy, xy)
    clear &= from_ego > (0.5 * (length + scene.ego_length) + gap) ** 2
    return clear & (scene.is_start | is_hidden(xy, scene))


def car_length(script: ScriptedCars) -> jax.Array:
    """(n,) m."""
    return vehicles.typical_size(jnp.maximum(script.model, 0))[0]


def car_start(script: ScriptedCars, road_map: RoadMap) -> Pose:
    """Where cars start."""
    return pose_at(road_map, jnp.maximum(script.lanes[..., 0], 0), script.s)


def way(cars: Agents, script: ScriptedCars, road_map: RoadMap) -> jax.Array:
    """(n,) m that cars have come along their ways, from the beginning of lanes[0]; inf beyond."""
    length = road_map.lane_length[jnp.maximum(script.lanes[:, :-1], 0)]
    begin = jnp.pad(jnp.cumsum(length, axis=1), ((0, 0), (1, 0)))  # (n, WAY_LANES)
    here = (cars.lanes[:, :1] == script.lanes) & (script.lanes >= 0)
    came = jnp.where(here, begin + cars.lane_s[:, None], jnp.inf)
    return came.min(axis=1)


def way_on(cars: Agents, script: ScriptedCars) -> jax.Array:
    """(n, 3) int32, plans that follow the cars' ways as far as these go."""
    here = (cars.lanes[:, :1] == script.lanes) & (script.lanes >= 0)
    known = jnp.pad(script.lanes, ((0, 0), (0, 2)), constant_values=-1)
    at = jnp.argmax(here, axis=1)[:, None] + jnp.arange(1, 3)
    following = jnp.take_along_axis(known, at, axis=1)
    is_known = here.any(axis=1, keepdims=True) & (following >= 0)
    onward = jnp.where(is_known, following, cars.lanes[:, 1:])
    return jnp.concatenate([cars.lanes[:, :1], onward], axis=1)


def waiting(
    cars: Agents, has_appeared: jax.Array, script: ScriptedCars, cues: Cues, came: jax.Array
) -> jax.Array:
    """(n,) bool: cars that are to start now, for the first time or, in a flow, again.

    Args:
      cars: (n,) their rows.
      has_appeared: (n,) bool.
      script: (n,).
      cues: (n,).
      came: (n,) m, see `way`.
    """
    due = ~script.from_trigger | (cues.triggered_s >= script.delay)
    again = (script.drive == DRIVE_FLOW) & (~cars.valid | (came >= script.travel))
    return (script.model >= 0) & cues.is_active & due & (~has_appeared | again)


def one_at_a_time(xy: jax.Array, starts: jax.Array) -> jax.Array:
    """(n,) bool: of those who would start at the same place the first only.

    Args:
      xy: (n, 2) m, where they start.
      starts: (n,) bool.
    """
    near = geometry.squared_distance(xy[:, None], xy) < CAR_GAP**2
    earlier = jnp.tri(len(starts), k=-1, dtype=bool)  # [i, j]: j comes before i
    return starts & ~(near & earlier & starts[None]).any(axis=1)


def put_cars(
    cars: Agents, starts: jax.Array, script: ScriptedCars, start: Pose, road_map: RoadMap
) -> Agents:
    """Puts cars at the beginning of their ways.

    Args:
      cars: (n,) their rows.
      starts: (n,) bool, who.
      script: (n,).
      start: (n,) see `car_start`.
      road_map: the map.
    """
    lane = jnp.maximum(script.lanes[:, 0], 0)
    limit = jnp.minimum(road_map.lane_speed_limit[lane], road_map.lane_curve_speed[lane])
    length, width = vehicles.typical_size(jnp.maximum(script.model, 0))
    zero = jnp.zeros_like(cars.speed)
    fresh = cars.replace(
        xy=start.xy,
        z=start.z,
        yaw=start.yaw,
        speed=jnp.where(script.speed > 0.0, script.speed, limit),
        yaw_rate=zero,
        accel=zero,
        length=length,
        width=width,
        kind=jnp.full_like(cars.kind, KIND_VEHICLE),
        model=script.model,
        lanes=script.lanes[:, :3],
        past_lane=jnp.full_like(cars.past_lane, -1),
        lane_s=script.s,
        desired_speed_frac=jnp.ones_like(zero),
        has_stopped=jnp.zeros_like(starts),
        wait_s=zero,
        lateral=zero,
        from_lane=jnp.full_like(cars.from_lane, -1),
        cruise_speed=script.speed,
        signals=script.signals,
    )
    return choose(starts, fresh, cars)


def command_cars(
    cars: Agents,
    script: ScriptedCars,
    cues: Cues,
    came: jax.Array,
    scene: Scene,
) -> Agents:
    """Tells cars how to drive; those whose scenario is over drive as everybody does.

    Args:
      cars: (n,) their rows.
      script: (n,).
      cues: (n,).
      came: (n,) m, see `way`.
      scene: see `Scene`.
    """
    plays = cues.is_active & cars.valid
    plays &= (script.drive != DRIVE_FLOW) | (came < script.travel)
    left = script.meet_lane_s - came
    eta = time_to(script.meet_s, scene)
    low, high = (frac * script.speed for frac in MEET_FRAC)
    timed = jnp.clip(left / jnp.maximum(eta, 0.1), low, high)
    adapts = (script.drive == DRIVE_MEET) & (left > COMMIT_S * script.speed) & (eta > 0.0)
    own = jnp.where(script.drive == DRIVE_MEET, cars.cruise_speed, script.speed)
    return cars.replace(
        lanes=jnp.where(plays[:, None], way_on(cars, script), cars.lanes),
        cruise_speed=jnp.where(plays, jnp.where(adapts, timed, own), 0.0),
        is_lawless=plays & (script.drive != DRIVE_LEGAL),
        signals=jnp.where(cars.valid, cars.signals | script.signals, 0),
    )


def time_to(meet_s: jax.Array, scene: Scene) -> jax.Array:
    """Seconds that the ego needs to places on its route, at its present speed."""
    return (meet_s - scene.route_s) / jnp.maximum(scene.ego.speed, ETA_SPEED_MIN)


def put_others(others: Agents, appears: jax.Array, script: ScriptedOthers) -> Agents:
    """Puts those off the lanes where they stand at first; rows of nobody become empty."""
    zero = jnp.zeros_like(others.speed)
    fresh = others.replace(
        xy=script.xy,
        z=script.z,
        yaw=script.yaw,
        speed=zero,
        yaw_rate=zero,
        accel=zero,
        length=script.length,
        width=script.width,
        kind=script.kind,
        signals=jnp.zeros_like(others.signals),
    )
    return choose(appears, fresh, others)


def starts_moving(script: ScriptedOthers, cues: Cues, scene: Scene) -> jax.Array:
    """(n,) bool: the ego has come near enough, in time or in space."""
    plays = cues.is_active & (cues.triggered_s >= 0.0) & (script.kind != KIND_NONE)
    soon = time_to(script.meet_s, scene) < script.start_time
    near = script.meet_s - scene.route_s < script.start_distance
    return plays & (soon | near)


def move_others(
    others: Agents, script: ScriptedOthers, has_started: jax.Array, moved: jax.Array, dt: float
) -> tuple[Agents, jax.Array]:
    """Moves those off the lanes straight on.

    Args:
      others: (n,) their rows.
      script: (n,).
      has_started: (n,) bool.
      moved: (n,) m so far.
      dt: s.

    Returns:
      The rows, and m moved.
    """
    moving = has_started & (moved < script.distance) & others.valid
    speed = jnp.where(moving, script.speed, 0.0)
    moved = jnp.minimum(moved + speed * dt, script.distance)
    along = jnp.stack([jnp.cos(script.yaw), jnp.sin(script.yaw)], axis=-1)
    xy = script.xy + moved[:, None] * along
    others = others.replace(
        xy=jnp.where(moving[:, None], xy, others.xy),
        speed=speed,
        signals=jnp.where(has_started & others.valid, script.signals, 0),
    )
    return others, moved


def take_away(agents: Agents, who: jax.Array) -> Agents:
    """Rows without some of them."""
    return agents.replace(
        kind=jnp.where(who, KIND_NONE, agents.kind),
        speed=jnp.where(who, 0.0, agents.speed),
        is_lawless=agents.is_lawless & ~who,
        cruise_speed=jnp.where(who, 0.0, agents.cruise_speed),
    )


def choose(who: jax.Array, fresh: Agents, old: Agents) -> Agents:
    """(n,) rows of one or the other."""
    return jax.tree.map(
        lambda a, b: jnp.where(who.reshape(who.shape + (1,) * (b.ndim - 1)), a.astype(b.dtype), b),
        fresh,
        old,
    )
