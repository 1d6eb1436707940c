"""Hand-made towns with cars in them, and traffic run for a while."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from small_world import LIMIT, approach, crossing, inner, leaving, road

from carljax.sim import (
    cars_ahead,
    drivers,
    geometry,
    lights,
    population,
    priority,
    right_of_way,
    traffic,
)
from carljax.sim import road_map_builder as builder
from carljax.sim import town as towns_module
from carljax.sim.idm import IDMParams
from carljax.sim.right_of_way import EgoPlace
from carljax.sim.types import KIND_NONE, KIND_VEHICLE, EgoState

DT = 0.1
DRIVER = IDMParams()
SLOTS, STEPS = 8, 400
EGO_LENGTH = 4.9
ALL = ("east", "north", "west", "south")


NOBODY = population.nobody(1)


def f32(value):
    return jnp.asarray(value, jnp.float32)


def make_ego(xy=(1e5, 1e5), yaw=0.0, speed=0.0):
    """An ego, far away from everything unless told otherwise."""
    zero = f32(0.0)
    fields = dict.fromkeys(EgoState.__dataclass_fields__, zero)
    return EgoState(**fields | {"xy": f32(xy), "yaw": f32(yaw), "speed": f32(speed)})


def ego_place(lane=-1, next_lane=-1, s=0.0):
    return EgoPlace(lane=jnp.int32(lane), next_lane=jnp.int32(next_lane), s=f32(s))


def drive(road_map, agents, light_time, key, ego, place, num_steps, driver=DRIVER, others=NOBODY):
    """Agents of all steps, the start included, and the light clock at each."""

    def step(carry, key):
        agents, time = carry
        clock = lights.clock(time, 0)
        after = traffic.step(
            agents, others, ego, f32(EGO_LENGTH), place, road_map, clock, key, driver, DT
        )
        return (after, time + DT), after

    _, path = jax.lax.scan(step, (agents, light_time), jax.random.split(key, num_steps))
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), agents, path)


drive_small = jax.jit(functools.partial(drive, num_steps=STEPS))


class World:
    """Hand-made towns in one map: "plain", "lights", "signs" (north and south stop), "road"."""

    def __init__(self):
        networks = {
            "plain": crossing(),
            "lights": crossing(dict.fromkeys(ALL, "light"), [("east", "west"), ("north", "south")]),
            "signs": crossing({"north": "stop", "south": "stop"}),
            "road": road(0, 50, 90, 150),
        }
        # The road's pieces have limits of their own, so that they stay three lanes.
        pieces = tuple(
            dataclasses.replace(lane, speed_limit=LIMIT + k)
            for k, lane in enumerate(networks["road"].lanes)
        )
        networks["road"] = dataclasses.replace(networks["road"], lanes=pieces)
        self.towns = {name: towns_module.from_network(n) for name, n in networks.items()}
        self.first = dict(
            zip(networks, towns_module.offsets(list(self.towns.values())), strict=True)
        )
        self.map = builder.build(list(self.towns.values()))

    def row(self, name, raw):
        """The row of a raw lane of a town in the shared table."""
        return self.first[name].lane + int(self.towns[name].lanes.raw_lane[raw])

    def way(self, name, arm, way):
        """The plan of a car that comes from an arm."""
        turned = {"straight": 2, "left": 3, "right": 1}[way]
        out = ALL[(ALL.index(arm) + turned) % 4]
        raws = (approach(arm), inner(arm, way), leaving(out))
        return tuple(self.row(name, raw) for raw in raws)

    def light(self, arm):
        """Start and period of an arm's light in the town with lights, s."""
        light = int(self.map.lane_light[self.row("lights", inner(arm, "straight"))])
        return float(self.map.light_start[light]), float(self.map.light_cycle[light])

    def run(self, agents, time=0.0, ego=None, place=None):
        """40 s of traffic as NumPy arrays with a leading axis of 401."""
        ego, place = ego or make_ego(), place or ego_place()
        path = drive_small(self.map, agents, f32(time), jax.random.key(0), ego, place)
        return jax.tree.map(np.asarray, path)


def with_values(num, values):
    """Agents, `nobody` but for the given columns."""
    empty = population.nobody(num)
    kept = {name: jnp.asarray(v, getattr(empty, name).dtype) for name, v in values.items()}
    return empty.replace(**kept)


def cars(world, *specs):
    """Agents from dicts with lanes and s; 4 m by 2 m unless told otherwise; other slots empty."""
    values = {
        "lanes": np.zeros((SLOTS, 3), np.int32),
        "lane_s": np.zeros(SLOTS),
        "speed": np.zeros(SLOTS),
        "length": np.full(SLOTS, 4.0),
        "width": np.full(SLOTS, 2.0),
        "desired_speed_frac": np.ones(SLOTS),
        "kind": np.full(SLOTS, KIND_NONE, np.int32),
        "has_stopped": np.zeros(SLOTS, bool),
        "wait_s": np.zeros(SLOTS),
        "past_lane": np.full(SLOTS, -1, np.int32),
        "is_lawless": np.zeros(SLOTS, bool),
        "is_braking_hard": np.zeros(SLOTS, bool),
        "cruise_speed": np.zeros(SLOTS),
    }
    for slot, spec in enumerate(specs):
        values["kind"][slot] = KIND_VEHICLE
        for name, value in spec.items():
            values[name][slot] = value
    agents = with_values(SLOTS, values)
    return place_jit(agents, world.map)


place_jit = jax.jit(traffic.place)


def overlaps(path):
    """(..., N, N) bool, pairs of cars in use whose boxes overlap."""
    a = [getattr(path, name) for name in ("xy", "yaw", "length", "width")]
    pairs = geometry.boxes_overlap(
        *(x[..., :, None, :] if x.ndim > path.yaw.ndim else x[..., :, None] for x in a),
        *(x[..., None, :, :] if x.ndim > path.yaw.ndim else x[..., None, :] for x in a),
    )
    same_level = abs(path.z[..., :, None] - path.z[..., None, :]) < 3.0
    used = path.kind != KIND_NONE
    return (
        pairs
        & same_level
        & used[..., :, None]
        & used[..., None, :]
        & ~np.eye(path.yaw.shape[-1], dtype=bool)
    )


overlaps_jit = jax.jit(overlaps)


def gap_to_end(world, path, slot, lane):
    """Front bumper to the end of a lane: positive while the car is before it, NaN afterwards."""
    left = float(world.map.lane_length[lane]) - path.lane_s[:, slot] - path.length[:, slot] / 2
    return np.where(path.lanes[:, slot, 0] == lane, left, np.nan)


def enters_at(path, slot, lane):
    """First step at which the car's centre is no longer on its first lane."""
    gone = path.lanes[:, slot, 0] != lane
    return int(np.argmax(gone)) if gone.any() else 10**6


def _pairs(agents, movers, road_map):
    """Everybody where lanes meet: all pairs, and what each agent looks at."""
    free = drivers.free_speed(agents, road_map)
    focus = priority.focus_of(agents, road_map, free.limit)
    others = priority.crossers(agents, movers, movers.can_go, road_map, free.limit)
    return priority.pairs(agents, focus, others, road_map), focus


@jax.jit
def leaders_jit(agents, stop, ego, place, road_map):
    clock = lights.clock(f32(0.0), 0)
    movers = right_of_way.all_movers(agents, stop, ego, f32(EGO_LENGTH), place, road_map, clock)
    along = cars_ahead.look(agents, movers, road_map)
    return cars_ahead.leaders(along.gap, along.speed)


@jax.jit
def joined_jit(agents, road_map):
    """(N + 1, N) gaps to cars on lanes that part from or join an agent's own."""
    clock = lights.clock(f32(0.0), 0)
    stop = right_of_way.stop_ahead(agents, road_map, clock)
    movers = right_of_way.all_movers(
        agents, stop, make_ego(), f32(EGO_LENGTH), ego_place(), road_map, clock
    )
    return priority.joined_gaps(_pairs(agents, movers, road_map)[0])


stop_ahead_jit = jax.jit(right_of_way.stop_ahead)


@jax.jit
def gated_jit(agents, stop, ego, place, road_map, clock):
    movers = right_of_way.all_movers(agents, stop, ego, f32(EGO_LENGTH), place, road_map, clock)
    pair, focus = _pairs(agents, movers, road_map)
    return priority.gated(pair) & (focus.lane >= 0)


def is_gated(world, agents, time=0.0, ego=None, place=None):
    stop = stop_ahead_jit(agents, world.map, lights.clock(f32(time), 0))
    ego, place = ego or make_ego(), place or ego_place()
    return bool(gated_jit(agents, stop, ego, place, world.map, lights.clock(f32(time), 0))[0])
