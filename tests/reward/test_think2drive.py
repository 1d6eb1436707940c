"""Think2Drive's reward, step by step at hand-worked values."""

import numpy as np
import pytest
from reward_world import (
    ends,
    f32,
    make_agents,
    make_ego,
    make_others,
    make_situation,
    one_step,
)

from carljax.reward import reward
from carljax.reward.config import RewardConfig
from carljax.reward.think2drive import Think2DriveConfig
from carljax.sim.types import LIGHT_RED, LIGHT_YELLOW, STOP_LIGHT, STOP_SIGN

CONFIG = RewardConfig(name="think2drive")


def line(x, kind, light=0):
    return make_situation(
        1, stop_s=[100.0 + x], stop_xy=[(x, 0.0)], stop_kind=[kind], stop_light=[light]
    )


def vehicle(gap):
    return {
        "agents": make_agents(xy=[(30.0, 0.0)]),
        "situation": make_situation(others=make_others(route_gap=[gap])),
    }


@pytest.mark.parametrize(
    ("around", "desired"),
    # The limit is 10 m/s, so 8 m/s is free; it falls over 12.5 m, 0.64 m/s per metre.
    [
        ({}, 8.0),
        (vehicle(20.5), 8.0),
        (vehicle(14.25), 4.0),
        (vehicle(8.0), 0.0),
        ({"situation": line(10.25, STOP_LIGHT, LIGHT_RED)}, 4.0),
        ({"situation": line(4.0, STOP_LIGHT, LIGHT_RED)}, 0.0),
        ({"situation": line(10.25, STOP_LIGHT, LIGHT_YELLOW)}, 8.0),
        ({"situation": line(8.75, STOP_SIGN)}, 4.0),
        ({"situation": line(2.5, STOP_SIGN)}, 0.0),
        ({"situation": make_situation(speed_limit=5.0)}, 4.0),
    ],
)
def test_desired_speed(around, desired):
    *_, terms = one_step(CONFIG, make_ego(speed=2.0), **around)
    np.testing.assert_allclose(terms.added["speed"], 1 - abs(2.0 - desired) / 7.5, atol=1e-5)


def test_all_summands_add_up():
    # Speed 1 - 3 / 7.5 = 0.6; 0.5 m driven; 1 m off: -2 / 8; the wheel moved: -0.5 * 0.1.
    value, *_, terms = one_step(
        CONFIG,
        make_ego((0.3, 0.4), speed=5.0, steer=0.1),
        situation=make_situation(route_lateral=1.0),
        before=make_ego(),
    )
    want = {"speed": 0.6, "travel": 0.5, "deviation": -0.25, "steer": -0.05, "goal": 0.0}
    for name, expected in want.items():
        np.testing.assert_allclose(terms.added[name], expected, atol=1e-6)
    np.testing.assert_allclose(value, 0.8, atol=1e-6)


def test_the_cost_of_steering_can_be_left_out():
    config = CONFIG.replace(think2drive=Think2DriveConfig(steer_weight=0.0))
    *_, terms = one_step(config, make_ego(steer=0.5), before=make_ego())
    assert float(terms.added["steer"]) == 0.0


def crossing(kind, light=0):
    situation = make_situation(
        1, stop_s=[100.0], stop_xy=[(0.0, 0.0)], stop_kind=[kind], stop_light=[light]
    )
    place = -0.1 if kind == STOP_SIGN else 0.8 * 2.446 - 0.1
    return {
        "before": make_ego((place, 0.0), speed=4.0),
        "ego": make_ego((place + 0.3, 0.0), speed=4.0),
        "situation": situation,
    }


@pytest.mark.parametrize(
    ("cause", "step", "expected"),
    [
        ("collision", {"ego": make_ego(speed=4.0), "agents": make_agents(xy=[(4.0, 0.0)])}, -5.0),
        ("red_light", crossing(STOP_LIGHT, LIGHT_RED), -5.0),
        ("stop_sign", crossing(STOP_SIGN), -5.0),
        ("route_deviation", {"situation": make_situation(route_distance=15.1)}, -1.0),
    ],
)
def test_a_failure_pays_its_terminal_reward_alone(cause, step, expected):
    value, terminated, _, terms = one_step(CONFIG, **step)
    assert ends(terms) == {cause} and bool(terminated)
    np.testing.assert_allclose(value, expected, rtol=1e-6)


def test_fifteen_metres_from_the_route_are_allowed():
    _, terminated, *_ = one_step(CONFIG, situation=make_situation(route_distance=15.0))
    assert not bool(terminated)


def test_the_goal_pays_one_and_cuts_off():
    for route_s, at_goal in ((989.0, False), (990.0, True)):
        situation = make_situation(route_s=route_s, route_idx=int(route_s))
        value, terminated, _, terms = one_step(CONFIG, make_ego(speed=8.0), situation=situation)
        np.testing.assert_allclose(value, 1.0, atol=1e-6)  # at 8 m/s r_speed is 1 as well
        assert float(terms.added["goal"]) == at_goal and bool(terms.finished) is at_goal
        assert [bool(v) for v in reward.ending(terminated, terms, CONFIG)] == [False, at_goal]


def test_a_collision_at_the_goal_is_a_collision():
    situation = make_situation(route_s=995.0, route_idx=995)
    value, *_ = one_step(CONFIG, make_ego(speed=4.0), make_agents(xy=[(4.0, 0.0)]), situation)
    np.testing.assert_allclose(value, -5.0, rtol=1e-6)


@pytest.mark.parametrize(("stood", "expected"), [(90.0, False), (99.9, False), (100.0, True)])
def test_a_hundred_seconds_of_standing_cut_off(stood, expected):
    # Desired 8 m/s: 1 - 8 / 7.5. There is no penalty, and the task would go on.
    value, terminated, _, terms = one_step(CONFIG, make_ego(speed=0.0), stopped_s=f32(stood))
    np.testing.assert_allclose(value, 1 - 8 / 7.5, atol=1e-6)
    assert bool(terms.terminated["blocked"]) is expected
    assert [bool(v) for v in reward.ending(terminated, terms, CONFIG)] == [False, expected]


def test_the_time_limit_truncates_without_a_penalty():
    value, terminated, _, terms = one_step(CONFIG, make_ego(speed=8.0), step_count=12000)
    np.testing.assert_allclose(value, 1.0, atol=1e-6)
    assert [bool(v) for v in reward.ending(terminated, terms, CONFIG)] == [False, True]
