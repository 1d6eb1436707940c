"""Roach's reward, step by step at hand-worked values."""

import jax.numpy as jnp
import numpy as np
import pytest
from reward_world import (
    compute,
    ends,
    f32,
    make_agents,
    make_ego,
    make_others,
    make_situation,
    make_state,
    one_step,
)

from carljax.reward import reward
from carljax.reward.config import RewardConfig
from carljax.reward.roach import RoachConfig
from carljax.sim.types import KIND_PEDESTRIAN, LIGHT_RED, LIGHT_YELLOW, STOP_LIGHT, STOP_SIGN

ROACH = RewardConfig(name="roach")
CARL_S = ROACH.replace(
    roach=RoachConfig(charge_every_end=True, stop_sign_margin=4.0, stop_sign_span=4.0)
)


def line(x, kind, light=0):
    return make_situation(
        1, stop_s=[100.0 + x], stop_xy=[(x, 0.0)], stop_kind=[kind], stop_light=[light]
    )


@pytest.mark.parametrize(
    ("speed", "around", "expected"),
    [
        (6.0, {}, 1.0),
        (3.0, {}, 0.5),
        (0.0, {}, 0.0),
        (12.0, {}, 0.0),
        (15.0, {}, -0.5),
        (0.0, {"agents": make_agents(xy=[(8.0, 0.0)])}, 1.0),  # desired 0
        (0.0, {"agents": make_agents(xy=[(9.0, 0.0)])}, 0.8),  # desired 1.2
        (3.0, {"situation": line(7.5, STOP_LIGHT, LIGHT_RED)}, 1.0),  # desired 3
        (3.0, {"situation": line(7.5, STOP_LIGHT, LIGHT_YELLOW)}, 1.0),
        (6.0, {"situation": line(7.5, STOP_LIGHT)}, 1.0),  # green
        (3.0, {"situation": line(7.5, STOP_SIGN)}, 1.0),
    ],
)
def test_speed(speed, around, expected):
    value, terminated, _, terms = one_step(ROACH, make_ego(speed=speed), **around)
    np.testing.assert_allclose(terms.added["speed"], expected, atol=1e-5)
    np.testing.assert_allclose(value, expected, atol=1e-5)
    assert not bool(terminated)


def test_pedestrians_slow_down_unless_on_the_pavement():
    agents = make_agents(xy=[(8.5, 0.0)], length=[0.5], width=[0.5], kind=[KIND_PEDESTRIAN])
    for on_road, desired in ((True, 3.0), (False, 6.0)):
        situation = make_situation(others=make_others(on_road=[on_road]))
        *_, terms = one_step(ROACH, make_ego(speed=6.0), agents, situation)
        np.testing.assert_allclose(terms.added["speed"], 1 - (6 - desired) / 6, atol=1e-5)


def test_the_nearest_hazard_decides():
    # The vehicle at 9.4 m leaves 1.68 m/s, the light at 6 m leaves 1.2.
    agents = make_agents(xy=[(9.4, 0.0)])
    ego = make_ego(speed=1.2)
    *_, terms = one_step(ROACH, ego, agents, line(6.0, STOP_LIGHT, LIGHT_RED))
    np.testing.assert_allclose(terms.added["speed"], 1.0, atol=1e-5)


def test_the_reproduction_s_stop_sign_is_an_option():
    # At 6 m: 6 * (6 - 5) / 5 = 1.2 by Roach, 6 * (6 - 4) / 4 = 3 by the reproduction.
    for config, desired in ((ROACH, 1.2), (CARL_S, 3.0)):
        *_, terms = one_step(config, make_ego(speed=6.0), situation=line(6.0, STOP_SIGN))
        np.testing.assert_allclose(terms.added["speed"], 1 - (6 - desired) / 6, atol=1e-5)


def test_all_summands_add_up():
    # Speed 0.5; 1 m off the route -0.5; 0.3 rad off its direction -0.3; the wheel moved: -0.1.
    value, *_, terms = one_step(
        ROACH,
        make_ego(speed=3.0, yaw=0.3, steer=0.2),
        situation=make_situation(route_lateral=-1.0),
        before=make_ego(speed=3.0),
        lateral=f32(1.0),
    )
    want = {"speed": 0.5, "position": -0.5, "rotation": -0.3, "action": -0.1}
    for name, expected in want.items():
        np.testing.assert_allclose(terms.added[name], expected, atol=1e-6)
    np.testing.assert_allclose(value, -0.4, atol=1e-6)


def crossing(kind, light=0):
    """The ego's tail and centre go over a line in this step."""
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
    ("cause", "step", "penalty"),
    # All cost 1; those that break a rule cost the speed of 4 m/s too.
    [
        ("collision", {"ego": make_ego(speed=4.0), "agents": make_agents(xy=[(4.0, 0.0)])}, 5.0),
        ("red_light", crossing(STOP_LIGHT, LIGHT_RED), 5.0),
        ("stop_sign", crossing(STOP_SIGN), 5.0),
        (
            "pedestrian_overlap",
            {
                "ego": make_ego(speed=4.0),
                "agents": make_agents(xy=[(3.0, 0.0)], length=[0.5], width=[0.5], kind=[2]),
            },
            5.0,
        ),
        (
            "lateral_distance",
            {
                "ego": make_ego(speed=4.0),
                "situation": make_situation(route_lateral=3.6),
                "lateral": f32(3.4),
            },
            1.0,
        ),
        ("blocked", {"ego": make_ego(speed=0.0), "stopped_s": f32(90.0)}, 1.0),
    ],
)
def test_each_end_costs(cause, step, penalty):
    value, terminated, _, terms = one_step(ROACH, **step)
    assert ends(terms) == {cause} and bool(terminated)
    np.testing.assert_allclose(terms.penalty, penalty, rtol=1e-6)
    summands = sum(float(v) for v in terms.added.values())
    np.testing.assert_allclose(value, summands - penalty, rtol=1e-5)


def test_ninety_seconds_of_standing_are_allowed():
    for stood, expected in ((89.8, False), (89.9, False), (90.0, True)):
        _, terminated, *_ = one_step(ROACH, make_ego(speed=0.0), stopped_s=f32(stood))
        assert bool(terminated) is expected


def test_the_distance_a_step_ago_is_remembered():
    """Out to 4 m in a jump, then inwards, then out again."""
    state = make_state(make_ego(), make_agents(), make_situation(), config=ROACH)
    ended = []
    for lateral in (0.0, 4.0, 3.9, 3.8, 3.9):
        situation = make_situation(route_lateral=-lateral)
        _, _, memory, terms = compute(state, make_ego(), make_agents(), situation, ROACH)
        state = state.replace(reward_state=memory)
        ended.append(bool(terms.terminated["lateral_distance"]))
    assert ended == [False, False, False, False, True]


@pytest.mark.parametrize(
    ("fields", "step_count"),
    [({"route_idx": 999, "route_s": 999.0}, 0), ({}, 12000)],
    ids=["finished", "timeout"],
)
def test_other_ends_cut_off_and_cost_only_by_the_reproduction(fields, step_count):
    for config, penalty in ((ROACH, 0.0), (CARL_S, 1.0)):
        situation = make_situation(**fields)
        value, terminated, _, terms = one_step(
            config, make_ego(speed=6.0), situation=situation, step_count=step_count
        )
        assert float(terms.penalty) == penalty
        np.testing.assert_allclose(value, 1.0 - penalty, atol=1e-5)
        assert [bool(v) for v in reward.ending(terminated, terms, config)] == [False, True]


def test_a_drive_ends_with_the_penalty_once():
    """Into a wall at 5 m/s: 1 + 5 is paid at the contact, nothing before."""
    wall = make_agents(xy=[(20.0, 0.0)], kind=[3], length=[1.0], width=[5.0])
    state = make_state(make_ego(), wall, make_situation(), config=ROACH)
    penalties = []
    for step in range(40):
        ego = make_ego((0.5 * step, 0.0))
        _, terminated, memory, terms = compute(state, ego, wall, make_situation(), ROACH)
        state = state.replace(ego=ego, reward_state=memory)
        penalties.append(float(terms.penalty))
        if bool(terminated):
            break
    # Contact at 20 - 0.5 - 2.446 = 17.054 m: the step to 17.5 m.
    assert penalties == [0.0] * 35 + [6.0]
    assert jnp.asarray(terms.terminated["collision"])
