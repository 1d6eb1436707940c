"""The structs of the simulator: frozen pytrees, unbatched; `vmap` adds batch axes in front.

Axes: T time, B environments, N agents, M towns, K lanes, P lane points, S episodes of a bank, R
route points, Q stop lines of a route, G speed signs of a route, E scenarios of a route, D history
steps. SI units and radians; float32 where no dtype is written. Frames are right-handed: x east,
y north, yaw counter-clockwise in [-pi, pi).
"""

from __future__ import annotations

from typing import Any

import jax
from flax import struct

from carljax.sim.scenarios.script import ScenarioSlots

KIND_NONE, KIND_VEHICLE, KIND_PEDESTRIAN, KIND_STATIC = 0, 1, 2, 3
STOP_NONE, STOP_LIGHT, STOP_SIGN, STOP_YIELD = 0, 1, 2, 3
LIGHT_GREEN, LIGHT_YELLOW, LIGHT_RED = 0, 1, 2

# Bits of `Agents.signals`: what a vehicle shows.
SIGNAL_LEFT, SIGNAL_RIGHT, SIGNAL_BRAKE, SIGNAL_EMERGENCY = 1, 2, 4, 8
DOOR_FRONT_LEFT, DOOR_FRONT_RIGHT, DOOR_REAR_LEFT, DOOR_REAR_RIGHT = 16, 32, 64, 128

# A stop sign holds on the lane's last metres before its line; to halt is to halt with the box of
# the ego over that strip. source: ours; CARLA's trigger boxes are as wide as the lane and a few
# metres long.
STOP_BOX_LENGTH = 3.0


class EgoState(struct.PyTreeNode):
    """The ego vehicle; its reference point is the centre of its box.

    Attributes:
      xy: (2,) m.
      z: () m, height of the lane it is on.
      yaw: () rad.
      speed: () m/s, along the direction of motion, never negative.
      slip: () rad, direction of motion minus yaw.
      yaw_rate: () rad/s.
      accel: () m/s^2, along the direction of motion over the last step.
      steer: () in [-1, 1], last applied; positive turns left.
      throttle: () in [0, 1], last applied.
      brake: () in [0, 1], last applied.
    """

    xy: jax.Array
    z: jax.Array
    yaw: jax.Array
    speed: jax.Array
    slip: jax.Array
    yaw_rate: jax.Array
    accel: jax.Array
    steer: jax.Array
    throttle: jax.Array
    brake: jax.Array


class Agents(struct.PyTreeNode):
    """The other road users, one row each; `population` says which rows are whose.

    Attributes:
      xy: (N, 2) m, box centre.
      z: (N,) m.
      yaw: (N,) rad.
      speed: (N,) m/s.
      yaw_rate: (N,) rad/s.
      accel: (N,) m/s^2 over the last step.
      length, width: (N,) m.
      kind: (N,) int32, KIND_NONE marks an empty row.
      model: (N,) int32, row in the table of vehicle classes (`vehicles`); 0 for others.
      signals: (N,) int32, SIGNAL_* and DOOR_* bits.
      lanes: (N, 3) int32, the lane it is on and the two it will take next; -1 past a dead end.
      lane_s: (N,) m, arc length on lanes[:, 0].
      past_lane: (N,) int32, the lane it was on before, -1 if unknown: its tail may still be there.
      desired_speed_frac: (N,) this driver's free speed as a fraction of the limit.
      has_stopped: (N,) bool, has come to rest at the stop sign, or at the green light, ahead.
      wait_s: (N,) s since it came to rest, until it drives on.
      lateral: (N,) m, offset from the lane's centre, positive to its left; a lane change brings it
        to 0.
      from_lane: (N,) int32, the lane that it still leaves during a lane change, else -1.
      from_s: (N,) m, arc length on that lane.
      cruise_speed: (N,) m/s, free speed that a scenario asks for; 0 leaves it to limit and temper.
      is_lawless: (N,) bool, a scenario's driver, who minds neither lights, signs, right of way nor
        whoever crosses its way, only who is or comes ahead in its lane, be it the ego.
      is_braking_hard: (N,) bool, a scenario makes it brake to a halt.
    """

    xy: jax.Array
    z: jax.Array
    yaw: jax.Array
    speed: jax.Array
    yaw_rate: jax.Array
    accel: jax.Array
    length: jax.Array
    width: jax.Array
    kind: jax.Array
    model: jax.Array
    signals: jax.Array
    lanes: jax.Array
    lane_s: jax.Array
    past_lane: jax.Array
    desired_speed_frac: jax.Array
    has_stopped: jax.Array
    wait_s: jax.Array
    lateral: jax.Array
    from_lane: jax.Array
    from_s: jax.Array
    cruise_speed: jax.Array
    is_lawless: jax.Array
    is_braking_hard: jax.Array

    @property
    def valid(self) -> jax.Array:
        """(N,) bool, slots in use."""
        return self.kind != KIND_NONE


class Others(struct.PyTreeNode):
    """Where the others are on road and route.

    Attributes:
      on_road: (N,) bool, their centre is on road, parking lane or shoulder.
      route_gap: (N,) m along the route from the ego's centre to theirs; infinity where they are not
        on the stretch ahead.
    """

    on_road: jax.Array
    route_gap: jax.Array


class Situation(struct.PyTreeNode):
    """Where the ego is on road and route after a step, looked up once for all who ask.

    Attributes:
      lane_lateral: () m, offset from the nearest driving lane's centre, positive to its left.
      lane_yaw: () rad, direction of travel of that lane at its nearest point.
      lane_width: () m, its width there.
      lane_z: () m, its height there.
      lane_in_junction: () bool.
      on_parking: () bool, ego centre is on a parking lane.
      off_road_frac: () fraction of the ego's footprint on neither road, parking nor shoulder.
      corner_off_road: (4,) bool, corners of its box on neither road nor parking lane.
      route_idx: () int32, last passed route point.
      route_s: () m, arc length of that point.
      route_length: () m.
      route_num_points: () int32.
      route_distance: () m, to the nearest of the current and next five route points.
      route_lateral: () m, offset from the route at that point, positive to its left.
      route_yaw: () rad, the route's direction there.
      speed_limit: () m/s in force.
      stop_s: (Q,) m, arc length of each stop line on the route.
      stop_xy: (Q, 2) m, centre of each stop line on the route.
      stop_yaw: (Q,) rad, direction of travel across it.
      stop_width: (Q,) m, lane width there.
      stop_kind: (Q,) int32, STOP_*; STOP_NONE pads.
      stop_light: (Q,) int32, LIGHT_* now (LIGHT_GREEN where there is no light).
      others: where the others are, see `Others`.
    """

    lane_lateral: jax.Array
    lane_yaw: jax.Array
    lane_width: jax.Array
    lane_z: jax.Array
    lane_in_junction: jax.Array
    on_parking: jax.Array
    off_road_frac: jax.Array
    corner_off_road: jax.Array
    route_idx: jax.Array
    route_s: jax.Array
    route_length: jax.Array
    route_num_points: jax.Array
    route_distance: jax.Array
    route_lateral: jax.Array
    route_yaw: jax.Array
    speed_limit: jax.Array
    stop_s: jax.Array
    stop_xy: jax.Array
    stop_yaw: jax.Array
    stop_width: jax.Array
    stop_kind: jax.Array
    stop_light: jax.Array
    others: Others


class History(struct.PyTreeNode):
    """Ego motion of the last D = 15 steps, oldest first, for the comfort filter.

    Attributes:
      accel_lon, accel_lat: (D,) m/s^2 along and left of the body.
      yaw: (D,) rad, unwrapped.
      num: () int32, samples taken so far in this episode (may exceed D).
    """

    accel_lon: jax.Array
    accel_lat: jax.Array
    yaw: jax.Array
    num: jax.Array


class RewardState(struct.PyTreeNode):
    """What the reward remembers within an episode.

    Attributes:
      history: see `History`.
      route_s: () m, furthest progress along the route that has been paid.
      ttc_ticks: () int32, steps for which the TTC penalty still holds.
      comfort_ticks: (6,) int32, likewise for each comfort metric.
      stopped_s: () s, time the ego has stood still.
      far_from_route_m: () m, route length advanced while more than 15 m from it.
      stop_satisfied: (Q,) bool, the ego has halted at this stop sign.
      line_crossed: (Q,) bool, this stop line lies behind the ego's rear.
    """

    history: History
    route_s: jax.Array
    ttc_ticks: jax.Array
    comfort_ticks: jax.Array
    stopped_s: jax.Array
    far_from_route_m: jax.Array
    stop_satisfied: jax.Array
    line_crossed: jax.Array


class RewardTerms(struct.PyTreeNode):
    """One step's reward, taken apart.

    Attributes:
      added: {name: ()} what is added up, before any factor. CaRL's is the progress, the route
        completion gained in percent points.
      soft: {name: () in [0, 1]} factors.
      terminated: {name: () bool} causes that end the episode.
      finished: () bool, the route's end was reached.
      timeout: () bool, the time limit has passed.
      penalty: () the terminal penalty.
    """

    added: dict[str, jax.Array]
    soft: dict[str, jax.Array]
    terminated: dict[str, jax.Array]
    finished: jax.Array
    timeout: jax.Array
    penalty: jax.Array


class LightClock(struct.PyTreeNode):
    """What the traffic lights show now: their programme, and junctions that scenarios hold.

    Attributes:
      time: () s, clock of the programmes (starts at a random phase).
      held_junction: (H,) int32, junction whose lights are held, -1 for none; one row a scenario
        slot.
      held_green: (H, 2) int32, rows of the light table that are green while held, -1 pads.
      held_from, held_until: (H,) s on `time`, when the hold began and when it will end.
    """

    time: jax.Array
    held_junction: jax.Array
    held_green: jax.Array
    held_from: jax.Array
    held_until: jax.Array


class Walkers(struct.PyTreeNode):
    """What pedestrians have in mind; their bodies are rows of `Agents`.

    Attributes:
      node: (W,) int32, node of the town's walk graph that it comes from; -1 for nobody.
      target: (W,) int32, node it walks to.
      pace: (W,) m/s, its own walking speed.
      offset: (W,) m, how far to the left of the line between nodes it walks.
      is_reckless: (W,) bool, does not look before it crosses.
    """

    node: jax.Array
    target: jax.Array
    pace: jax.Array
    offset: jax.Array
    is_reckless: jax.Array


class Trail(struct.PyTreeNode):
    """What Roach's image shows of the last T = 16 steps, oldest first, the present one last.

    Attributes:
      xy: (T, N, 2) m; yaw: (T, N) rad; length, width: (T, N) m, of the road users then.
      kind: (T, N) int8, KIND_*; KIND_NONE too for whoever was too far above or below the ego.
      light: (T, Q) int8, LIGHT_* of each stop line of the route.
      stop: (T,) int32, place among the stop lines of the sign that asked for a halt, -1 for none.
    """

    xy: jax.Array
    yaw: jax.Array
    length: jax.Array
    width: jax.Array
    kind: jax.Array
    light: jax.Array
    stop: jax.Array


class PastMotion(struct.PyTreeNode):
    """What nuPlan's scalars need of the ego one step ago.

    Attributes:
      steer: () in [-1, 1], applied then.
      yaw_rate: () rad/s.
    """

    steer: jax.Array
    yaw_rate: jax.Array


class SimState(struct.PyTreeNode):
    """The whole state of one environment: a few kB, no map and no image.

    Attributes:
      ego, agents: see above.
      reward_state: see `RewardState`.
      episode_idx: () int32 into the bank.
      route_idx: () int32, last passed route point.
      walkers: see above.
      scenarios: the route's scenarios in play.
      lights: see above.
      step_count: () int32.
      key: () PRNG key.
      past: what the observation shows of earlier steps; None (no arrays) unless `EnvConfig`'s kind
        of observation shows any.
    """

    ego: EgoState
    agents: Agents
    reward_state: RewardState
    episode_idx: jax.Array
    route_idx: jax.Array
    walkers: Walkers
    scenarios: ScenarioSlots
    lights: LightClock
    step_count: jax.Array
    key: jax.Array
    past: Trail | PastMotion | None = None


class Observation(struct.PyTreeNode):
    """What the policy sees; sizes and meaning depend on `EnvConfig.observation`.

    Attributes:
      raster: (H, W, C) uint8, row 0 farthest ahead, column 0 farthest to the left.
      scalars: (F,).
      value_scalars: (G,) seen by the critic only.
    """

    raster: jax.Array
    scalars: jax.Array
    value_scalars: jax.Array


class State(struct.PyTreeNode):
    """What `reset` and `step` return (Brax's names).

    Attributes:
      pipeline_state: SimState.
      obs: Observation.
      reward: ().
      done: () 1.0 where the episode ended, for any cause.
      metrics: {name: ()}, the same keys from reset and step.
      info: {"truncation": () 1.0 where it ended without failure}.
    """

    pipeline_state: SimState
    obs: Observation
    reward: jax.Array
    done: jax.Array
    metrics: dict[str, jax.Array]
    info: dict[str, Any]
