"""Hazards and the speed they leave, at hand-worked places: the ego at the origin, to the east."""

import jax.numpy as jnp
import numpy as np
import pytest
from reward_world import f32, make_agents, make_ego, make_situation

from carljax.reward import desired_speed, hazards
from carljax.sim.types import (
    KIND_PEDESTRIAN,
    KIND_STATIC,
    LIGHT_GREEN,
    LIGHT_RED,
    STOP_LIGHT,
    STOP_SIGN,
    STOP_YIELD,
)

NONE = np.inf
D45, D150 = np.radians([45, 150])


def at(degrees, metres):
    return metres * np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])


@pytest.mark.parametrize(
    ("distance", "expected"),
    # Roach's vehicle: margin 8, span 5, free speed 6: 0 up to 8 m, 1.2 m/s per metre, 6 from 13 m.
    [(0.0, 0.0), (8.0, 0.0), (9.0, 1.2), (10.5, 3.0), (13.0, 6.0), (40.0, 6.0), (NONE, 6.0)],
)
def test_speed_left_by_a_hazard(distance, expected):
    got = desired_speed.approaching(f32(distance), 8.0, 5.0, 6.0)
    np.testing.assert_allclose(got, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("speed", "desired", "expected"),
    [(6, 6, 1), (0, 0, 1), (3, 6, 0.5), (6, 3, 0.5), (0, 6, 0), (12, 0, -1), (6.6, 6, 0.9)],
)
def test_nearness_to_the_desired_speed(speed, desired, expected):
    np.testing.assert_allclose(
        desired_speed.match(f32(speed), f32(desired), 6.0), expected, atol=1e-6
    )


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"xy": [(9.0, 0.0)]}, 9.0),
        ({"xy": [(9.6, 0.0)]}, NONE),  # beyond 9.5 m
        ({"xy": [at(44, 9.0)]}, 9.0),
        ({"xy": [at(-46, 9.0)]}, NONE),  # beside
        ({"xy": [(-9.0, 0.0)]}, NONE),  # behind
        ({"xy": [(9.0, 0.0), (7.0, 1.0)]}, np.sqrt(50)),  # the nearer of two
        ({"xy": [(9.0, 0.0)], "yaw": [np.radians(149)]}, 9.0),
        ({"xy": [(9.0, 0.0)], "yaw": [np.radians(-151)]}, NONE),  # comes towards the ego
        ({"xy": [(9.0, 0.0)], "kind": [KIND_PEDESTRIAN]}, NONE),
        ({"xy": [(9.0, 0.0)], "kind": [KIND_STATIC]}, NONE),
        ({"xy": [(9.0, 0.0)], "z": [6.0]}, NONE),  # on the overpass
        ({}, NONE),
    ],
)
def test_vehicle_ahead(fields, expected):
    got = hazards.vehicle_ahead(make_ego(), make_agents(**fields), 9.5, D45, D150, 3.0)
    np.testing.assert_allclose(got, expected, rtol=1e-6)


def test_vehicle_ahead_of_a_turned_ego():
    ego = make_ego((5.0, 5.0), yaw=np.pi / 2)
    got = hazards.vehicle_ahead(ego, make_agents(xy=[(5.0, 12.0)], yaw=[1.5]), 9.5, D45, D150, 3.0)
    np.testing.assert_allclose(got, 7.0, rtol=1e-6)


@pytest.mark.parametrize(
    ("degrees", "metres", "on_road", "expected"),
    # The cone at d m: 162 / (d + 0.3) degrees; 19.3 at 8.1 m, 90 at 1.5 m and less.
    [
        (0, 8.1, True, 8.1),
        (19, 8.1, True, 8.1),
        (-20, 8.1, True, NONE),
        (89, 1.2, True, 1.2),
        (91, 1.2, True, NONE),
        (0, 8.1, False, NONE),  # on the pavement
        (0, 9.6, True, NONE),
        (180, 3.0, True, NONE),
    ],
)
def test_pedestrian_ahead(degrees, metres, on_road, expected):
    agents = make_agents(xy=[at(degrees, metres)], kind=[KIND_PEDESTRIAN])
    on_road = jnp.array([on_road, True])
    got = hazards.pedestrian_ahead(make_ego(), agents, on_road, 9.5, 3.0)
    np.testing.assert_allclose(got, expected, rtol=1e-5)


def test_a_vehicle_is_no_pedestrian():
    agents = make_agents(xy=[(5.0, 0.0)])
    got = hazards.pedestrian_ahead(make_ego(), agents, jnp.ones(2, bool), 9.5, 3.0)
    assert float(got) == NONE


@pytest.mark.parametrize(
    ("gaps", "fields", "expected"),
    [
        ([12.0], {}, 12.0),
        ([12.0, 7.0], {}, 7.0),
        ([NONE], {}, NONE),
        ([12.0, 7.0], {"kind": [1, KIND_PEDESTRIAN]}, 12.0),
        ([12.0, 7.0], {"kind": [1, KIND_STATIC]}, 12.0),
        ([12.0, 7.0], {"z": [0.0, -5.0]}, 12.0),
    ],
)
def test_vehicle_on_the_route(gaps, fields, expected):
    agents = make_agents(xy=[(0.0, 0.0)] * len(gaps), **fields)
    gaps = jnp.asarray(gaps + [NONE] * (2 - len(gaps)), jnp.float32)
    assert float(hazards.vehicle_on_route(make_ego(), agents, gaps, 3.0)) == expected


def line(x, kind=STOP_LIGHT, light=LIGHT_RED, yaw=0.0, y=0.0, s=None):
    """One line of the route at x m ahead, at the same distance along the route (100 m at 0)."""
    return make_situation(
        1,
        stop_s=[100.0 + (x if s is None else s)],
        stop_xy=[(x, y)],
        stop_yaw=[yaw],
        stop_kind=[kind],
        stop_light=[light],
    )


@pytest.mark.parametrize(
    ("situation", "expected"),
    # The point is 2 m behind the centre and sees lines within 18 m of itself: up to x = 16.
    [
        (line(12.0), 12.0),
        (line(15.9), 15.9),
        (line(16.1), NONE),
        (line(-1.9), 1.9),  # the tail is still before the line
        (line(-2.1), NONE),
        (line(3.0, y=4.0), 5.0),
        (line(12.0, light=LIGHT_GREEN), NONE),
        (line(12.0, kind=STOP_SIGN), NONE),
        (line(12.0, yaw=np.pi), NONE),  # beyond it, and the other way
        (line(12.0, s=-40.0), NONE),  # another pass of the route
    ],
)
def test_light_ahead(situation, expected):
    closed = (situation.stop_kind == STOP_LIGHT) & (situation.stop_light == LIGHT_RED)
    got = hazards.light(make_ego(), 2.0, situation, jnp.asarray(closed), 18.0, 30.0)
    np.testing.assert_allclose(got, expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("situation", "satisfied", "expected"),
    [
        (line(12.0, STOP_SIGN), False, 12.0),
        (line(12.0, STOP_SIGN), True, NONE),  # has halted there
        (line(19.9, STOP_SIGN), False, 19.9),
        (line(20.1, STOP_SIGN), False, NONE),
        (line(-0.1, STOP_SIGN), False, NONE),  # passed
        (line(12.0, STOP_YIELD), False, NONE),
        (line(3.0, STOP_SIGN, y=-4.0), False, 5.0),
    ],
)
def test_stop_sign_ahead(situation, satisfied, expected):
    got = hazards.stop_sign(make_ego(), situation, jnp.array([satisfied]), 20.0)
    np.testing.assert_allclose(got, expected, rtol=1e-6)
