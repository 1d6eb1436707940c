"""When a pedestrian sets out across the road, and when it stops on it, as it sees the vehicles."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct

from carljax.sim import geometry
from carljax.sim.once import once
from carljax.sim.road_map import WALK_CROSSING, WALK_JAYWALK, RoadMap
from carljax.sim.types import KIND_VEHICLE, Agents, EgoState, Walkers

SIZE = 0.5  # m, length and width of the box. source: CARLA's walkers, about 0.5 m either way
ARRIVAL = 0.3  # m before a node at which it counts as reached, and after a kerb as not yet left
GAP_MARGIN = 1.5  # s between leaving a vehicle's way and its arrival. source: ours
STEP_MARGIN = 0.5  # s, likewise for the next lane once on the road. source: ours
BESIDE = 0.75  # m kept to a vehicle's sides: half a body and half a metre
IN_FRONT = 1.25  # m kept to a vehicle that stands in its way, likewise and a step
ROLLING = 0.5  # m/s, slower vehicles are taken to stand
PICK_UP = 1.5  # m/s by which a rolling vehicle may yet be faster. source: ours, a second of green
STOPS_SHORT = 2.0  # m before the pedestrian's way at which a braking vehicle is seen to stop
# What a driver needs to stop: time to see and m/s^2. source: textbook values, half of a full stop
REACTION_S, DRIVER_BRAKING = 1.0, 4.0
# A vehicle may come to any place in a cone before it: half its width at the front, and its slope.
# source: ours, wide enough for the bends of towns
CONE_SIDE, CONE_SLOPE = 2.5, 0.6
MAX_STEP_Z = 3.0  # m, vehicles further above or below are on another level


class Edge(struct.PyTreeNode):
    """What each pedestrian walks on, all (W,): where it is on it and what lies beyond.

    Attributes:
      yaw: rad, direction.
      length: m.
      along: m, how far it has come.
      lateral: m, to the left of the line.
      z: m, height there.
      crosses: bool, it leads across a road.
      to_kerb: bool, it leads to a kerb.
      onward: (W, D) int32, nodes beyond its end, -1 pads.
      onward_yaw: (W, D) rad.
      onward_kind: (W, D) int32, WALK_*.
    """

    yaw: jax.Array
    length: jax.Array
    along: jax.Array
    lateral: jax.Array
    z: jax.Array
    crosses: jax.Array
    to_kerb: jax.Array
    onward: jax.Array
    onward_yaw: jax.Array
    onward_kind: jax.Array


class Meeting(struct.PyTreeNode):
    """What each pedestrian sees of each vehicle, all (W, V + 1); the ego is the last.

    Attributes:
      comes: bool, it rolls towards what the pedestrian has still to walk and isn't seen to stop
        before it.
      distance: m, from its front to that, in a straight line and so never too long.
      speed: m/s, its own.
      enter, leave: m along the pedestrian's way, the piece that the vehicle may sweep over.
      blocks: bool, it stands or drives right in front of the pedestrian.
    """

    comes: jax.Array
    distance: jax.Array
    speed: jax.Array
    enter: jax.Array
    leave: jax.Array
    blocks: jax.Array


class Cars(struct.PyTreeNode):
    """The vehicles that pedestrians look at, all (V + 1,); the ego is the last.

    Attributes:
      exists: bool, it is one.
      x, y, z: m.
      cos, sin: of the direction in which it drives.
      speed: m/s.
      stops_in: m, if it goes on to brake as it does.
      half_length, half_width: m.
    """

    exists: jax.Array
    x: jax.Array
    y: jax.Array
    z: jax.Array
    cos: jax.Array
    sin: jax.Array
    speed: jax.Array
    stops_in: jax.Array
    half_length: jax.Array
    half_width: jax.Array


class Ways(struct.PyTreeNode):
    """Where pedestrians are and go, all (W,).

    Attributes:
      x, y, z: m.
      cos, sin: of the direction of their edge.
      left: m to the end of it.
    """

    x: jax.Array
    y: jax.Array
    z: jax.Array
    cos: jax.Array
    sin: jax.Array
    left: jax.Array


def edge_of(bodies: Agents, walkers: Walkers, road_map: RoadMap) -> Edge:
    """Looks up the edges that pedestrians (W,) walk on."""
    target = jnp.maximum(walkers.target, 0)
    start = road_map.walk_xyz[jnp.maximum(walkers.node, 0)]
    offset = road_map.walk_xyz[target] - start
    yaw = jnp.arctan2(offset[:, 1], offset[:, 0])
    length = jnp.sqrt((offset[:, :2] ** 2).sum(axis=1))
    at = geometry.to_frame(bodies.xy, start[:, :2], yaw)
    onward, kind = road_map.walk_neighbours[target], road_map.walk_kind[target]
    over = (kind == WALK_CROSSING) | (kind == WALK_JAYWALK)
    crosses = (over & (onward == walkers.node[:, None])).any(axis=1)
    frac = jnp.clip(at[:, 0] / jnp.maximum(length, 0.1), 0.0, 1.0)
    return Edge(
        yaw=yaw,
        length=length,
        along=at[:, 0],
        lateral=at[:, 1],
        z=start[:, 2] + frac * offset[:, 2],
        crosses=crosses,
        to_kerb=over.any(axis=1) & ~crosses,
        onward=onward,
        onward_yaw=road_map.walk_yaw[target],
        onward_kind=kind,
    )


def must_wait(
    bodies: Agents,
    walkers: Walkers,
    edge: Edge,
    others: Agents,
    ego: EgoState,
    ego_size: jax.Array,
) -> jax.Array:
    """(W,) bool: a vehicle stands in the way or would come too soon.

    At the kerb the careful wait until they could leave every vehicle's way well before it comes,
    the reckless only until each driver could still stop. On the road the careful stop before a
    vehicle's way that they would leave too late.

    Args:
      bodies: (W,).
      walkers: (W,).
      edge: (W,).
      others: (V,) other road users.
      ego: the ego.
      ego_size: (2,) its length and width, m.
    """
    seen = meetings(bodies, edge, others, ego, ego_size)
    arrive = seen.distance / (seen.speed + PICK_UP)
    leave = seen.leave / jnp.maximum(walkers.pace, 0.1)[:, None]
    needs = seen.speed * REACTION_S + seen.speed**2 / (2 * DRIVER_BRAKING)
    reckless = walkers.is_reckless[:, None]
    at_kerb = edge.along[:, None] < ARRIVAL
    stays = jnp.where(reckless, seen.distance < needs, arrive < leave + GAP_MARGIN)
    before_it = (seen.enter > 0.0) & (seen.enter < BESIDE) & ~reckless
    stops = before_it & (arrive < leave + STEP_MARGIN)
    unsafe = seen.comes & jnp.where(at_kerb, stays, stops) & edge.crosses[:, None]
    return (unsafe | seen.blocks).any(axis=1)


def meetings(
    bodies: Agents, edge: Edge, others: Agents, ego: EgoState, ego_size: jax.Array
) -> Meeting:
    """What pedestrians see of the vehicles; see `must_wait`."""
    cars = once(_cars(others, ego, ego_size))
    way = jax.tree.map(lambda x: x[:, None], once(_ways(bodies, edge)))
    exists = cars.exists & (jnp.abs(cars.z - way.z) < MAX_STEP_Z)  # (W, V + 1)
    # In the frame of the pedestrian: x along its edge, y to its left.
    off_x, off_y = cars.x - way.x, cars.y - way.y
    x, y = way.cos * off_x + way.sin * off_y, way.cos * off_y - way.sin * off_x
    to_x, to_y = way.cos * cars.cos + way.sin * cars.sin, way.cos * cars.sin - way.sin * cars.cos
    front = x - cars.half_length * jnp.abs(to_x) - cars.half_width * jnp.abs(to_y)
    side = jnp.abs(y) - cars.half_length * jnp.abs(to_y) - cars.half_width * jnp.abs(to_x)
    # The nearest place that is still to be walked, as the vehicle sees it.
    off_x = jnp.clip(x, 0.0, way.left) - x
    forward = off_x * to_x - y * to_y
    across = jnp.abs(off_x * to_y + y * to_x)
    distance = jnp.maximum(jnp.sqrt(off_x**2 + y**2) - cars.half_length, 0.0)
    stops_short = cars.stops_in < distance - STOPS_SHORT
    # Where their ways meet if it keeps its lane, or else its direction: the later of the two.
    straight = x + jnp.abs(y) * to_x / jnp.maximum(jnp.abs(to_y), 0.2)
    meet = jnp.clip(jnp.maximum(x, straight), 0.0, way.left)
    return Meeting(
        comes=exists
        & (cars.speed > ROLLING)
        & ~stops_short
        & (forward > 0.0)
        & (across < CONE_SIDE + CONE_SLOPE * forward),
        distance=distance,
        speed=jnp.broadcast_to(cars.speed, x.shape),
        enter=meet - cars.half_width - BESIDE,
        leave=meet + cars.half_width + BESIDE,
        blocks=exists & (x > 0.0) & (front < IN_FRONT) & (side < 0.5 * SIZE),
    )


def _cars(others: Agents, ego: EgoState, ego_size: jax.Array) -> Cars:
    yaw = jnp.append(others.yaw, ego.yaw + ego.slip)
    speed = jnp.append(others.speed, ego.speed)
    braking = jnp.maximum(-jnp.append(others.accel, ego.accel), 0.1)
    return Cars(
        exists=jnp.append(others.kind == KIND_VEHICLE, True),
        x=jnp.append(others.xy[:, 0], ego.xy[0]),
        y=jnp.append(others.xy[:, 1], ego.xy[1]),
        z=jnp.append(others.z, ego.z),
        cos=jnp.cos(yaw),
        sin=jnp.sin(yaw),
        speed=speed,
        stops_in=speed**2 / (2 * braking),
        half_length=0.5 * jnp.append(others.length, ego_size[0]),
        half_width=0.5 * jnp.append(others.width, ego_size[1]),
    )


def _ways(bodies: Agents, edge: Edge) -> Ways:
    return Ways(
        x=bodies.xy[:, 0],
        y=bodies.xy[:, 1],
        z=bodies.z,
        cos=jnp.cos(edge.yaw),
        sin=jnp.sin(edge.yaw),
        left=jnp.maximum(edge.length - edge.along, 0.0),
    )
