"""Traffic: leaders, bends and lines by hand; a minute of it in the bundled towns."""

import functools

import jax
import numpy as np
import pytest
from small_world import LIMIT, crossing
from traffic_world import (
    DT,
    cars,
    drive,
    ego_place,
    enters_at,
    f32,
    gap_to_end,
    leaders_jit,
    make_ego,
    overlaps,
    overlaps_jit,
    stop_ahead_jit,
    with_values,
)

from carljax.sim import episodes, lights, town
from carljax.sim.env import TRAFFIC_ACCEL, TRAFFIC_BRAKE
from carljax.sim.idm import IDMParams
from carljax.sim.population import Population
from carljax.sim.types import (
    KIND_NONE,
    KIND_VEHICLE,
    LIGHT_GREEN,
    LIGHT_RED,
    STOP_LIGHT,
    STOP_SIGN,
)

# Leaders


def leader(world, agents, ego=None, place=None):
    stop = stop_ahead_jit(agents, world.map, lights.clock(f32(0.0), 0))
    got = leaders_jit(agents, stop, ego or make_ego(), place or ego_place(), world.map)
    return float(got[0][0]), float(got[1][0])


def on_road(world, *place, **fields):
    """A car on the road of three lanes of 50, 40 and 60 m: (lane number, s)."""
    number, s = place
    rows = [world.row("road", k) for k in range(3)] + [-1, -1]
    return {"lanes": rows[number : number + 3], "lane_s": s} | fields


@pytest.mark.parametrize(
    ("other", "gap"),
    [
        ((0, 48.0), 3.0 - 2.5),  # the same lane: centres 3 m apart, half lengths 2 and 0.5 m
        ((1, 10.0), 5 + 10 - 2.5),
        ((2, 3.0), 5 + 40 + 3 - 2.5),
        ((0, 40.0), None),  # behind
    ],
)
def test_gap_to_the_car_ahead_across_lanes(world, other, gap):
    # 5 m before the end of a lane of 50 m; the next one is 40 m long.
    agents = cars(world, on_road(world, 0, 45.0), on_road(world, *other, length=1.0, speed=7.0))
    got, speed = leader(world, agents)
    if gap is None:
        assert got > 900
    else:
        np.testing.assert_allclose(got, gap, atol=1e-4)
        assert speed == 7.0


def test_the_nearest_of_several_leads(world):
    spots = [((2, 3.0), 1.0), ((1, 10.0), 2.0), ((1, 30.0), 3.0), ((0, 30.0), 4.0)]
    others = [on_road(world, *spot, speed=speed) for spot, speed in spots]
    got = leader(world, cars(world, on_road(world, 0, 45.0), *others))
    np.testing.assert_allclose(got, [5 + 10 - 2 - 2, 2.0], atol=1e-4)


def test_empty_slots_lead_nobody(world):
    other = on_road(world, 1, 10.0, kind=KIND_NONE)
    assert leader(world, cars(world, on_road(world, 0, 45.0), other))[0] > 900


def test_the_ego_leads_too(world):
    place = ego_place(world.row("road", 1), -1, 12.0)
    got = leader(world, cars(world, on_road(world, 0, 45.0)), make_ego(speed=3.0), place)
    # half lengths 2.45 and 2 m
    np.testing.assert_allclose(got, [5 + 12 - 2.45 - 2, 3.0], atol=1e-4)


def test_follows_by_idm(world):
    # Gap 5 + 10 - 4 = 11 m, 8 m/s behind 5 m/s, free speed 10 m/s:
    # s* = 2 + 8 * 1 + 8 * 3 / (2 sqrt(1 * 1.5)) = 19.798
    # a = 1 - 0.8^4 - (19.798 / 11)^2 = 1 - 0.4096 - 3.2394 = -2.649
    agents = cars(world, on_road(world, 0, 45.0, speed=8.0), on_road(world, 1, 10.0, speed=5.0))
    path = world.run(agents)
    np.testing.assert_allclose(path.accel[1, 0], -2.649, atol=2e-3)
    # moved with the mean of both speeds: 0.1 * (8 + 8 - 0.2649) / 2
    np.testing.assert_allclose(path.lane_s[1, 0], 45 + 0.78676, atol=1e-3)
    np.testing.assert_allclose(path.speed[1, 0], 8 - 0.2649, atol=1e-3)


def test_on_a_free_road_the_limit_is_reached_and_kept(world):
    lanes = world.way("plain", "east", "straight")
    path = world.run(cars(world, {"lanes": lanes, "lane_s": 2.0, "desired_speed_frac": 0.8}))
    assert path.speed[:, 0].max() <= 0.8 * LIMIT + 1e-3
    assert path.speed[:, 0].max() > 0.9 * 0.8 * LIMIT


def test_bends_are_taken_slowly(world):
    # Left turn of radius 11.75 m: sqrt(2.5 * 11.75) = 5.42 m/s; IDM nears it by and by.
    lanes = world.way("plain", "east", "left")
    path = world.run(cars(world, {"lanes": lanes, "lane_s": 2.0, "speed": 9.0}))
    inside = path.lanes[:, 0, 0] == lanes[1]
    assert inside.sum() > 20
    assert path.speed[inside, 0].max() < 7.5 and path.speed[inside, 0][-1] < 5.42 * 1.05
    yaw_rate = path.speed[inside, 0] / 11.75
    np.testing.assert_allclose(path.yaw_rate[inside, 0][1:-1], yaw_rate[1:-1], rtol=0.05)


def test_stops_before_a_dead_end_and_stays(world):
    path = world.run(cars(world, on_road(world, 2, 5.0, speed=8.0)))
    left = gap_to_end(world, path, 0, world.row("road", 2))
    assert 0.5 < left[-1] < 6.0 and path.speed[-1, 0] < 0.05
    assert (left > 0).all()


def test_empty_slots_stay_where_they_are(world):
    path = world.run(cars(world, on_road(world, 0, 5.0)))
    assert (path.speed[:, 1:] == 0).all() and (path.kind[:, 1:] == KIND_NONE).all()
    assert (path.lane_s[:, 1:] == 0).all()


def random_cars(table, num, rng):
    """Agents on some lanes of a town, dense enough to follow one another."""
    lanes = rng.choice(len(table.length), 40, replace=False)
    plans = np.full((num, 3), -1)
    for i in range(num):
        plans[i, 0] = rng.choice(lanes)
        for k in (1, 2):
            onward = table.successors[plans[i, k - 1]]
            plans[i, k] = rng.choice(onward[onward >= 0])
    values = {
        "lanes": plans,
        "lane_s": rng.uniform(0, 1, num) * np.minimum(table.length[plans[:, 0]], 40.0),
        "speed": rng.uniform(0, 12, num),
        "length": rng.uniform(3.6, 5.4, num),
        "kind": np.where(rng.uniform(size=num) < 0.9, KIND_VEHICLE, KIND_NONE),
    }
    return with_values(num, values)


def leader_oracle(table, agents, i):
    """Nearest car on the plan of car i."""
    plan, s = agents.lanes[i], float(agents.lane_s[i])
    best = (np.inf, 0.0)
    begins = -s  # of the lane under consideration, as seen from the car
    for k, lane in enumerate(plan):
        if lane < 0:
            break
        for j in range(len(agents.kind)):
            if j == i or agents.kind[j] == KIND_NONE:
                continue
            theirs, at = int(agents.lanes[j, 0]), float(agents.lane_s[j])
            if theirs != lane:
                continue
            if k == 0 and at <= s:
                continue
            gap = begins + at - float(agents.length[i] + agents.length[j]) / 2
            best = min(best, (gap, float(agents.speed[j])))
        begins += float(table.length[lane])
    return best


def test_leaders_match_a_float64_oracle(bank, bundled):
    rng = np.random.default_rng(0)
    table = bundled[TOWN_ORDER[0]].lanes  # its rows come first in the shared table
    num_led = 0
    for _ in range(4):
        agents = random_cars(table, 96, rng)
        stop = stop_ahead_jit(agents, bank.road_map, lights.clock(f32(0.0), 0))
        gap, speed = leaders_jit(agents, stop, make_ego(), ego_place(), bank.road_map)
        host = jax.tree.map(np.asarray, agents)
        for i in np.flatnonzero(host.kind):
            want, want_speed = leader_oracle(table, host, i)
            if np.isinf(want):
                assert gap[i] > 900
                continue
            num_led += 1
            np.testing.assert_allclose(gap[i], want, atol=1e-3)
            np.testing.assert_allclose(speed[i], want_speed, atol=1e-5)
    assert num_led > 100


# Lines


def test_stops_at_red_and_goes_on_green(world):
    start, cycle = world.light("east")
    lanes = world.way("lights", "east", "straight")
    # Red from 13 s after green: 17 s of the cycle of 30 s are left; 60 m at 8 m/s.
    time = start + 13.0
    path = world.run(cars(world, {"lanes": lanes, "lane_s": 18.0, "speed": 8.0}), time)
    gap = gap_to_end(world, path, 0, lanes[0])
    waits = int((cycle - 13.0) / DT)
    assert gap[waits] > 0.5 and gap[waits] < 4.5  # within the car's wish for 2 m and the 1 m kept
    assert path.speed[waits, 0] < 0.3
    assert (gap[: waits + 1] > 0).all()
    assert path.speed[waits + 30, 0] > 1.0
    assert enters_at(path, 0, lanes[0]) < waits + 60


@pytest.mark.parametrize(("distance", "goes"), [(20.0, False), (10.0, True)])
def test_yellow_with_and_without_room(world, distance, goes):
    # 9 m/s at 3 m/s^2 need 13.5 m; 10 m take 1.1 s of the 3 s of yellow.
    start, _ = world.light("east")
    lanes = world.way("lights", "east", "straight")
    at = 80.0 - distance - 2.0  # its front bumper is 2 m ahead of its centre
    path = world.run(cars(world, {"lanes": lanes, "lane_s": at, "speed": 9.0}), start + 10.05)
    crossed = ~(gap_to_end(world, path, 0, lanes[0]) > 0)
    if goes:
        assert crossed[20]
    else:
        assert not crossed[: int(19.0 / DT)].any()  # until it is green again, 20 s later


def test_halts_at_a_stop_sign_and_goes(world):
    lanes = world.way("signs", "north", "straight")
    path = world.run(cars(world, {"lanes": lanes, "lane_s": 40.0, "speed": 8.0}))
    gap = gap_to_end(world, path, 0, lanes[0])
    halted = np.flatnonzero(path.speed[:, 0] < 0.2)
    assert len(halted) > 0 and 0 < gap[halted[0]] < 4.0
    goes = enters_at(path, 0, lanes[0])
    assert goes - halted[0] < 80 and path.speed[goes + 10, 0] > 2.0


def test_a_stop_sign_is_for_its_own_arms_only(world):
    lanes = world.way("signs", "east", "straight")
    path = world.run(cars(world, {"lanes": lanes, "lane_s": 40.0, "speed": 8.0}))
    assert path.speed[:60, 0].min() > 7.5


# A minute in the bundled towns

TOWN_ORDER = ("grid", "highway", "village")
ENVS, CARS, MINUTE = 8, 24, 600
DRIVER = IDMParams(accel_max=TRAFFIC_ACCEL, comfort_brake=TRAFFIC_BRAKE)  # the environment's


@pytest.fixture(scope="module")
def bank(bundled):
    there = [bundled[name] for name in TOWN_ORDER]
    return episodes.make_bank(there, 66, Population(CARS, 0, 0), seed=3, route_length=400.0)


@pytest.fixture(scope="module")
def minute(bank):
    """A minute of traffic in 8 environments of each town, nobody else about: (24, 601, N)."""
    num = ENVS * len(TOWN_ORDER)

    @jax.jit
    def run(road_map, agents, time, keys):
        one = functools.partial(drive, num_steps=MINUTE, driver=DRIVER)
        over = jax.vmap(one, in_axes=(None, 0, 0, 0, None, None))
        path = over(road_map, agents, time, keys, make_ego(), ego_place())
        return path, jax.lax.map(overlaps, path).any(axis=(2, 3))

    agents = jax.tree.map(lambda x: x[:num], bank.agents)
    time = jax.random.uniform(jax.random.key(1), (num,), maxval=600.0)
    path, touching = run(bank.road_map, agents, time, jax.random.split(jax.random.key(2), num))
    return jax.tree.map(np.asarray, path), np.asarray(touching), np.asarray(time)


def of_town(values, number):
    return jax.tree.map(lambda x: x[number :: len(TOWN_ORDER)], values)


@pytest.mark.parametrize("name", TOWN_ORDER)
def test_cars_hardly_ever_touch(minute, name):
    _, touching, _ = minute
    # Measured: no pair in 8 x 60 s in any of the towns.
    assert of_town(touching, TOWN_ORDER.index(name)).mean() < 0.01


def test_lane_changes_touch_nobody(minute):
    path, touching, _ = (of_town(x, TOWN_ORDER.index("highway")) for x in minute)
    changing = path.from_lane >= 0
    assert (changing[:, 1:] & ~changing[:, :-1]).sum() > 20
    assert not touching[changing.any(axis=2)].any()


@pytest.mark.parametrize("name", TOWN_ORDER)
def test_traffic_keeps_flowing(minute, name):
    path = of_town(minute[0], TOWN_ORDER.index(name))
    last = path.speed[:, -MINUTE // 3 :][(path.kind != KIND_NONE)[:, -MINUTE // 3 :]]
    assert last.mean() > 1.5


def test_nobody_leaves_its_lane_or_jumps(minute, bank):
    path, rows = minute[0], jax.tree.map(np.asarray, bank.road_map)
    used = path.kind != KIND_NONE
    lane, before = path.lanes[:, 1:, :, 0][used[:, 1:]], path.lanes[:, :-1, :, 0][used[:, 1:]]
    same = lane == before
    onward = (rows.lane_successors[before] == lane[:, None]).any(axis=1)
    changes = path.from_lane[:, 1:][used[:, 1:]] == before  # to a lane beside
    # lanes shorter than a step may be passed at once
    assert (same | onward | changes).mean() > 0.9999 and changes.sum() > 20
    lane_s = path.lane_s[used]
    assert (lane_s >= 0).all() and (
        lane_s <= rows.lane_length[path.lanes[..., 0][used]] + 0.01
    ).all()
    step = np.hypot(*np.moveaxis(np.diff(path.xy, axis=1), -1, 0))[used[:, 1:]]
    # Speed times dt, and up to 5 cm where the ends of two lanes do not meet exactly; sideways at
    # most 1.6 m/s and a quarter of the speed: sqrt(1 + 1 / 16) = 1.031 times as far.
    assert (step <= path.speed[:, :-1][used[:, 1:]] * DT * 1.031 + 0.05 + 0.02).all()
    nearest = rows.point_xy[
        rows.lane_start[path.lanes[..., 0][used]]
        + np.rint(
            lane_s
            / rows.lane_length[path.lanes[..., 0][used]]
            * (rows.lane_num_points[path.lanes[..., 0][used]] - 1)
        ).astype(int)
    ]
    assert (np.hypot(*(path.xy[used] - nearest).T) < 0.51 + np.abs(path.lateral[used])).all()
    assert np.abs(path.lateral[used]).max() < 4.0


def crossings(path, rows, kind):
    """(environment, step, slot, lane) of each front bumper that crosses a line of that kind."""
    front = path.lane_s + path.length / 2
    length = rows.lane_length[path.lanes]
    begins = np.zeros((*path.lanes.shape[:3], 3))
    begins[..., 1] = length[..., 0]
    begins[..., 2] = length[..., 0] + length[..., 1]
    line = begins + rows.lane_stop_s[path.lanes] - front[..., None]  # ahead of the front
    held = (rows.lane_stop_kind[path.lanes] == kind) & (path.lanes >= 0)
    held &= (path.kind != KIND_NONE)[..., None]
    moved = np.diff(path.lane_s, axis=1)
    changed = path.lanes[:, 1:, :, 0] != path.lanes[:, :-1, :, 0]
    moved = np.where(changed, moved + length[:, :-1, :, 0], moved)[..., None]
    beside = changed & (path.from_lane[:, 1:] == path.lanes[:, :-1, :, 0])  # a lane change
    over = held[:, :-1] & (line[:, :-1] > 0) & (line[:, :-1] - moved <= 0) & ~beside[..., None]
    env, step, slot, k = np.nonzero(over)
    return env, step, slot, path.lanes[env, step, slot, k]


def test_nobody_runs_a_red_light(minute, bank):
    path, _, time = minute
    rows = jax.tree.map(np.asarray, bank.road_map)
    env, step, slot, lane = crossings(path, rows, STOP_LIGHT)
    light = rows.lane_light[lane]
    colour = jax.jit(lights.state)(
        f32(time[env] + step * DT), f32(rows.light_start[light]), f32(rows.light_cycle[light])
    )
    colour = np.asarray(colour)
    assert len(lane) > 100 and (colour == LIGHT_GREEN).mean() > 0.6
    # Whoever had no room to stop at yellow has passed before red.
    assert (colour == LIGHT_RED).sum() == 0


def test_everybody_halts_at_stop_signs(minute, bank):
    path, rows = minute[0], jax.tree.map(np.asarray, bank.road_map)
    env, step, slot, _ = crossings(path, rows, STOP_SIGN)
    late = step > 100  # the others may have begun beyond the place to halt
    assert late.sum() > 10
    for e, k, i in zip(env[late], step[late], slot[late], strict=True):
        assert path.speed[e, k - 100 : k, i].min() < 0.25


# Where traffic stands at first


def test_nobody_overlaps_at_the_start(bank):
    assert bank.num_episodes >= 64
    assert not overlaps_jit(bank.agents).any()


def test_the_start_is_free_around_the_ego_and_filled_around_that(bank):
    path, start = jax.tree.map(np.asarray, bank.agents), np.asarray(bank.routes.xy[:, 0])
    used = path.kind != KIND_NONE
    away = np.hypot(*np.moveaxis(path.xy - start[:, None], -1, 0))[used]
    assert away.min() > 18.0 - 1e-3 and away.max() < 140.0 + 1e-3
    num = used.sum(axis=1)
    assert num.min() >= 1 and num.max() <= CARS and len(set(num)) > 5
    # every town in turn
    town = np.asarray(bank.road_map.lane_town)[path.lanes[:, 0, 0]]
    assert town.tolist() == [k % 3 for k in range(66)]
    np.testing.assert_array_equal(np.asarray(bank.routes.town), town)


def test_nobody_starts_faster_than_can_be_stopped(bank):
    path, rows = jax.tree.map(np.asarray, bank.agents), jax.tree.map(np.asarray, bank.road_map)
    for e in range(bank.num_episodes):
        for i in np.flatnonzero(path.kind[e]):
            lane, s, speed = path.lanes[e, i, 0], path.lane_s[e, i], path.speed[e, i]
            on = (path.kind[e] != KIND_NONE) & (path.lanes[e, :, 0] == lane)
            ahead = path.lane_s[e][on & (path.lane_s[e] > s)] - 6.0
            limit = min([*ahead, rows.lane_length[lane] - 3.0]) - s
            assert speed <= rows.lane_speed_limit[lane] + 1e-4
            assert speed**2 <= 2 * 2.0 * max(limit, 0.0) + 1e-3  # 2 m/s^2


def test_the_same_seed_gives_the_same_bank():
    there = [town.from_network(crossing())]
    room = Population(8, 0, 0)
    one, again = (episodes.make_bank(there, 4, room, seed=0, route_length=30.0) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, one, again)
    assert len({x.tobytes() for x in np.asarray(one.agents.xy)}) == 4
