"""How well traffic drives by itself: `python benchmarks/traffic.py`, one JSON line for each town.

Towns full of cars and no ego: nobody may touch another, run a red light or a stop sign, leave the
road or bring the others to a standstill. A car at a dead end is put back elsewhere. All checks are
made from poses and from the map, apart from the rules that the cars drive by.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from flax import struct

from carljax import machine
from carljax.sim import geometry, lights, population, road_map_builder, spawn, traffic
from carljax.sim import towns as bundled
from carljax.sim.env import TRAFFIC_ACCEL, TRAFFIC_BRAKE
from carljax.sim.idm import IDMParams
from carljax.sim.right_of_way import EgoPlace
from carljax.sim.road_map import (
    LAYER_PARKING,
    LAYER_ROAD,
    LAYER_SHOULDER,
    RoadMap,
    layer_bits,
)
from carljax.sim.road_network import MapError
from carljax.sim.town import Town, load
from carljax.sim.types import LIGHT_RED, STOP_LIGHT, STOP_SIGN, Agents, EgoState

DT = 0.1  # s
CHUNK = 300  # steps a call
CARS_AT_ONCE = 256  # over all copies of a town
HALT_SPEED = 0.25  # m/s, below which a car has halted
HALT_RANGE = 6.0  # m before the line of a stop sign within which a halt counts
LEVEL = 3.0  # m of height between cars that pass over one another
DEAD_END = 10.0  # m before a dead end at which a car is put elsewhere
CLEAR = 15.0  # m kept around the place where it is put


@dataclasses.dataclass(frozen=True)
class Command:
    """What to measure."""

    map: tuple[str, ...] = ()
    """Bundled towns by name, or paths of .xodr files; all bundled towns if none is given."""
    km: float = 1000.0
    """Kilometres that all cars of a town drive together."""
    density: float = 12.0
    """Cars for each kilometre of lane outside junctions."""
    warm_up: float = 120.0
    """Seconds before the count begins: cars set off from rest, evenly spread, without queues."""
    seed: int = 0
    """Of the cars and of all that they choose."""
    num_places: int = 5
    """Most places of collisions to list."""


class Tally(struct.PyTreeNode):
    """What is counted in one step, over all copies of a town.

    Attributes:
      km: () driven.
      speed: () m/s, mean.
      red, stop, off_road, jumps: () int32.
      collisions: () int32, pairs that touch and didn't before.
      where: (3,) int32, one of those pairs: the lanes they are on, -1 for none, and the copy.
      where_s: (2,) m along those lanes.
    """

    km: jax.Array
    speed: jax.Array
    red: jax.Array
    stop: jax.Array
    off_road: jax.Array
    jumps: jax.Array
    collisions: jax.Array
    where: jax.Array
    where_s: jax.Array


class World(struct.PyTreeNode):
    """One copy of a town: its cars, its clock, who touched whom, who has halted at a sign."""

    agents: Agents
    time: jax.Array
    touching: jax.Array
    has_halted: jax.Array
    key: jax.Array


class Spots(struct.PyTreeNode):
    """Places where cars may stand: lane (n,) int32, s (n,) m, xy (n, 2) m."""

    lane: jax.Array
    s: jax.Array
    xy: jax.Array


def main() -> int:
    """Measures and prints."""
    command = tyro.cli(Command, description=__doc__)
    try:
        names = command.map or tuple(bundled.names())
        towns = [
            load(bundled.path(name) if name in bundled.names() else Path(name)) for name in names
        ]
    except (MapError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for town in towns:
        line = measure(town, command)
        print(json.dumps({**line, "machine": machine.describe()}), flush=True)
    return 0


def measure(town: Town, command: Command) -> dict[str, Any]:
    """Lets the cars of a town drive until they have driven far enough."""
    road_map, spots, worlds = begin(town, command.density, command.seed)
    for _ in range(round(command.warm_up / (DT * CHUNK))):
        worlds, _ = run(road_map, spots, worlds)
    begun, km, parts = time.perf_counter(), 0.0, []
    while km < command.km:
        worlds, tally = run(road_map, spots, worlds)
        parts.append(jax.tree.map(np.asarray, tally))
        km += float(parts[-1].km.sum())
        if parts[-1].speed.mean() < 0.02:
            break  # nobody drives any more: they never will
    seconds = time.perf_counter() - begun
    tally = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    copies, cars = worlds.agents.kind.shape
    return {
        "benchmark": "traffic",
        "map": town.network.name,
        **figures(tally, command.num_places),
        "cars": cars,
        "copies": copies,
        "minutes": round(len(tally.speed) * DT / 60, 1),
        "wall_s": round(seconds, 1),
    }


def figures(tally: Tally, num_places: int) -> dict[str, Any]:
    """What the counts of all steps come to."""
    tenth = max(len(tally.speed) // 10, 1)
    km = float(tally.km.sum())
    hits = np.flatnonzero(tally.where[:, 0] >= 0)
    places = Counter(tuple(sorted(tally.where[k, :2].tolist())) for k in hits)
    example = {tuple(sorted(tally.where[k, :2].tolist())): tally.where_s[k].tolist() for k in hits}
    return {
        "km": round(km, 2),
        "collisions": int(tally.collisions.sum()),
        "collisions_per_km": round(float(tally.collisions.sum()) / km, 5),
        "where": [
            {"lanes": list(pair), "count": count, "s": [round(s, 1) for s in example[pair]]}
            for pair, count in places.most_common(num_places)
        ],
        "red_lights_run": int(tally.red.sum()),
        "stop_signs_run": int(tally.stop.sum()),
        "off_road": int(tally.off_road.sum()),
        "jumps": int(tally.jumps.sum()),
        "mean_speed": round(float(tally.speed.mean()), 3),
        "first_tenth_speed": round(float(tally.speed[:tenth].mean()), 3),
        "last_tenth_speed": round(float(tally.speed[-tenth:].mean()), 3),
    }


def begin(town: Town, density: float, seed: int) -> tuple[RoadMap, Spots, World]:
    """A town on the device, its places, and several copies of it with cars at rest."""
    road_map = road_map_builder.build([town])
    found = spawn.places(town.lanes)
    outside = np.array([name is None for name in town.lanes.junction])
    cars = max(1, round(density * town.lanes.length[outside].sum() / 1000))
    cars = min(cars, len(found.lane) // 2)
    copies = max(1, round(CARS_AT_ONCE / cars))
    rng = np.random.default_rng(seed)
    chosen = np.stack([rng.permutation(len(found.lane))[:cars] for _ in range(copies)])
    keys = jax.random.split(jax.random.key(seed), copies)
    spots = Spots(
        lane=jnp.asarray(found.lane, jnp.int32),
        s=jnp.asarray(found.s, jnp.float32),
        xy=jnp.asarray(found.xy, jnp.float32),
    )

    def one(chosen: jax.Array, key: jax.Array) -> World:
        key_cars, key_time, key = jax.random.split(key, 3)
        lane, s = spots.lane[chosen], spots.s[chosen]
        agents = traffic.initial(lane, s, jnp.zeros_like(s), road_map, key_cars)
        return World(
            agents=agents,
            time=jax.random.uniform(key_time, (), maxval=600.0),
            touching=jnp.zeros((cars, cars), bool),
            has_halted=jnp.zeros(cars, bool),
            key=key,
        )

    return road_map, spots, jax.jit(jax.vmap(one))(chosen, keys)


@jax.jit
def run(road_map: RoadMap, spots: Spots, worlds: World) -> tuple[World, Tally]:
    """`CHUNK` steps of all copies: the worlds after them and the tally of each step."""

    def step(worlds: World, _: None) -> tuple[World, Tally]:
        worlds, tally = jax.vmap(functools.partial(advance, road_map, spots))(worlds)
        hit = jnp.argmax(tally.collisions)
        summed = jax.tree.map(lambda x: x.sum(axis=0), tally)
        return worlds, summed.replace(
            speed=tally.speed.mean(), where=tally.where[hit], where_s=tally.where_s[hit]
        )

    return jax.lax.scan(step, worlds, None, length=CHUNK)


def advance(road_map: RoadMap, spots: Spots, world: World) -> tuple[World, Tally]:
    """One step of one copy."""
    key, key_step, key_spot = jax.random.split(world.key, 3)
    clock = lights.clock(world.time, 0)
    before = world.agents
    after = traffic.step(
        before,
        population.nobody(1),
        far_ego(),
        jnp.float32(4.9),
        EgoPlace(lane=jnp.int32(-1), next_lane=jnp.int32(-1), s=jnp.float32(0.0)),
        road_map,
        clock,
        key_step,
        IDMParams(accel_max=TRAFFIC_ACCEL, comfort_brake=TRAFFIC_BRAKE),
        DT,
    )
    touching = overlaps(after)
    new = touching & ~world.touching
    pair = jnp.argmax(new)
    first, second = pair // new.shape[0], pair % new.shape[0]
    halted, red, unmet = lines(before, after, world.has_halted, road_map, clock)
    moved = jnp.hypot(*(after.xy - before.xy).T)
    tally = Tally(
        km=(0.5 * (before.speed + after.speed)).sum() * DT / 1000.0,
        speed=after.speed.mean(),
        red=red.sum(),
        stop=unmet.sum(),
        off_road=off_road(after, road_map).sum(),
        # A tenth for the ends of lanes that don't quite meet and for bends between lane points.
        jumps=(moved > jnp.maximum(before.speed, after.speed) * DT + 0.1).sum(),
        collisions=new.sum() // 2,
        where=jnp.where(new.any(), after.lanes[jnp.stack([first, second]), 0], -1),
        where_s=after.lane_s[jnp.stack([first, second])],
    )
    renewed = leave_dead_end(after, spots, road_map, key_spot)
    return (
        World(agents=renewed, time=world.time + DT, touching=touching, has_halted=halted, key=key),
        tally,
    )


def far_ego() -> EgoState:
    """An ego where nobody meets it."""
    fields = dict.fromkeys(EgoState.__dataclass_fields__, jnp.zeros((), jnp.float32))
    return EgoState(**{**fields, "xy": jnp.full(2, 1e5, jnp.float32)})


def overlaps(agents: Agents) -> jax.Array:
    """(N, N) bool, pairs whose boxes overlap."""
    box = (agents.xy, agents.yaw, agents.length, agents.width)
    pairs = geometry.boxes_overlap(*(x[:, None] for x in box), *(x[None] for x in box))
    level = jnp.abs(agents.z[:, None] - agents.z[None]) < LEVEL
    used = agents.valid[:, None] & agents.valid[None]
    return pairs & level & used & ~jnp.eye(agents.yaw.shape[0], dtype=bool)


def lines(
    before: Agents, after: Agents, has_halted: jax.Array, road_map: RoadMap, clock: Any
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Who has halted at the sign ahead; who crosses a line at red, or a sign without a halt."""
    there = jnp.maximum(before.lanes[:, :2], 0)
    begins = jnp.stack([jnp.zeros_like(before.lane_s), road_map.lane_length[there[:, 0]]], 1)
    front = before.lane_s + 0.5 * before.length
    distance = begins + road_map.lane_stop_s[there] - front[:, None]  # (N, 2)
    kind = jnp.where(before.lanes[:, :2] >= 0, road_map.lane_stop_kind[there], 0)
    travelled = 0.5 * (before.speed + after.speed) * DT
    crossed = (distance > 0.0) & (distance <= travelled[:, None]) & before.valid[:, None]
    colour = lights.colour(jnp.maximum(road_map.lane_light[there], 0), clock, road_map)
    colour = jnp.where(road_map.lane_light[there] >= 0, colour, -1)
    red = (crossed & (kind == STOP_LIGHT) & (colour == LIGHT_RED)).any(axis=1)
    near = ((kind == STOP_SIGN) & (distance > 0.0) & (distance < HALT_RANGE)).any(axis=1)
    halted = near & (has_halted | (before.speed < HALT_SPEED))
    unmet = (crossed & (kind == STOP_SIGN)).any(axis=1) & ~halted
    return halted, red, unmet


def off_road(agents: Agents, road_map: RoadMap) -> jax.Array:
    """(N,) bool, centre or more than two corners are on neither road, parking lane nor shoulder."""
    corners = geometry.box_corners(agents.xy, agents.yaw, agents.length, agents.width)
    drivable = LAYER_ROAD | LAYER_PARKING | LAYER_SHOULDER
    on_corner = (layer_bits(road_map, jnp.int32(0), corners) & drivable) > 0
    on_centre = (layer_bits(road_map, jnp.int32(0), agents.xy) & drivable) > 0
    return agents.valid & (~on_centre | (on_corner.sum(axis=1) < 2))


def leave_dead_end(agents: Agents, spots: Spots, road_map: RoadMap, key: jax.Array) -> Agents:
    """Puts one car that has come to a dead end at a free place elsewhere, at rest."""
    key_spot, key_car = jax.random.split(key)
    pick = jax.random.randint(key_spot, (1,), 0, spots.lane.shape[0])
    clear = (((agents.xy - spots.xy[pick]) ** 2).sum(axis=1) > CLEAR**2).all()
    left = road_map.lane_length[jnp.maximum(agents.lanes[:, 0], 0)] - agents.lane_s
    ended = agents.valid & (agents.lanes[:, 1] < 0) & (left < DEAD_END)
    moves = (jnp.arange(ended.shape[0]) == jnp.argmax(ended)) & ended & clear
    speed = jnp.zeros(1, jnp.float32)
    fresh = traffic.initial(spots.lane[pick], spots.s[pick], speed, road_map, key_car)

    def choose(new: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.where(moves.reshape(-1, *[1] * (old.ndim - 1)), new, old)

    return jax.tree.map(choose, fresh, agents)


if __name__ == "__main__":
    sys.exit(main())
