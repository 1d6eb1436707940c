"""The parts of the planners against NumPy, Shapely and geometry worked out by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from small_world import LEFT_RADIUS
from traffic_world import cars, f32, make_ego, with_values

from carljax.planners import controls, forecast, gate, lane_change, leader, pace
from carljax.planners import way as way_module
from carljax.planners.way import SAMPLES, Way
from carljax.sim import bicycle, lights, route
from carljax.sim.bicycle import VehicleParams
from carljax.sim.population import Population
from carljax.sim.types import KIND_NONE, KIND_PEDESTRIAN, KIND_VEHICLE

CAR = VehicleParams()
CLOCK = lights.clock(f32(0.0), 0)
others = jax.jit(forecast.others, static_argnums=(1, 4))
hits = jax.jit(forecast.hits)
in_way = jax.jit(leader.in_way)
slowed_before = jax.jit(pace.slowed_before)
wanted = jax.jit(pace.wanted)
ego_distances = jax.jit(forecast.ego_distances, static_argnums=3)
next_gate = jax.jit(gate.next_gate)
postpone = jax.jit(lane_change.postpone)


def way_along(xy, yaw, curvature):
    """A way through SAMPLES places, without lanes."""
    zeros = jnp.zeros(SAMPLES, jnp.int32)
    return Way(
        xy=f32(xy),
        yaw=f32(yaw),
        curvature=jnp.full(SAMPLES, curvature, jnp.float32),
        speed_limit=jnp.full(SAMPLES, 10.0, jnp.float32),
        in_junction=zeros > 0,
        lane=zeros,
        lane_s=f32(np.arange(SAMPLES)),
        stop_distance=jnp.full(1, jnp.inf, jnp.float32),
    )


def circle(radius, start=0.0):
    """A way to the left around (0, radius), from the origin on or `start` m further."""
    angle = (start + np.arange(SAMPLES)) / radius
    xy = np.stack([radius * np.sin(angle), radius - radius * np.cos(angle)], axis=-1)
    return way_along(xy, angle, 1.0 / radius)


STRAIGHT = way_along(
    np.stack([np.arange(SAMPLES), np.zeros(SAMPLES)], axis=-1), np.zeros(SAMPLES), 0.0
)


def box(xy, yaw, length, width):
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * np.array([length, width]) / 2
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    return shapely.Polygon(corners @ turn + np.asarray(xy))


def crowd(seed, num=150):
    """Cars and pedestrians anywhere on 50 m by 40 m, some rows empty."""
    rng = np.random.default_rng(seed)
    return with_values(
        num,
        {
            "xy": rng.uniform([0, -20], [50, 20], (num, 2)),
            "yaw": rng.uniform(-np.pi, np.pi, num),
            "speed": rng.uniform(0, 12, num),
            "length": rng.uniform(0.5, 9.0, num),
            "width": rng.uniform(0.5, 2.5, num),
            "kind": rng.choice([KIND_NONE, KIND_VEHICLE, KIND_PEDESTRIAN], num),
        },
    )


# Pace


def test_slowed_before_is_the_lowest_braking_curve():
    rng = np.random.default_rng(0)
    speed = rng.uniform(2.0, 20.0, SAMPLES)
    want = [
        min(np.sqrt(speed[j] ** 2 + 2 * 2.0 * (j - k)) for j in range(k, SAMPLES))
        for k in range(SAMPLES)
    ]
    np.testing.assert_allclose(slowed_before(f32(speed)), want, rtol=2e-4)


def test_bends_are_taken_at_a_comfortable_speed():
    # sqrt(3.0 * 12) = 6.0 m/s
    np.testing.assert_allclose(wanted(circle(12.0), 1.0), 6.0, rtol=1e-5)
    np.testing.assert_allclose(wanted(circle(120.0), 0.5), 5.0, rtol=1e-5)


# Controls


@pytest.mark.parametrize("speed", [2.0, 6.0, 12.0])
@pytest.mark.parametrize("radius", [8.0, 30.0])
def test_on_a_circle_pursuit_stays_on_it(radius, speed):
    # The car's own steering for the circle: sin(slip) = l_r / radius, which the yaw lags behind.
    slip = np.arcsin(CAR.rear_length / radius)
    ego = make_ego((0.0, 0.0), -slip, speed)
    steer = controls.steering(ego, circle(radius), CAR)
    want = np.arctan(np.tan(slip) * (CAR.rear_length + CAR.front_length) / CAR.rear_length)
    # The way is a polygon with corners every metre, so not quite.
    assert float(steer) == pytest.approx(want / CAR.wheel_angle_max, rel=0.04)


def test_a_turn_is_driven_along_the_middle_of_the_lane():
    # Straight on for 20 m, then round a corner of 8 m, the tightest of a town: at 4.9 m/s.
    arc = np.clip((np.arange(300) * 0.2 - 20.0) / 8.0, 0.0, np.pi / 2)
    past = np.maximum(np.arange(300) * 0.2 - 20.0 - 8.0 * np.pi / 2, 0.0)
    x = np.minimum(np.arange(300) * 0.2, 20.0) + 8.0 * np.sin(arc)
    line = np.stack([x, 8.0 - 8.0 * np.cos(arc) + past], axis=-1)
    ego, worst = make_ego((0.0, 0.0), 0.0, 4.9), 0.0
    step = jax.jit(lambda e, w: bicycle.step(e, controls.steering(e, w, CAR), 0.0, 0.0, CAR, 0.1))
    for _ in range(75):
        nearest = int(np.hypot(*(line - np.asarray(ego.xy)).T).argmin())
        at = np.minimum(nearest + 5 * np.arange(SAMPLES), 299)
        ego = step(ego, way_along(line[at], np.zeros(SAMPLES), 0.0))
        worst = max(worst, np.hypot(*(line - np.asarray(ego.xy)).T).min())
    assert float(ego.xy[1]) > 12.0 and worst < 0.25


@pytest.mark.parametrize("accel", [-9.0, -7.0, -0.5, 0.0, 0.5, 2.0])
@pytest.mark.parametrize("speed", [0.5, 8.0, 20.0])
def test_pedals_give_the_acceleration_that_is_wanted(speed, accel):
    pedal = controls.pedal(f32(speed), f32(accel), CAR)
    _, throttle, brake = bicycle.from_action(jnp.stack([f32(0.0), pedal]))
    got = float(bicycle.longitudinal_accel(f32(speed), throttle, brake, CAR))
    assert got == pytest.approx(max(accel, -CAR.brake_max), abs=1e-4)


# The way


@pytest.mark.parametrize("radius", [1e6, 120.0], ids=["straight", "bend"])
@pytest.mark.parametrize("aside", [3.5, -3.0], ids=["left", "right"])
def test_a_lane_change_is_drawn_out(radius, aside):
    # A lane of that radius to the left; the route jumps aside after point 60.
    angle = np.arange(176) / radius
    left = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    middle = radius * np.stack([np.sin(angle), 1.0 - np.cos(angle)], axis=-1)
    raw = middle + np.where(np.arange(176) > 60, aside, 0.0)[:, None] * left
    window = _route(raw, angle)
    xy = np.asarray(way_module.smooth(window, way_module.jumps(window)), float)
    moved = ((xy - middle) * left).sum(axis=1)
    # Nobody moves beyond 20 m before and after; half way over between the two points.
    np.testing.assert_allclose(moved[:40], 0.0, atol=1e-3)
    np.testing.assert_allclose(moved[81:], aside, atol=0.06)
    assert moved[60:62].mean() == pytest.approx(aside / 2, abs=0.05)
    # The steepest part of s + sin s over 40 m is twice its mean slope.
    step = np.diff(moved) * np.sign(aside)
    assert (step > -2e-3).all() and step.max() == pytest.approx(2 * abs(aside) / 41, rel=0.1)


def test_the_way_begins_beside_the_ego_and_goes_on_past_the_end():
    xy = np.stack([np.arange(10.0), np.full(10, 2.0)], axis=-1)
    window = _route(xy, np.zeros(10))
    found = way_module.Stretch(route=window, xy=f32(xy), at=f32(3.4), sideways=jnp.zeros(10))
    way = way_module.ahead(found)
    np.testing.assert_allclose(way.xy[:, 0], 3.4 + np.arange(SAMPLES), atol=1e-4)
    np.testing.assert_allclose(way.xy[:, 1], 2.0, atol=1e-5)
    np.testing.assert_allclose(way.yaw, 0.0, atol=1e-5)
    # A stop line at 7.25 m, just before point 8.
    np.testing.assert_allclose(way.stop_distance, [7.25 - 3.4, np.inf], atol=1e-5)


def _route(xy, yaw):
    num = len(xy)
    line = np.zeros((2, 2))
    ints = jnp.zeros(num, jnp.int32)
    return route.Route(
        xy=f32(xy),
        yaw=f32(yaw),
        s=f32(np.arange(num)),
        lane=ints,
        lane_s=f32(np.arange(num)),
        speed_limit=jnp.full(num, 10.0),
        in_junction=ints > 0,
        num_points=jnp.int32(num),
        length=f32(num - 1.0),
        z=f32(0.0),
        town=jnp.int32(0),
        stop_idx=jnp.array([8, -1]),
        stop_xy=f32(line),
        stop_yaw=jnp.zeros(2),
        stop_s=f32([7.25, 0.0]),
        stop_kind=jnp.array([2, 0]),
        stop_light=jnp.array([-1, -1]),
        stop_width=jnp.full(2, 3.5),
        sign_xy=f32(line),
        sign_idx=jnp.array([-1, -1]),
        sign_limit=jnp.zeros(2),
    )


def test_a_lane_change_is_put_off():
    raw = np.stack([np.arange(176.0), np.where(np.arange(176) > 60, 3.5, 0.0)], axis=-1)
    window = _route(raw, np.zeros(176))
    sideways = way_module.jumps(window)
    now, later = (np.asarray(way_module.smooth(window, sideways, x)) for x in (0.0, 10.0))
    np.testing.assert_allclose(later[30:, 1], now[20:-10, 1], atol=1e-4)


# Car 1 m to 60 m along the lane that the route jumps to at 100; the ego is at 78 and goes 10 m/s,
# the change begins at 80, and it decides from 3 + 10 m before.
@pytest.mark.parametrize(
    ("s", "speed", "on", "blocks"),
    [
        (78.0, 10.0, 1, True),  # beside
        (48.0, 10.0, 1, False),  # 25.6 m behind and no faster: 3 + 0.3 * 10 m are enough
        (66.0, 10.0, 1, False),  # 7.6 m behind, no faster
        (66.0, 12.0, 1, True),  # 7.6 m behind, needs 3 + 0.3 * 12 + 2.5 * 2 = 11.6 m
        (86.0, 10.0, 1, True),  # 3.6 m ahead
        (86.0, 10.0, 0, False),  # on the ego's own lane
        (98.0, 2.0, 1, True),  # 15.6 m ahead, needs 3 + 0.3 * 10 + 2.5 * 8 = 26 m
    ],
)
def test_a_lane_change_waits_for_room(world, s, speed, on, blocks):
    raw = np.stack([np.arange(176.0), np.where(np.arange(176) > 99, 3.5, 0.0)], axis=-1)
    window = _route(raw, np.zeros(176))
    window = window.replace(lane=jnp.where(jnp.arange(176) > 99, 1, 0))
    sideways = way_module.jumps(window)
    found = way_module.Stretch(window, f32(raw), f32(78.0), sideways)
    values = {"lanes": [[on, -1, -1]], "lane_s": [s], "speed": [speed], "length": [4.0]}
    agents = with_values(1, {**values, "kind": [KIND_VEHICLE]})
    ego = make_ego((78.0, 0.0), 0.0, 10.0)
    delay, wait = postpone(found, ego, agents, f32(0.0), world.map, CAR)
    if blocks:
        # It stays 13 m ahead, and could be put off by 44 m.
        assert float(delay) == pytest.approx(78 + 13 - 80)
        assert float(wait) == pytest.approx(80 + 44 - 78)
    else:
        assert float(delay) == 0.0 and np.isinf(wait)
    # A junction from 130 on: it has to be over 3 m before, 7 m later than planned at most.
    near = found.replace(route=window.replace(in_junction=jnp.arange(176) >= 130))
    assert float(postpone(near, ego, agents, f32(0.0), world.map, CAR)[0]) == 7.0 * blocks
    # Once it has begun it goes on, and one that lies behind does not put the next one off.
    begun = found.replace(at=f32(90.0))
    assert float(postpone(begun, ego, agents, f32(5.0), world.map, CAR)[0]) == 5.0
    past = found.replace(at=f32(130.0))
    assert float(postpone(past, ego, agents, f32(5.0), world.map, CAR)[0]) == 0.0


# Who is in the way


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("way", [STRAIGHT, circle(25.0)], ids=["straight", "bend"])
def test_gaps_to_those_in_the_way_are_where_the_boxes_meet(seed, way):
    agents = crowd(seed)
    found = in_way(make_ego((0.0, 0.0)), agents, way, CAR)
    fine = np.arange(0.0, leader.RANGE, 0.05)
    xy, yaw = (np.asarray(x) for x in way_module.pose(way, f32(fine)))
    width = CAR.width + 2 * leader.SIDE_MARGIN
    ego = [box(p, a, CAR.length, width) for p, a in zip(xy, yaw, strict=True)]
    rows = (np.asarray(getattr(agents, n)) for n in ("xy", "yaw", "length", "width", "kind"))
    met = 0
    for gap, p, a, length, across, kind in zip(np.asarray(found.gap), *rows, strict=True):
        other = box(p, a, length, across)
        touches = np.array([shapely.intersects(mine, other) for mine in ego]) & (kind != 0)
        if not touches.any():
            # What only a corner brushes for less than a metre may be missed, or seen.
            continue
        first = fine[np.argmax(touches)]
        if touches.sum() * 0.05 > 1.1:
            met += 1
            assert gap == pytest.approx(first, abs=1.05) and gap < first + 0.15
    assert met > 5


# Forecasts


def test_the_ego_goes_on_as_fast_as_it_wants_to():
    desired = np.where(np.arange(SAMPLES) < 12, 8.0, 4.0)
    speed, distance, want = 5.0, 0.0, []
    for _ in range(25):
        goal = np.interp(distance, np.arange(SAMPLES), desired)
        new = min(max(goal, speed - 2.5 * 0.2), speed + 2.5 * 0.2)
        distance += 0.5 * (speed + new) * 0.2
        speed = new
        want.append(distance)
    got = ego_distances(f32(5.0), f32(desired), 2.5, 25)
    np.testing.assert_allclose(got, want, rtol=1e-4)


def test_a_car_is_forecast_along_the_lanes_that_it_means_to_take(world):
    # From 5 m before a left turn of radius 11.75 m at 8 m/s: on the arc after 0.625 s, at an angle
    # of (8 t - 5) / 11.75.
    plan = world.way("plain", "west", "left")
    agents = cars(world, {"lanes": plan, "lane_s": 75.0, "speed": 8.0})
    got = others(agents, Population(8, 0, 0), world.map, CLOCK, 10)
    time = 0.2 * np.arange(1, 11)
    angle = np.maximum(8.0 * time - 5.0, 0.0) / LEFT_RADIUS
    x = np.where(angle > 0, -10 + LEFT_RADIUS * np.sin(angle), -15 + 8.0 * time)
    y = np.where(angle > 0, 10 - LEFT_RADIUS * np.cos(angle), -1.75)
    np.testing.assert_allclose(got.xy[:, 0], np.stack([x, y], axis=-1), atol=0.03)
    np.testing.assert_allclose(got.yaw[:, 0], angle, atol=0.03)


def test_a_car_that_brakes_stands_still_in_the_end(world):
    plan = world.way("plain", "west", "straight")
    agents = cars(world, {"lanes": plan, "lane_s": 10.0, "speed": 4.0}).replace(
        accel=jnp.full(8, -4.0)
    )
    got = others(agents, Population(8, 0, 0), world.map, CLOCK, 10)
    # 4 t - 2 t^2 until t = 1 s
    time = np.minimum(0.2 * np.arange(1, 11), 1.0)
    np.testing.assert_allclose(got.xy[:, 0, 0], -80 + 4 * time - 2 * time**2, atol=1e-3)


def test_a_car_is_trusted_to_halt_at_a_red_light_if_it_can(world):
    start, _ = world.light("west")
    plan = world.way("lights", "west", "straight")
    red = lights.clock(f32(start + 15.0), 0)

    def end(s, speed, accel=0.0):
        agents = cars(world, {"lanes": plan, "lane_s": s, "speed": speed})
        agents = agents.replace(accel=jnp.full_like(agents.accel, accel))
        got = others(agents, Population(8, 0, 0), world.map, red, 25)
        return float(got.xy[-1, 0, 0])

    # Its line is where its front bumper, 2 m ahead, comes to x = -10; without it, it would be at
    # -90 + s + 40 after 5 s. From 8 m/s it takes 32 / d to halt within d: 1.8 m/s^2 in 18 m.
    assert end(60.0, 8.0) == pytest.approx(-12.0, abs=0.05)
    # 5.3 m/s^2 in 6 m.
    assert end(72.0, 8.0) == pytest.approx(22.0, abs=0.05)
    # 2.7 m/s^2 in 12 m: who has not begun to brake does not mean to; with 2 m/s^2 it would come to
    # a halt 16 m on, and is trusted to be at the line.
    assert end(66.0, 8.0) == pytest.approx(16.0, abs=0.05)
    assert end(66.0, 8.0, -2.0) == pytest.approx(-12.0, abs=0.05)
    assert end(66.0, 8.0, -1.0) > 0.0


def test_pedestrians_are_forecast_straight_on(world):
    agents = crowd(0, 12)
    got = others(agents, Population(0, 0, 12), world.map, CLOCK, 5)
    time = 0.2 * np.arange(1, 6)[:, None, None]
    yaw = np.asarray(agents.yaw)
    heading = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1) * np.asarray(agents.speed)[:, None]
    np.testing.assert_allclose(got.xy, np.asarray(agents.xy) + time * heading, atol=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_hits_are_the_moments_at_which_boxes_overlap(world, seed):
    agents, num = crowd(seed), 20
    cast = others(agents, Population(0, 0, 150), world.map, CLOCK, num)
    distances = np.cumsum(np.full(num, 1.2))
    margin = (f32(0.4), f32(0.6))
    way = circle(40.0)
    got = hits(make_ego((0.0, 0.0)), agents, cast, way, f32(distances), CAR, margin)
    xy, yaw = (np.asarray(x) for x in way_module.pose(way, f32(distances)))
    met = 0
    for i in range(150):
        sizes = float(agents.length[i]) + 0.4, float(agents.width[i]) + 0.6
        shared = [
            box(xy[t], yaw[t], CAR.length, CAR.width)
            .intersection(box(cast.xy[t, i], float(cast.yaw[t, i]), *sizes))
            .area
            for t in range(num)
        ]
        if int(agents.kind[i]) == KIND_NONE or max(shared) == 0:
            assert np.isinf(got.gap[i])
            continue
        first = int(np.argmax(np.array(shared) > 0))
        met += 1
        assert float(got.time[i]) == pytest.approx(0.2 * (first + 1))
        assert float(got.gap[i]) == pytest.approx(distances[first - 1] if first else 0.0, rel=1e-5)
    assert met > 5


def test_a_car_that_follows_is_not_braked_for(world):
    lane = world.row("plain", 4)
    values = {"xy": [[-8.0, 0.0]], "speed": [20.0], "length": [4.0], "width": [2.0], "kind": [1]}

    def gap(lanes):
        agents = with_values(1, {**values, "lanes": [lanes]})
        cast = forecast.Forecast(
            xy=jnp.stack([agents.xy + f32([4.0 * t, 0.0]) for t in range(1, 11)]),
            yaw=jnp.zeros((10, 1)),
        )
        way = STRAIGHT.replace(lane=jnp.full(SAMPLES, lane))
        distances = f32(np.arange(1, 11))
        margin = (f32(0.0), f32(0.0))
        ego = make_ego((0.0, 0.0), 0.0, 5.0)
        return float(hits(ego, agents, cast, way, distances, CAR, margin).gap[0])

    assert np.isinf(gap([lane, -1, -1])) and np.isfinite(gap([lane + 1, -1, -1]))


def test_the_gate_is_where_others_have_to_be_minded(world):
    # A left turn 30 m ahead; the map says from where on along it.
    row = world.way("plain", "west", "left")[1]
    distance = np.arange(SAMPLES)
    inside = (distance >= 30) & (distance < 48)
    way = STRAIGHT.replace(
        in_junction=jnp.asarray(inside),
        lane=jnp.where(inside, row, 0),
        lane_s=f32(np.where(inside, distance - 30, 0)),
    )
    begins = 30 + float(world.map.lane_yield_s[row])
    got = float(next_gate(way, world.map, CAR))
    assert got == pytest.approx(begins - CAR.length / 2, abs=1e-4)
    # Past it there is none.
    gone = way.replace(in_junction=way.in_junction & (distance < 3))
    assert np.isinf(next_gate(gone, world.map, CAR))


@pytest.mark.parametrize(
    ("past", "speed", "room"),
    # It halts half a metre before the gate: 9.5 m on, and where that is behind it on the spot.
    [(-10.0, 5.0, 9.5), (-0.4, 0.5, 0.0), (0.3, 0.5, 0.0), (0.7, 0.5, np.inf)]
    # 8 m/s take 4.9 m at nine tenths of the full braking, 6.5 m/s^2: it is too late for that.
    + [(-6.0, 8.0, 5.5), (-4.0, 8.0, np.inf)],
)
def test_it_waits_at_the_gate_for_whoever_crosses_while_it_still_can(world, past, speed, room):
    row = world.way("plain", "west", "left")[1]
    at = CAR.length / 2 - past  # m along the way; somebody crosses it 8 m further on, all the time
    lane_s = np.arange(SAMPLES) - at + float(world.map.lane_yield_s[row])
    way = STRAIGHT.replace(
        in_junction=jnp.asarray(lane_s >= 0),
        lane=jnp.where(lane_s >= 0, row, 0),
        lane_s=f32(np.maximum(lane_s, 0.0)),
    )
    values = {"xy": [[at + 8.0, 0.0]], "yaw": [np.pi / 2], "length": [4.0], "width": [2.0]}
    agents = with_values(1, {**values, "speed": [4.0], "kind": [1], "lanes": [[0, -1, -1]]})
    cast = forecast.Forecast(
        xy=jnp.broadcast_to(agents.xy, (gate.HORIZON, 1, 2)),
        yaw=jnp.full((gate.HORIZON, 1), np.pi / 2),
    )
    distances = f32(np.arange(1, gate.HORIZON + 1) * 0.2 * 6.0)
    ego = make_ego((0.0, 0.0), 0.0, speed)
    nobody = jnp.zeros(1, bool)
    got = gate.gap(ego, agents, cast, way, distances, nobody, f32(0.0), world.map, CAR)
    assert float(got) == pytest.approx(room, abs=1e-3)
