"""A street with pavements and a crosswalk, and pedestrians run for a while among cars.

The street leads east from x = -100 to 100: one lane each way, 3.5 m wide, then at y = 3.5 to 5.5
and -3.5 to -5.5 pavements of 2 m. The crosswalk lies at x = 0, 3 m wide. Kerbs are 0.6 m from a
pavement's edge, so at y = -4.1 and 4.1.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from small_world import network, straight
from traffic_world import DRIVER, DT, EGO_LENGTH, ego_place, f32, make_ego, with_values

from carljax.sim import crowd, lights, pedestrians, traffic
from carljax.sim.types import KIND_VEHICLE, Walkers

EGO_SIZE = f32([EGO_LENGTH, 1.8])
CROSSWALK = np.array([[-1.5, -3.5, 0], [1.5, -3.5, 0], [1.5, 3.5, 0], [-1.5, 3.5, 0]])


def street():
    """The street as a road network."""
    widths = np.full(201, 2.0)
    return network(
        [
            straight((-100, -1.75), (100, -1.75)),
            straight((100, 1.75), (-100, 1.75)),
            straight((-100, -4.5), (100, -4.5), kind="sidewalk", width=widths),
            straight((-100, 4.5), (100, 4.5), kind="sidewalk", width=widths),
        ],
        crosswalks=(CROSSWALK,),
        name="street",
    )


def node_at(road_map, x, y):
    """The node nearest to a place."""
    xyz = np.asarray(road_map.walk_xyz)[:-1]
    return int(np.argmin(np.hypot(xyz[:, 0] - x, xyz[:, 1] - y)))


def walker(road_map, start, end, pace=1.4, offset=0.0, is_reckless=False):
    """Somebody who stands at a node and is about to walk to another: body and mind, one row."""
    walkers = Walkers(
        node=jnp.array([node_at(road_map, *start)], jnp.int32),
        target=jnp.array([node_at(road_map, *end)], jnp.int32),
        pace=f32([pace]),
        offset=f32([offset]),
        is_reckless=jnp.array([is_reckless]),
    )
    return initial(walkers, road_map).replace(speed=f32([0.0])), walkers


def car(x, y, speed, yaw=0.0, width=2.0):
    """A car off the lane graph, one row; it is 4 m long."""
    values = {"xy": [[x, y]], "yaw": [yaw], "speed": [speed], "length": [4.0], "width": [width]}
    return with_values(1, values | {"kind": [KIND_VEHICLE]})


def stroll(road_map, bodies, walkers, cars, ego, num_steps, key):
    """Pedestrians among cars that go straight on at constant speed: all steps of all three."""

    def step(carry, key):
        bodies, walkers, cars = carry
        ahead = jnp.stack([jnp.cos(cars.yaw), jnp.sin(cars.yaw)], axis=-1)
        cars = cars.replace(xy=cars.xy + DT * cars.speed[:, None] * ahead)
        after = pedestrians.step(bodies, walkers, cars, ego, EGO_SIZE, road_map, key, DT)
        return (*after, cars), (*after, cars)

    return jax.lax.scan(step, (bodies, walkers, cars), jax.random.split(key, num_steps))[1]


def live(road_map, cars, bodies, walkers, key, num_steps):
    """Pedestrians among traffic, no ego: cars, bodies and walkers of all steps."""
    ego, place = make_ego(), ego_place()

    def step(carry, key):
        cars, bodies, walkers, time = carry
        key_cars, key_walk = jax.random.split(key)
        clock = lights.clock(time, 0)
        cars = traffic.step(
            cars, bodies, ego, f32(EGO_LENGTH), place, road_map, clock, key_cars, DRIVER, DT
        )
        after = pedestrians.step(bodies, walkers, cars, ego, EGO_SIZE, road_map, key_walk, DT)
        return (cars, *after, time + DT), (cars, *after)

    start = (cars, bodies, walkers, f32(0.0))
    return jax.lax.scan(step, start, jax.random.split(key, num_steps))[1]


def crowds(graph, radius_at, num, rng):
    """Walkers (B, num) of a town, NumPy, around the given places (B, 2)."""
    drawn = [crowd.draw(graph, 0, at, 4 * num, rng) for at in radius_at]
    rows = [np.flatnonzero(one.node >= 0)[:num] for one in drawn]
    kept = [jax.tree.map(lambda x, r=r: x[r], one) for one, r in zip(drawn, rows, strict=True)]
    return jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *kept)


def to_pavement(net, xy):
    """(n,) m from places to the edge of the nearest pavement, negative on it."""
    best = np.full(len(xy), 50.0)
    for one in net.lanes:
        if one.kind != "sidewalk":
            continue
        low, high = one.xyz[:, :2].min(axis=0) - 10, one.xyz[:, :2].max(axis=0) + 10
        near = np.flatnonzero(((xy > low) & (xy < high)).all(axis=1))
        a, d = one.xyz[:-1, :2], np.diff(one.xyz[:, :2], axis=0)
        t = np.einsum("npi,pi->np", xy[near, None] - a, d) / np.maximum((d**2).sum(axis=1), 1e-12)
        foot = a + np.clip(t, 0, 1)[..., None] * d
        away = np.hypot(*np.moveaxis(xy[near, None] - foot, -1, 0)) - one.width[:-1] / 2
        best[near] = np.minimum(best[near], away.min(axis=1, initial=50.0))
    return best


def inside(polygon, xy):
    """Whether places (n, 2) lie in a polygon: an odd number of its sides lies to their right."""
    odd = np.zeros(len(xy), bool)
    for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        spans = (y0 > xy[:, 1]) != (y1 > xy[:, 1])
        with np.errstate(divide="ignore", invalid="ignore"):
            at = x0 + (xy[:, 1] - y0) / (y1 - y0) * (x1 - x0)
        odd ^= spans & (xy[:, 0] < at)
    return odd


initial = jax.jit(pedestrians.initial)
stroll_jit = jax.jit(stroll, static_argnums=5)
live_all = jax.jit(jax.vmap(live, in_axes=(None, 0, 0, 0, 0, None)), static_argnums=5)
