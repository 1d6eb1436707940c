"""Builders for the reward's tests: a straight road to the east, everything overridable by name."""

import functools

import jax
import numpy as np

from carljax.reward import reward
from carljax.reward.config import RewardConfig
from carljax.sim import lights, population
from carljax.sim.bicycle import VehicleParams
from carljax.sim.scenarios import script
from carljax.sim.types import (
    KIND_NONE,
    KIND_VEHICLE,
    LIGHT_GREEN,
    STOP_NONE,
    EgoState,
    Others,
    SimState,
    Situation,
)

VEHICLE = VehicleParams()
CARL = RewardConfig()
DT = 0.1


@functools.partial(jax.jit, static_argnames="config")
def compute(state, ego, agents, situation, config):
    """The composed reward, compiled once for each configuration and size."""
    return reward.compute(state, ego, agents, situation, VEHICLE, config, DT)


def f32(value):
    return np.asarray(value, np.float32)


def make_ego(xy=(0.0, 0.0), yaw=0.0, speed=5.0, **fields):
    scalars = dict.fromkeys(("z", "slip", "yaw_rate", "accel", "steer", "throttle", "brake"), 0.0)
    scalars |= {"yaw": yaw, "speed": speed} | fields
    return EgoState(xy=f32(xy), **{name: f32(value) for name, value in scalars.items()})


def make_agents(num=2, **fields):
    """`num` slots, empty unless `xy` is given; given fields fill the first slots."""
    filled = len(fields["xy"]) if "xy" in fields else 0
    defaults = {
        "xy": np.zeros((num, 2)),
        "length": np.full(num, 4.0),
        "width": np.full(num, 2.0),
        "desired_speed_frac": np.ones(num),
        "kind": np.where(np.arange(num) < filled, KIND_VEHICLE, KIND_NONE),
    }
    for name in ("z", "yaw", "speed", "yaw_rate", "accel"):
        defaults[name] = np.zeros(num)
    for name, value in fields.items():
        defaults[name][: len(value)] = value
    empty = population.nobody(num)
    kept = {k: np.asarray(v, getattr(empty, k).dtype) for k, v in defaults.items()}
    return jax.tree.map(np.asarray, empty.replace(**kept))


def make_others(num=2, **fields):
    """Others on the road but not ahead on the route; given fields fill the first places."""
    values = {"on_road": np.ones(num, bool), "route_gap": np.full(num, np.inf, np.float32)}
    for name, value in fields.items():
        values[name][: len(value)] = value
    return Others(**values)


def make_situation(num_lines=3, others=None, **fields):
    """On the centre of a 3.5 m lane to the east, at 100 m of a route of 1 km, no stop lines."""
    values = {
        "lane_lateral": 0.0,
        "lane_yaw": 0.0,
        "lane_z": 0.0,
        "lane_width": 3.5,
        "lane_in_junction": False,
        "on_parking": False,
        "off_road_frac": 0.0,
        "corner_off_road": np.zeros(4),
        "route_idx": 100,
        "route_s": 100.0,
        "route_length": 1000.0,
        "route_num_points": 1001,
        "route_distance": 0.0,
        "route_lateral": 0.0,
        "route_yaw": 0.0,
        "speed_limit": 10.0,
        "stop_s": np.full(num_lines, 1e6),
        "stop_xy": np.zeros((num_lines, 2)),
        "stop_yaw": np.zeros(num_lines),
        "stop_width": np.full(num_lines, 3.5),
        "stop_kind": np.full(num_lines, STOP_NONE),
        "stop_light": np.full(num_lines, LIGHT_GREEN),
    } | fields
    kinds = dict.fromkeys(("route_idx", "route_num_points", "stop_kind", "stop_light"), np.int32)
    kinds |= dict.fromkeys(("lane_in_junction", "on_parking", "corner_off_road"), bool)
    arrays = {k: np.asarray(v, kinds.get(k, np.float32)) for k, v in values.items()}
    return Situation(**arrays, others=make_others() if others is None else others)


def make_state(ego, agents, situation, step_count=0, config=CARL, **memory):
    """The state before a step: nothing in the reward's memory but what `memory` says.

    Progress up to the situation's place is already paid.
    """
    memory = {"route_s": situation.route_s} | memory
    return SimState(
        ego=ego,
        agents=agents,
        reward_state=reward.init(ego, situation.stop_kind.shape[0], config).replace(
            **{"route_s": situation.route_s, **memory}
        ),
        episode_idx=np.int32(0),
        route_idx=situation.route_idx,
        walkers=population.no_walkers(0),
        scenarios=script.empty_slots(0),
        lights=lights.clock(f32(0.0), 0),
        step_count=np.int32(step_count),
        key=np.uint32(0),
    )


def one_step(config, ego=None, agents=None, situation=None, before=None, step_count=0, **memory):
    """The composed reward of one step; nothing around and nothing remembered unless given."""
    ego = make_ego() if ego is None else ego
    agents = make_agents() if agents is None else agents
    situation = make_situation() if situation is None else situation
    state = make_state(before or ego, agents, situation, step_count, config, **memory)
    return compute(state, ego, agents, situation, config)


def ends(terms):
    """Names of the causes that hold."""
    return {name for name, value in terms.terminated.items() if bool(value)}
