"""When pedestrians set out across the road: numbers by hand, and no accident by their fault.

Pace 1.4 m/s, from the kerb at y = -3.9 to the other at 3.9. Cars are 4 m long and 2 m wide and
drive 10 m/s, eastward at y = -1.75, westward at y = 1.75. To be out of an eastward car's way takes
3.9 - 1.75 + 1 + 0.75 = 3.9 m = 2.786 s, with the margin 4.286 s; a car that may be 1.5 m/s faster
comes 49.3 m in that time, and its front is 2 m ahead of its middle: 51.3 m. For a westward car it
is 7.4 m = 5.286 s, 6.786 s, 78.0 m, 80.0 m. A driver needs 10 + 10^2 / (2 * 4) = 22.5 m to stop.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_world import DT, f32, make_ego
from walking_world import EGO_SIZE, car, initial, node_at, street, stroll, walker

from carljax.sim import geometry, population, road_crossing, road_map_builder, town
from carljax.sim.types import Walkers

KERB, FAR_KERB, PAVEMENT = (0.0, -3.9), (0.0, 3.9), (0.0, -4.5)
NUM_WORLDS, NUM_STEPS = 128, 500


@pytest.fixture(scope="module")
def road_map():
    """The street."""
    return road_map_builder.build([town.from_network(street())])


@jax.jit
def look(bodies, walkers, others, ego, road_map):
    edge = road_crossing.edge_of(bodies, walkers, road_map)
    return road_crossing.must_wait(bodies, walkers, edge, others, ego, EGO_SIZE)[0]


def waits(road_map, other, ego=None, start=KERB, at=None, **person):
    """Whether somebody at the kerb (or already at a place) waits for a car."""
    bodies, walkers = walker(road_map, start, FAR_KERB, **person)
    if at is not None:
        bodies = bodies.replace(xy=f32([at]))
    return bool(look(bodies, walkers, other, ego or make_ego(), road_map))


@pytest.mark.parametrize(
    ("x", "y", "yaw", "waiting"),
    [
        (-50.5, -1.75, 0.0, True),
        (-52.5, -1.75, 0.0, False),
        (79.0, 1.75, np.pi, True),
        (81.5, 1.75, np.pi, False),
        (3.5, -1.75, 0.0, False),
        (-3.0, 1.75, np.pi, False),
    ],
    ids=["near", "far enough", "far lane", "far enough in the far lane", "gone", "gone west"],
)
def test_the_careful_wait_until_they_can_be_across(road_map, x, y, yaw, waiting):
    assert waits(road_map, car(x, y, 10.0, yaw)) == waiting


@pytest.mark.parametrize(("x", "waiting"), [(-23.5, True), (-25.5, False)])
def test_the_reckless_leave_drivers_just_the_room_to_stop(road_map, x, waiting):
    assert waits(road_map, car(x, -1.75, 10.0), is_reckless=True) == waiting


# The ego is 4.9 m by 1.8 m: 3.8 m, 2.714 s, 4.214 s, 48.5 m, 50.9 m.
@pytest.mark.parametrize(("x", "waiting"), [(-50.0, True), (-52.0, False)])
def test_the_ego_is_a_car_like_others(road_map, x, waiting):
    ego = make_ego((x, -1.75), 0.0, 10.0)
    assert waits(road_map, population.nobody(1), ego) == waiting


def test_who_runs_needs_less_of_a_gap(road_map):
    # 3.9 m at 2.8 m/s = 1.393 s, 2.893 s, 33.3 m, 35.3 m.
    assert waits(road_map, car(-34.5, -1.75, 10.0), pace=2.8)
    assert not waits(road_map, car(-36.0, -1.75, 10.0), pace=2.8)


def test_they_set_out_before_cars_that_stand(road_map):
    assert not waits(road_map, car(-5.0, -1.75, 0.0))
    assert waits(road_map, car(-5.0, -1.75, 1.0))


@pytest.mark.parametrize(("accel", "waiting"), [(-3.0, False), (-1.0, True), (0.0, True)])
def test_they_see_that_a_car_brakes_to_a_halt(road_map, accel, waiting):
    # From 10 m/s it takes 10^2 / (2 * 3) = 16.7 m or 50 m; there are 38 m to its front.
    assert waits(road_map, car(-40.0, -1.75, 10.0).replace(accel=f32([accel]))) == waiting


@pytest.mark.parametrize("is_reckless", [False, True])
def test_nobody_walks_into_a_car_that_stands_on_the_crosswalk(road_map, is_reckless):
    # Its side is at y = -2.75, 1.15 m from the kerb.
    assert waits(road_map, car(0.0, -1.75, 0.0), is_reckless=is_reckless)
    assert not waits(road_map, car(2.5, -1.75, 0.0), is_reckless=is_reckless)


def test_a_car_out_of_a_bend_is_seen_too(road_map):
    # It comes on an arc of 40 m radius that ends 10 m before the crosswalk: 30 m of way, so it
    # needs 3 s, but in a straight line it would pass far from here.
    angle = 20.0 / 40.0
    x, y = -10.0 - 40.0 * np.sin(angle), -1.75 - 40.0 * (1.0 - np.cos(angle))
    assert waits(road_map, car(x, y, 10.0, angle))


def test_other_levels_and_empty_rows_do_not_matter(road_map):
    one = car(-20.0, -1.75, 10.0)
    assert not waits(road_map, one.replace(z=f32([8.0])))
    assert not waits(road_map, one.replace(kind=jnp.zeros(1, jnp.int32)))


def test_on_the_road_they_stop_before_a_lane_that_a_car_is_about_to_take(road_map):
    # At y = -0.6 the westward car's side, y = 0.75, is 1.35 m away, its way with 0.75 m beside it
    # 0.6 m; to be out of it takes 2.35 + 1.75 = 4.1 m, 2.93 s, and with half a second 3.43 s, in
    # which a car that may be faster comes 39.4 m. With one foot in it they go on.
    assert waits(road_map, car(38.0, 1.75, 10.0, np.pi), at=(0.0, -0.6))
    assert not waits(road_map, car(44.0, 1.75, 10.0, np.pi), at=(0.0, -0.6))
    assert not waits(road_map, car(38.0, 1.75, 10.0, np.pi), at=(0.0, 0.3))
    assert not waits(road_map, car(38.0, 1.75, 10.0, np.pi), at=(0.0, -0.6), is_reckless=True)


def test_along_the_pavement_nobody_minds_the_cars(road_map):
    bodies, walkers = walker(road_map, PAVEMENT, (3.0, -4.5))
    assert not bool(look(bodies, walkers, car(-10.0, -1.75, 10.0), make_ego(), road_map))


def stream(rng):
    """Cars of two lanes at constant speed with random gaps, and one pedestrian's traits."""
    rows = []
    for y, yaw in ((-1.75, 0.0), (1.75, np.pi)):
        speed = rng.uniform(3.0, 16.0)
        behind = np.cumsum(speed * rng.uniform(1.0, 14.0, 6) + 5.0) - rng.uniform(0.0, 60.0)
        rows += [(-np.cos(yaw) * b, y, speed, yaw) for b in behind]
    return np.array(rows), rng.uniform(0.9, 2.8)


@pytest.fixture(scope="module")
def strolls(road_map):
    """50 s in many streets: half of the people are reckless; bodies, walkers, cars over time."""
    rng = np.random.default_rng(0)
    cars, pace = zip(*(stream(rng) for _ in range(NUM_WORLDS)), strict=True)
    cars = np.array(cars)
    one = car(0.0, 0.0, 0.0)
    num = cars.shape[1]
    others = jax.tree.map(lambda x: jnp.broadcast_to(x, (NUM_WORLDS, num, *x.shape[1:])), one)
    others = others.replace(xy=f32(cars[..., :2]), speed=f32(cars[..., 2]), yaw=f32(cars[..., 3]))
    place = (NUM_WORLDS, 1)
    walkers = Walkers(
        node=jnp.full(place, node_at(road_map, *PAVEMENT), jnp.int32),
        target=jnp.full(place, node_at(road_map, *KERB), jnp.int32),
        pace=f32(pace)[:, None],
        offset=f32(rng.uniform(-0.4, 0.4, place)),
        is_reckless=jnp.asarray(np.arange(NUM_WORLDS) % 2 == 1)[:, None],
    )
    bodies = jax.vmap(initial, in_axes=(0, None))(walkers, road_map)
    keys = jax.random.split(jax.random.key(0), NUM_WORLDS)
    run = jax.jit(
        jax.vmap(
            lambda m, b, w, c, k: stroll(m, b, w, c, make_ego(), NUM_STEPS, k), (None, 0, 0, 0, 0)
        )
    )
    return jax.tree.map(np.asarray, run(road_map, bodies, walkers, others, keys))


def touches(bodies, cars):
    """(B, T, N) bool."""
    return np.asarray(
        geometry.boxes_overlap(
            bodies.xy, bodies.yaw, 0.5, 0.5, cars.xy, cars.yaw, cars.length, cars.width
        )
    )


def test_the_careful_are_never_struck_even_if_nobody_brakes(strolls):
    bodies, walkers, cars = strolls
    careful = ~walkers.is_reckless[:, 0, 0]
    assert not touches(bodies, cars)[careful].any()


def test_nearly_everybody_comes_across(strolls):
    bodies, walkers, _ = strolls
    across = (bodies.xy[:, :, 0, 1] > 4.0).any(axis=1)
    careful = ~walkers.is_reckless[:, 0, 0]
    assert across[careful].mean() > 0.8 and across[~careful].mean() > 0.8


def test_they_wait_at_the_kerb_and_not_on_the_road(strolls):
    bodies, walkers, _ = strolls
    stands = (bodies.speed[..., 0] < 0.05) & (np.arange(NUM_STEPS) > 10)
    y = abs(bodies.xy[..., 0, 1])
    # 0.3 m past the kerb and the length of a stop from 1.2 m/s, 1.2^2 / (2 * 5) = 0.14 m.
    on_road = stands & (y < 3.9 - 0.3 - 0.15 - 1.2 * DT)
    assert stands.any(axis=1).mean() > 0.3 and on_road.mean() < 0.01


def test_a_driver_could_stop_for_everybody_who_steps_out(strolls):
    bodies, walkers, cars = strolls
    num = 0
    for b in np.flatnonzero(walkers.is_reckless[:, 0, 0]):
        # The moment of stepping out: 0.3 m beyond the kerb.
        t = int(np.argmax(bodies.xy[b, :, 0, 1] > -3.6))
        if t == 0:
            continue
        for n in range(cars.xy.shape[2]):
            x, speed = cars.xy[b, t, n, 0], cars.speed[b, t, n]
            to_go = -x * np.cos(cars.yaw[b, t, n]) - 2.0
            if to_go > 0:  # less the way of two steps: one to look and one to act
                assert to_go > speed + speed**2 / 8.0 - 2 * DT * speed
                num += 1
    assert num > 100
