"""Pedestrians: along pavements, across at crosswalks and, seldom, elsewhere.

A pedestrian walks from node to node of the town's walk graph and draws the next one on arrival,
mostly straight on. At a kerb it looks at the vehicles around it and sets out once each would arrive
only after it has left that vehicle's way; before every lane it looks again. The reckless don't
look, but they too leave a driver room to stop.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from carljax.sim import geometry, population
from carljax.sim.respawn import VIEW_BACK, VIEW_FRONT, VIEW_SIDE
from carljax.sim.road_crossing import ARRIVAL, SIZE, Edge, edge_of, must_wait
from carljax.sim.road_map import (
    WALK_CROSSING,
    WALK_JAYWALK,
    WALK_PAVEMENT,
    WALK_TO_CROSSING,
    WALK_TO_JAYWALK,
    RoadMap,
    grid_cell,
)
from carljax.sim.types import KIND_NONE, KIND_PEDESTRIAN, Agents, EgoState, Walkers

KERB_SPEED = 1.2  # m/s, nobody runs to a kerb. source: ours
TURN_RATE = 3.0  # rad/s. source: ours, a half turn in a second
SPEED_UP, SLOW_DOWN = 2.0, 5.0  # m/s^2. source: ours, to a walk in less than a second
LOOK_AHEAD = 1.0  # m along the line that it walks on, to which it steers. source: ours

# How likely each way on is, by WALK_*, relative to going straight on. source: ours; one in three
# crosses where there is a crosswalk, one in thirty where there is none.
_CHANCE = np.zeros(5, np.float32)
_CHANCE[[WALK_PAVEMENT, WALK_CROSSING, WALK_JAYWALK]] = 1.0
_CHANCE[[WALK_TO_CROSSING, WALK_TO_JAYWALK]] = 0.5, 0.03
_CHANCE_BACK = 1e-4  # of turning round where there is another way
PATIENCE = 20.0  # s at a kerb, after which it goes elsewhere. source: ours, longer than a red light

GONE = 130.0  # m from the ego, beyond which a pedestrian appears elsewhere
GONE_BEHIND = 60.0  # m behind the ego, likewise: out of its image


def initial(walkers: Walkers, road_map: RoadMap) -> Agents:
    """The bodies of pedestrians that stand at their nodes; an empty row for each that has none.

    Args:
      walkers: (W,).
      road_map: the map.
    """
    num = walkers.node.shape[0]
    start = road_map.walk_xyz[jnp.maximum(walkers.node, 0)]
    offset = road_map.walk_xyz[jnp.maximum(walkers.target, 0)] - start
    size = jnp.full(num, SIZE, jnp.float32)
    here = walkers.node >= 0
    return population.nobody(num).replace(
        xy=start[:, :2],
        z=start[:, 2],
        yaw=jnp.arctan2(offset[:, 1], offset[:, 0]),
        speed=jnp.where(here, walkers.pace, 0.0),
        length=size,
        width=size,
        kind=jnp.where(here, KIND_PEDESTRIAN, KIND_NONE).astype(jnp.int32),
    )


def step(
    bodies: Agents,
    walkers: Walkers,
    others: Agents,
    ego: EgoState,
    ego_size: jax.Array,
    road_map: RoadMap,
    key: jax.Array,
    dt: float,
) -> tuple[Agents, Walkers]:
    """Moves all pedestrians by one step.

    Args:
      bodies: (W,) their rows of the agents.
      walkers: (W,).
      others: (V,) everybody else; they look out for the vehicles among them.
      ego: the ego.
      ego_size: (2,) its length and width, m.
      road_map: the map.
      key: PRNG key, for the choice of ways.
      dt: s.

    Returns:
      Bodies and walkers dt later.
    """
    edge = edge_of(bodies, walkers, road_map)
    waits = must_wait(bodies, walkers, edge, others, ego, ego_size)
    pace = jnp.where(edge.to_kerb, jnp.minimum(walkers.pace, KERB_SPEED), walkers.pace)
    moved = _move(bodies, edge, walkers.offset, jnp.where(waits, 0.0, pace), dt)
    return _onward(moved, walkers, edge, key)


def _move(bodies: Agents, edge: Edge, offset: jax.Array, wanted: jax.Array, dt: float) -> Agents:
    """Bodies dt later: they steer to the line they walk on and slow down to turn."""
    aim = edge.yaw + jnp.arctan2(offset - edge.lateral, LOOK_AHEAD)
    error = geometry.wrap_angle(aim - bodies.yaw)
    turn = jnp.clip(error, -TURN_RATE * dt, TURN_RATE * dt)
    yaw = geometry.wrap_angle(bodies.yaw + turn)
    wanted = wanted * jnp.maximum(jnp.cos(error), 0.1)
    change = jnp.clip(wanted - bodies.speed, -SLOW_DOWN * dt, SPEED_UP * dt)
    speed = jnp.maximum(bodies.speed + change, 0.0)
    travelled = 0.5 * (bodies.speed + speed) * dt
    here = bodies.valid
    xy = bodies.xy + travelled[:, None] * jnp.stack([jnp.cos(yaw), jnp.sin(yaw)], axis=-1)
    return bodies.replace(
        xy=jnp.where(here[:, None], xy, bodies.xy),
        z=jnp.where(here, edge.z, bodies.z),
        yaw=jnp.where(here, yaw, bodies.yaw),
        yaw_rate=jnp.where(here, turn / dt, 0.0),
        speed=jnp.where(here, speed, 0.0),
        accel=jnp.where(here, change / dt, 0.0),
        wait_s=jnp.where(here & (speed < 0.1), bodies.wait_s + dt, 0.0),
    )


def _onward(bodies: Agents, walkers: Walkers, edge: Edge, key: jax.Array) -> tuple[Agents, Walkers]:
    """Draws the next node for those who arrive; those who have waited for too long turn round."""
    straight = 0.5 + 0.5 * jnp.cos(edge.onward_yaw - edge.yaw[:, None])
    on_pavement = edge.onward_kind == WALK_PAVEMENT
    chance = jnp.asarray(_CHANCE)[edge.onward_kind]
    # A little of everything: of two ways back along a pavement one is taken.
    chance *= jnp.where(on_pavement, jnp.maximum(straight**2, 1e-2), 1.0)
    is_back = edge.onward == walkers.node[:, None]
    following = _draw(edge.onward, jnp.where(is_back, _CHANCE_BACK, chance), key)
    arrives = (edge.along > edge.length - ARRIVAL) & bodies.valid & (following >= 0)
    turns = (bodies.wait_s > PATIENCE) & ~arrives
    target = jnp.where(turns, walkers.node, walkers.target)
    return (
        bodies.replace(wait_s=jnp.where(turns, 0.0, bodies.wait_s)),
        walkers.replace(
            node=jnp.where(arrives | turns, walkers.target, walkers.node),
            target=jnp.where(arrives, following, target),
        ),
    )


def _draw(nodes: jax.Array, chance: jax.Array, key: jax.Array) -> jax.Array:
    """(W,) int32, one of the nodes (W, D) by chance (W, D); -1 where there is none."""
    total = jnp.cumsum(jnp.where(nodes >= 0, chance, 0.0), axis=1)
    drawn = jax.random.uniform(key, nodes.shape[:1]) * total[:, -1]
    column = jnp.argmax(total > drawn[:, None], axis=1)
    return jnp.take_along_axis(nodes, column[:, None], axis=1)[:, 0]


def respawn(
    bodies: Agents,
    walkers: Walkers,
    ego: EgoState,
    town: jax.Array,
    road_map: RoadMap,
    key: jax.Array,
    cell_size: float,
) -> tuple[Agents, Walkers]:
    """Lets at most one pedestrian appear near the ego but out of its sight, and not behind it.

    That is one who isn't there yet, or the farthest of those left behind.

    Args:
      bodies: (W,), W at least 1.
      walkers: (W,); rows without pace stay empty.
      ego: the ego.
      town: () int32.
      road_map: the map.
      key: PRNG key.
      cell_size: m, of the grid of places.

    Returns:
      Bodies and walkers.
    """
    key_place, key_way = jax.random.split(key)
    node = _respawn_node(ego, town, road_map, key_place, cell_size)
    row = jnp.maximum(node, 0)
    kind = road_map.walk_kind[row]
    pavement = jnp.where(kind == WALK_PAVEMENT, jnp.float32(1.0), jnp.float32(0.0))
    target = _draw(road_map.walk_neighbours[row][None], pavement[None], key_way)[0]
    place = geometry.to_frame(road_map.walk_xyz[row, :2], ego.xy, ego.yaw)
    hidden = (place[0] > VIEW_FRONT) | (jnp.abs(place[1]) > VIEW_SIDE)
    hidden &= place[0] > -VIEW_BACK
    seen_from = geometry.to_frame(bodies.xy, ego.xy, ego.yaw)
    away = jnp.sqrt((seen_from**2).sum(axis=1))
    left_behind = bodies.valid & ((away > GONE) | (seen_from[:, 0] < -GONE_BEHIND))
    absent = ~bodies.valid & (walkers.pace > 0.0)
    urgency = jnp.where(absent, 1e6, jnp.where(left_behind, away, 0.0))
    chosen = jnp.arange(urgency.shape[0]) == jnp.argmax(urgency)
    moves = chosen & (absent | left_behind) & hidden & (node >= 0) & (target >= 0)
    walkers = walkers.replace(
        node=jnp.where(moves, node, walkers.node), target=jnp.where(moves, target, walkers.target)
    )
    fresh = initial(walkers, road_map)
    return (
        jax.tree.map(
            lambda new, old: jnp.where(moves.reshape((-1,) + (1,) * (new.ndim - 1)), new, old),
            fresh,
            bodies,
        ),
        walkers,
    )


def _respawn_node(
    ego: EgoState, town: jax.Array, road_map: RoadMap, key: jax.Array, cell_size: float
) -> jax.Array:
    """() int32, one of the nodes listed for the ego's grid cell, -1 for none."""
    pick = jax.random.randint(key, (), 0, road_map.spawn_walk.shape[1])
    return road_map.spawn_walk[grid_cell(road_map, town, ego.xy, cell_size), pick]
