"""Who is in a vehicle's way off the lanes: by hand on a road and in a bend."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_world import EGO_LENGTH, cars, drive, ego_place, f32, make_ego, with_values

from carljax.sim import corridor
from carljax.sim.types import KIND_PEDESTRIAN


def person(xy, yaw=0.0, speed=0.0):
    """A pedestrian of 0.6 m by 0.6 m."""
    fields = {"kind": KIND_PEDESTRIAN, "xy": xy, "yaw": yaw, "speed": speed}
    fields |= {"length": 0.6, "width": 0.6}
    return with_values(1, {name: [x] for name, x in fields.items()})


@jax.jit
def gaps_jit(agents, others, ego, road_map):
    seen = corridor.obstacles(others, ego, f32(EGO_LENGTH))
    return corridor.gaps(agents, seen, road_map)


def gap(world, others, ego=None, s=30.0, speed=8.0, lanes=None):
    rows = lanes or [world.row("road", k) for k in range(3)]
    agents = cars(world, {"lanes": rows, "lane_s": s, "speed": speed})
    found, along = gaps_jit(agents, others, ego or make_ego(), world.map)
    return float(found[0]), float(along[0])


# The road runs to the east along y = 0 from x = -75; its second lane begins at x = -25. The car is
# 4 m by 2 m and stands at x = -45, its front at -43. It looks 6 m, 8 m/s * 1 s and 64 / 6 = 10.7 m
# beyond its front: to x = -18.3. Its way runs through lane points, so that what lies ahead is known
# to half a metre.


@pytest.mark.parametrize(
    ("xy", "want"),
    [
        ((-35.0, 0.0), 8.0 - 0.3),
        ((-35.0, 1.7), 8.0 - 0.3),  # 1 + 0.3 + 0.5 m to the side belong to a car's way
        ((-35.0, 1.9), None),  # beside
        ((-22.0, 0.0), 21.0 - 0.3),  # on the next lane
        ((-15.0, 0.0), None),  # beyond what it needs to stop
        ((-47.0, 0.0), None),  # behind
    ],
)
def test_somebody_who_stands_in_the_way(world, xy, want):
    got, along = gap(world, person(xy))
    if want is None:
        assert got > 900
    else:
        np.testing.assert_allclose(got, want, atol=0.5)
        assert along == 0.0


@pytest.mark.parametrize(
    ("y", "yaw", "speed", "steps_in"),
    [
        (3.5, -np.pi / 2, 1.4, True),  # at 3.5 - 2.1 = 1.4 m in 1.5 s
        (4.5, -np.pi / 2, 1.4, False),  # at 2.4 m
        (3.5, np.pi / 2, 1.4, False),  # walks away
        (3.5, 0.0, 1.4, False),  # walks along
        (3.5, -np.pi / 2, 0.0, False),  # waits
    ],
)
def test_somebody_about_to_step_into_the_way(world, y, yaw, speed, steps_in):
    got, _ = gap(world, person((-35.0, y), yaw, speed))
    assert (got < 9.0) == steps_in


def test_somebody_who_rides_ahead_is_followed(world):
    got, along = gap(world, person((-35.0, 0.5), 0.0, 3.0))
    np.testing.assert_allclose(got, 8.0 - 0.3, atol=0.5)
    np.testing.assert_allclose(along, 3.0, atol=1e-3)


def test_the_way_bends_with_the_lane(world):
    # Left turn of radius 11.75 m from the east: half-way round is at 45 degrees of the circle about
    # (10, -10), 9.23 m along, at (10 - 11.75 sin 45, -10 + 11.75 cos 45) = (1.69, -1.69).
    left, straight = (list(world.way("plain", "east", way)) for way in ("left", "straight"))
    on, straight_on = person((1.69, -1.69)), person((-4.0, 1.75))
    # The front is at 80 m, where the junction begins; the way is made of straight pieces.
    given = {"s": 78.0, "speed": 5.0}
    np.testing.assert_allclose(gap(world, on, lanes=left, **given)[0], 9.23 - 0.35, atol=0.6)
    assert gap(world, straight_on, lanes=left, **given)[0] > 900
    assert gap(world, on, lanes=straight, **given)[0] > 900
    assert gap(world, straight_on, lanes=straight, **given)[0] < 16.0


def test_an_ego_across_the_road(world):
    got, along = gap(world, person((500.0, 0.0)), make_ego((-30.0, 1.0), np.pi / 2, 6.0))
    # its half width is 0.918 m
    np.testing.assert_allclose(got, -30.0 + 43.0 - 0.918, atol=0.5)
    assert abs(along) < 1e-4


@functools.partial(jax.jit, static_argnames="num_steps")
def drive_past(road_map, agents, others, num_steps):
    key = jax.random.key(0)
    return drive(road_map, agents, f32(0.0), key, make_ego(), ego_place(), num_steps, others=others)


def test_stops_for_a_pedestrian_and_goes_on_when_the_way_is_free(world):
    rows = [world.row("road", k) for k in range(3)]
    agents = cars(world, {"lanes": rows, "lane_s": 10.0, "speed": 9.0})
    path = drive_past(world.map, agents, person((-20.0, 0.0)), 150)
    front = np.asarray(path.xy[:, 0, 0]) + 2.0
    assert (front < -20.3).all() and float(path.speed[-1, 0]) < 0.2 and front[-1] > -25.0
    stopped = jax.tree.map(lambda x: x[-1], path)
    free = drive_past(world.map, stopped, person((-20.0, 4.0)), 150)
    assert float(free.xy[-1, 0, 0]) > 0.0


def test_empty_rows_are_in_nobodys_way(world):
    nobody = person((-35.0, 0.0)).replace(kind=jnp.zeros(1, jnp.int32))
    assert gap(world, nobody)[0] > 900


def near_by_loops(length, width, points, along, users):
    """The nearest obstacle of one agent, in float64: (gap, speed along the way), or None.

    Users are (x, y, yaw, speed, length, width); each counts where it is and where it will be.
    """
    found = []
    for x, y, yaw, speed, long, wide in users:
        for seconds in (0.0, 1.5):
            at = np.array([x, y]) + seconds * speed * np.array([np.cos(yaw), np.sin(yaw)])
            for begin, end, gone in zip(points[:-1], points[1:], along[:-1], strict=True):
                way = np.hypot(*(end - begin))
                angle = np.arctan2(*(end - begin)[::-1])
                cos, sin = np.cos(angle), np.sin(angle)
                ahead, left = np.array([[cos, sin], [-sin, cos]]) @ (at - begin)
                cos_to, sin_to = abs(np.cos(yaw - angle)), abs(np.sin(yaw - angle))
                across = 0.5 * (long * sin_to + wide * cos_to) + 0.5 * width + 0.5
                if abs(left) < across and -0.5 < ahead < way + 0.5 and gone + ahead > 0.3 * length:
                    far = 0.5 * (long * cos_to + wide * sin_to) + 0.5 * length
                    follows = speed * max(np.cos(yaw - angle), 0.0)
                    found.append((gone + ahead - far, follows))
    return min(found, key=lambda pair: (pair[0], -pair[1])) if found else None


def test_random_crowds_match_loops(world):
    rng = np.random.default_rng(0)
    rows = [world.row("road", k) for k in range(3)]
    num = 8
    starts, speeds = rng.uniform(5.0, 45.0, num), rng.uniform(0.0, 15.0, num)
    agents = cars(
        world,
        *({"lanes": rows, "lane_s": s, "speed": v} for s, v in zip(starts, speeds, strict=True)),
    )
    ego = make_ego()
    seen_some = 0
    for _ in range(20):
        crowd = 5
        users = np.stack(
            [
                *(rng.uniform(-75, 10, crowd), rng.uniform(-6, 6, crowd)),
                *(rng.uniform(-3.1, 3.1, crowd), rng.choice([0.0, 1.4, 6.0], crowd)),
                *(rng.uniform(0.4, 2.0, crowd), rng.uniform(0.4, 2.0, crowd)),
            ],
            axis=1,
        )
        fields = dict(zip(("yaw", "speed", "length", "width"), users[:, 2:].T, strict=True))
        others = with_values(
            crowd, {"kind": [KIND_PEDESTRIAN] * crowd, "xy": users[:, :2], **fields}
        )
        got = gaps_jit(agents, others, ego, world.map)
        points, along = (np.asarray(x, np.float64) for x in corridor._way(agents, world.map))
        ego_box = (*ego.xy, ego.yaw, 0.0, EGO_LENGTH, corridor.EGO_WIDTH)
        for k in range(num):
            size = float(agents.length[k]), float(agents.width[k])
            want = near_by_loops(*size, points[k], along[k], [*users, ego_box])
            if want is None:
                assert float(got[0][k]) == corridor.FAR and float(got[1][k]) == 0.0
            else:
                seen_some += 1
                np.testing.assert_allclose((got[0][k], got[1][k]), want, rtol=1e-4, atol=1e-3)
    assert 20 < seen_some < 140
