"""The terms of the rewards for nuPlan, of Roach's and of Think2Drive's, at hand-worked values."""

import jax.numpy as jnp
import numpy as np
import pytest
from reward_world import DT, VEHICLE, f32, make_agents, make_ego

from carljax.reward import (
    action,
    collision,
    comfort,
    lane,
    lateral_distance,
    off_road,
    pedestrian_overlap,
    position,
    rotation,
    route_completion,
    survival,
    terminal,
    timer,
    ttc,
)
from carljax.sim.types import KIND_PEDESTRIAN, KIND_STATIC, KIND_VEHICLE


@pytest.mark.parametrize(
    ("lateral", "in_junction", "weight", "expected"),
    # Lane of 3.5 m: 1.75 to the marking, 0.5 free, so 1.25 m to fall over.
    [
        (0.0, False, 1.0, 1.0),
        (0.5, False, 1.0, 1.0),
        (-0.75, False, 1.0, 0.8),
        (1.5, False, 1.0, 0.2),
        (1.75, False, 1.0, 0.0),
        (-4.0, False, 1.0, 0.0),
        (4.0, True, 1.0, 1.0),
        (-0.75, False, 0.5, 0.9),
        (4.0, False, 0.5, 0.5),
    ],
)
def test_lane_with_room(lateral, in_junction, weight, expected):
    got = lane.factor_with_room(f32(lateral), f32(3.5), jnp.bool_(in_junction), 0.5, weight)
    np.testing.assert_allclose(got, expected, atol=1e-6)


def test_lane_as_narrow_as_its_room_is_no_division_by_zero():
    got = [
        float(lane.factor_with_room(f32(y), f32(1.0), jnp.bool_(False), 0.5, 1.0)) for y in (0.4, 1)
    ]
    assert got == [1.0, 0.0]


@pytest.mark.parametrize(
    ("limit", "ratio", "is_paid", "expected"),
    # 0.6 * 100 / 150 = 0.4
    [
        (15.0, 0.6, True, 0.4),
        (15.0, 0.6, False, 0.0),
        (15.0, 0.0, True, 0.0),
        (15.0, 1.0, True, 2 / 3),
        (1200.0, 0.6, True, 0.005),
        (0.0, 0.6, True, 60.0),  # one step at least
    ],
)
def test_survival(limit, ratio, is_paid, expected):
    got = survival.bonus(ratio, survival.num_steps(limit, DT), jnp.bool_(is_paid))
    np.testing.assert_allclose(got, expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("violated", "expected"),
    [
        ([0, 0, 0], [0, 0, 0]),
        ([1, 0, 0], [1, 1, 1]),
        ([0, 1, 0], [0, 1, 1]),
        ([0, 0, 1], [0, 0, 1]),
        ([1, 0, 1], [1, 1, 1]),
        ([0, 1, 1], [0, 1, 1]),
    ],
)
def test_what_is_latched_holds(violated, expected):
    left, held = jnp.int32(0), []
    for one in violated:
        left = timer.latch(left, jnp.bool_(one))
        held.append(int(left > 0))
    assert held == expected
    assert left.dtype == jnp.int32 and not left.weak_type


def test_a_latch_outlives_every_timer():
    left = timer.latch(jnp.int32(0), jnp.bool_(True))
    for _ in range(1000):
        left = timer.latch(left, jnp.bool_(False))
    assert int(left) == 500  # which is 1 among the critic's inputs


@pytest.mark.parametrize(
    "factor",
    [lambda left: ttc.factor(left, 0.5), lambda left: comfort.factor(jnp.full(6, left), 0.5)],
    ids=["ttc", "comfort"],
)
def test_penalties_hold_for_500_steps(factor):
    """The step of the violation and 499 more."""
    left, factors = jnp.int32(0), []
    for step in range(503):
        left = timer.tick(left, jnp.bool_(step == 0), 500)
        factors.append(float(factor(left)))
    assert [factors[i] for i in (0, 1, 498, 499)] == [0.5] * 4
    assert [factors[i] for i in (500, 501, 502)] == [1.0] * 3


@pytest.mark.parametrize(
    ("corners", "expected"),
    [
        ([0, 0, 0, 0], False),
        ([1, 0, 0, 0], True),
        ([0, 1, 0, 0], True),
        ([0, 0, 1, 0], True),
        ([0, 0, 0, 1], True),
        ([1, 1, 1, 1], True),
    ],
)
def test_one_corner_off_the_road_is_enough(corners, expected):
    assert bool(off_road.has_corner_off(jnp.array(corners, bool))) is expected


@pytest.mark.parametrize(
    ("speed", "gap", "expected"),
    # Bumpers meet at 4.446 m.
    [
        (5.0, 4.4, True),
        (0.05, 4.4, True),
        (0.049, 4.4, False),
        (0.0, 4.4, False),
        (5.0, 4.5, False),
        (0.0, 4.5, False),
    ],
)
def test_who_stands_does_not_collide(speed, gap, expected):
    agents = make_agents(xy=[(gap, 0.0)])
    got = collision.collided_in_motion(make_ego(speed=speed), agents, VEHICLE, 3.0, 0.05)
    assert bool(got) is expected


@pytest.mark.parametrize(
    ("lateral", "span", "expected"),
    [(0, 2, 0), (1, 2, -0.5), (-1, 2, -0.5), (3.5, 2, -1.75), (4, 8, -0.5), (-12, 8, -1.5)],
)
def test_position(lateral, span, expected):
    np.testing.assert_allclose(position.penalty(f32(lateral), span), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("yaw", "route_yaw", "expected"),
    [
        (0, 0, 0),
        (30, 0, 30),
        (0, 30, 30),
        (-20, 25, 45),
        (179, -179, 2),
        (-170, 170, 20),
        (90, -90, 180),
    ],
)
def test_rotation(yaw, route_yaw, expected):
    got = rotation.penalty(f32(np.radians(yaw)), f32(np.radians(route_yaw)))
    np.testing.assert_allclose(got, -np.radians(expected), atol=1e-5)


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        (0, 0, 0),
        (0.5, 0.509, 0),
        (0.5, 0.511, -0.1),
        (0.5, 0.489, -0.1),
        (-1, 1, -0.1),
        (-0.3, -0.3, 0),
    ],
)
def test_action(before, after, expected):
    got = action.penalty(f32(before), f32(after), 0.01, 0.1)
    np.testing.assert_allclose(got, expected, atol=1e-7)


@pytest.mark.parametrize(
    ("before", "now", "expected"),
    [
        (0.0, 0.5, False),
        (3.4, 3.5, False),  # just allowed
        (3.4, 3.6, True),
        (4.0, 3.9, False),  # on its way back
        (4.0, 4.005, False),  # within the slack
        (4.0, 4.02, True),
        (0.0, 4.0, False),  # a jump
        (4.0, 4.81, False),  # another
        (4.0, 4.79, True),  # none
    ],
)
def test_lateral_distance(before, now, expected):
    limit = lateral_distance.limit(f32(before), f32(now), 3.5, 0.8)
    assert bool(lateral_distance.is_beyond(f32(now), limit)) is expected


@pytest.mark.parametrize(
    ("fields", "expected"),
    # A pedestrian of 0.5 x 0.5 m is 1 x 1 m twice as large and 1.6 x 1.6 m at least: 0.8 m ahead of
    # its middle; the ego reaches 2.446 m ahead and 0.918 m to the side.
    [
        ({"xy": [(3.2, 0.0)]}, True),
        ({"xy": [(3.3, 0.0)]}, False),
        ({"xy": [(0.0, 1.7)]}, True),
        ({"xy": [(0.0, -1.75)]}, False),
        ({"xy": [(3.4, 0.0)], "length": [1.0]}, True),  # twice 1 m: 1 m ahead of its middle
        ({"xy": [(3.5, 0.0)], "length": [1.0]}, False),
        ({"xy": [(3.2, 0.0)], "z": [5.0]}, False),
        ({"xy": [(2.0, 0.0)], "kind": [KIND_VEHICLE]}, False),
        ({"xy": [(2.0, 0.0)], "kind": [KIND_STATIC]}, False),
    ],
)
def test_pedestrian_overlap(fields, expected):
    agents = make_agents(**{"length": [0.5], "width": [0.5], "kind": [KIND_PEDESTRIAN]} | fields)
    assert bool(pedestrian_overlap.overlaps(make_ego(), agents, VEHICLE, 2.0, 3.0)) is expected


@pytest.mark.parametrize(
    ("is_end", "is_violation", "speed", "expected"),
    [
        (False, False, 5.0, 0.0),
        (True, False, 5.0, 1.0),
        (True, True, 5.0, 6.0),
        (True, True, 0.0, 1.0),
        (True, False, 0.0, 1.0),
        (True, True, 11.5, 12.5),
    ],
)
def test_terminal_penalty(is_end, is_violation, speed, expected):
    got = terminal.penalty(jnp.bool_(is_end), jnp.bool_(is_violation), f32(speed))
    assert float(got) == expected and got.dtype == jnp.float32


@pytest.mark.parametrize(
    ("route_s", "expected"),
    [(0.0, False), (989.0, False), (990.0, True), (995.5, True), (1000.0, True), (500.0, False)],
)
def test_near_the_goal(route_s, expected):
    got = route_completion.is_near_goal(f32(route_s), f32(1000.0), 10.0)
    assert bool(got) is expected


def test_straight_forecast_for_nuplan_looks_a_second_far():
    # 5 m/s towards a standing car; boxes meet at 4.446 m, after 1 s within 9.446 m.
    for distance, expected in ((9.4, True), (9.5, False)):
        agents = make_agents(xy=[(distance, 0.0)])
        got = ttc.violated(
            make_ego(yaw_rate=1.0), agents, VEHICLE, ttc.forecast_straight_second, 0.005, 3.0
        )
        assert bool(got) is expected
