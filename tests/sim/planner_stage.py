"""A stage for planners: hand-made towns, a route, and others that move as the scene says.

Others start at a given time and keep their speed; they mind nobody.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from small_world import approach, inner, leaving
from traffic_world import ALL, World

from carljax.planners import PLANNERS
from carljax.reward import stop_line, stop_sign
from carljax.reward.config import RewardConfig
from carljax.sim import (
    bicycle,
    env,
    episodes,
    geometry,
    population,
    route,
    route_generator,
    situation,
)
from carljax.sim.env import EnvConfig
from carljax.sim.journey import Journey
from carljax.sim.route_assembly import RouteSizes, Segment, assemble
from carljax.sim.town import offsets
from carljax.sim.types import KIND_NONE, KIND_PEDESTRIAN, KIND_VEHICLE

DT, STEPS = 0.1, 400
CONFIG = EnvConfig(num_agents=4, num_pedestrians=2, num_scenario_slots=0)
CARS = CONFIG.num_agents
NUM = CONFIG.population.num_agents


@dataclasses.dataclass(frozen=True)
class Other:
    """Somebody: its start and speed; `way` for a car on lanes of its town, as in `World.way`."""

    xy: tuple[float, float]
    yaw: float
    speed: float
    starts: float = 0.0
    way: tuple[str, str] | None = None
    size: tuple[float, float] = (4.0, 2.0)
    kind: int = KIND_VEHICLE


@dataclasses.dataclass(frozen=True)
class Scene:
    """A town of `World`, the ego's arm and turn, its start on the route, and the others."""

    town: str
    arm: str = "west"
    turn: str = "straight"
    start: int = 0
    speed: float = 8.0
    others: tuple[Other, ...] = ()
    clock: float = 0.0


def crossing_route(world: World, town: str, arm: str, turn: str):
    """From the beginning of an arm through the crossing to the end of another."""
    out = ALL[(ALL.index(arm) + {"straight": 2, "left": 3, "right": 1}[turn]) % 4]
    table = world.towns[town].lanes
    rows = [int(table.raw_lane[i]) for i in (approach(arm), inner(arm, turn), leaving(out))]
    segments = [Segment(row, 0.0, float(table.length[row])) for row in rows]
    return assemble(world.towns[town], world.first[town], segments)


@functools.cache
def make_env(world: World):
    """An environment whose episodes are the routes, and the episode of each of them."""
    keys = [
        ("plain", "west", "straight"),
        ("plain", "west", "left"),
        ("plain", "west", "right"),
        ("lights", "west", "straight"),
        ("lights", "west", "left"),
        ("signs", "north", "straight"),
    ]
    journeys = [Journey(crossing_route(world, *key)) for key in keys]
    bank = episodes.populate(list(world.towns.values()), journeys, CONFIG.population, 0)
    return env.make_env(bank, CONFIG, RewardConfig()), {key: i for i, key in enumerate(keys)}


def cast(world: World, scene: Scene):
    """Agents of a scene, and when each starts."""
    rows = jax.tree.map(lambda x: np.array(x), population.nobody(NUM))
    starts = np.zeros(NUM, np.float32)
    number = {KIND_VEHICLE: 0, KIND_PEDESTRIAN: CARS}
    for other in scene.others:
        i = number[other.kind]
        number[other.kind] += 1
        starts[i] = other.starts
        rows.kind[i], rows.xy[i], rows.yaw[i] = other.kind, other.xy, other.yaw
        rows.speed[i] = other.speed
        rows.length[i], rows.width[i] = other.size
        if other.way is not None:
            rows.lanes[i] = world.way(scene.town, *other.way)
    return jax.tree.map(jnp.asarray, rows), jnp.asarray(starts)


def _moved(agents, begin, speeds, starts, time, road_map):
    """Everybody where the scene has them at a time, cars also along their lanes."""
    gone = speeds * jnp.maximum(time - starts, 0.0)
    heading = jnp.stack([jnp.cos(begin.yaw), jnp.sin(begin.yaw)], axis=-1)
    xy = begin.xy + gone[:, None] * heading
    first = jnp.maximum(begin.lanes, 0)
    start = road_map.point_xy[road_map.lane_start[first[:, 0]]]
    along = geometry.to_frame(xy, start, begin.yaw)[:, 0]
    length = road_map.lane_length[first]
    is_second, is_third = along > length[:, 0], along > length[:, 0] + length[:, 1]
    lanes = jnp.where(is_second[:, None], jnp.roll(begin.lanes, -1, axis=1), begin.lanes)
    lanes = jnp.where(is_third[:, None], jnp.roll(begin.lanes, -2, axis=1), lanes)
    later = (is_second[:, None] & (jnp.arange(3) > 1)) | (is_third[:, None] & (jnp.arange(3) > 0))
    s = along - jnp.where(is_second, length[:, 0], 0.0) - jnp.where(is_third, length[:, 1], 0.0)
    return agents.replace(
        xy=xy,
        speed=jnp.where(time > starts, speeds, 0.0),
        lanes=jnp.where(later, -1, lanes),
        lane_s=jnp.where(begin.lanes[:, 0] >= 0, s, 0.0),
    )


@functools.partial(jax.jit, static_argnums=(0, 1))
def _play(name, num_steps, env, sim, begin, starts):
    planner = PLANNERS[name]
    speeds = begin.speed

    def step(carry, number):
        sim, memory = carry
        time = number * jnp.float32(DT)
        agents = _moved(sim.agents, begin, speeds, starts, time, env.bank.road_map)
        sim = sim.replace(agents=agents)
        action, memory = planner.act(env, sim, memory)
        ego = bicycle.step(sim.ego, *bicycle.from_action(action), env.vehicle, DT)
        stretch, first = route.window(env.bank.routes, sim.episode_idx, sim.route_idx)
        idx = route.advance(stretch, sim.route_idx - first, ego.xy)
        size = jnp.stack([jnp.float32(env.vehicle.length), jnp.float32(env.vehicle.width)])
        seen = situation.situation(
            ego, size, agents, env.bank.road_map, stretch, first, idx, sim.lights
        )
        met = stop_sign.halted(ego, env.vehicle, seen, 0.1)
        crossed = stop_line.crossed(sim.ego, ego, 0.0, seen, 5.0)
        lights = sim.lights.replace(time=sim.lights.time + DT)
        memo = sim.reward_state
        memo = memo.replace(stop_satisfied=memo.stop_satisfied | met)
        touch = geometry.boxes_overlap(
            ego.xy, ego.yaw, *size, agents.xy, agents.yaw, agents.length, agents.width
        )
        after = sim.replace(ego=ego, lights=lights, route_idx=idx + first, reward_state=memo)
        seen = {
            "xy": ego.xy,
            "speed": ego.speed,
            "accel": ego.accel,
            "others": agents.xy,
            "touches": (touch & (agents.kind != KIND_NONE)).any(),
            "route_idx": after.route_idx,
            "light": jnp.where(seen.stop_kind[0] > 0, seen.stop_light[0], 0),
            "crossed": crossed.any(),
            "met": met.any(),
        }
        return (after, memory), seen

    return jax.lax.scan(step, (sim, planner.init(env)), jnp.arange(num_steps))[1]


_start = jax.jit(lambda env, episode, key: env.start_episode(episode, key).pipeline_state)


def play(world: World, planner: str, scene: Scene):
    """40 s of a scene: {name: (400, ...)}."""
    env, episode = make_env(world)
    episode = episode[scene.town, scene.arm, scene.turn]
    sim = _start(env, jnp.int32(episode), jax.random.key(0))
    agents, starts = cast(world, scene)
    at = env.bank.routes.xy[episode, scene.start]
    ego = sim.ego.replace(
        xy=at, yaw=env.bank.routes.yaw[episode, scene.start], speed=jnp.float32(scene.speed)
    )
    sim = sim.replace(
        ego=ego,
        agents=agents,
        route_idx=jnp.int32(scene.start),
        lights=sim.lights.replace(time=jnp.float32(scene.clock)),
    )
    return jax.tree.map(np.asarray, _play(planner, STEPS, env, sim, agents, starts))


def drive_alone(town, planner: str, length: float, seed: int, num_steps: int):
    """A drawn route in a town with nobody else: the route, and {name: (num_steps, ...)}."""
    first = offsets([town])[0]
    sizes = RouteSizes(int(length) + 1)
    drawn = route_generator.draw(town, first, length, sizes, np.random.default_rng(seed))
    bank = episodes.populate([town], [Journey(drawn)], CONFIG.population, 0)
    alone = env.make_env(bank, CONFIG, RewardConfig())
    sim = _start(alone, jnp.int32(0), jax.random.key(0))
    nobody = population.nobody(NUM)
    sim = sim.replace(agents=nobody)
    path = _play(planner, num_steps, alone, sim, nobody, jnp.zeros(NUM, jnp.float32))
    return drawn, jax.tree.map(np.asarray, path)
