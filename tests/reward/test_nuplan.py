"""The CaRL rewards for nuPlan, step by step at hand-worked values."""

import jax.numpy as jnp
import numpy as np
import pytest
from reward_world import (
    compute,
    ends,
    f32,
    make_agents,
    make_ego,
    make_situation,
    make_state,
    one_step,
)

from carljax.reward import reward
from carljax.reward.carl_nuplan import CarlNuplanConfig
from carljax.reward.config import RewardConfig

CLIP = {"time_limit_s": 15.0}  # 150 steps
REGULAR = RewardConfig(name="carl-nuplan", **CLIP)
SURVIVAL = RewardConfig(name="carl-nuplan-survival", **CLIP)
TUNED = RewardConfig(name="carl-nuplan-tuned", **CLIP)
ALL = [REGULAR, SURVIVAL, TUNED]
CODE = CarlNuplanConfig(
    ttc_forecast="straight", lane_weight=0.5, comfort_weight=1.0, terminal_penalty=0.0
)
GAIN = {"route_s": f32(98.0)}  # 2 m of 1000 m: 0.2 %
COLLISION = {"agents": make_agents(xy=[(4.0, 0.0)])}
OFF_ROAD = {"situation": make_situation(corner_off_road=[0, 0, 1, 0])}


@pytest.mark.parametrize(
    ("config", "expected"),
    # Regular: 0.2. Survival: 0.4 * 0.2 + 0.6 * 100 / 150 = 0.48.
    # Tuned: (5 * 0.2 + (5 + 4 + 2) * 100 / 150) / 16 = 0.52083.
    [(REGULAR, 0.2), (SURVIVAL, 0.48), (TUNED, 0.520833)],
)
def test_plain_driving(config, expected):
    value, terminated, _, terms = one_step(config, **GAIN)
    np.testing.assert_allclose(value, expected, rtol=1e-4)
    assert not bool(terminated) and ends(terms) == set()


@pytest.mark.parametrize(
    ("config", "expected"),
    # Lane: 1 - (1.0 - 0.5) / 1.25 = 0.6. Speed: 11 m/s at 10, 1 - 3.6 / 8 = 0.55. TTC 0.5.
    # Comfort with 3 of 6: 0.75. Regular: 0.2 * 0.6 * 0.55 * 0.5 * 0.75 = 0.02475.
    # Survival: 0.4 * that + 0.4 = 0.4099.
    # Tuned: 0.6 * (5 * 0.2 + (0 + 4 * 0.55 + 0) * 100 / 150) / 16 = 0.0925.
    [(REGULAR, 0.02475), (SURVIVAL, 0.4099), (TUNED, 0.0925)],
)
def test_soft_factors(config, expected):
    value, *_ = one_step(
        config,
        make_ego(speed=11.0),
        situation=make_situation(lane_lateral=1.0),
        ttc_ticks=jnp.int32(500),
        comfort_ticks=jnp.array([500, 500, 500, 0, 0, 0], jnp.int32),
        **GAIN,
    )
    np.testing.assert_allclose(value, expected, rtol=1e-4)


def test_the_code_s_way_is_a_matter_of_options():
    # Lane 1 - 0.5 * 0.4 = 0.8, comfort passed / 6 = 0.5: 0.2 * 0.8 * 0.5 = 0.08.
    value, *_ = one_step(
        REGULAR.replace(carl_nuplan=CODE),
        situation=make_situation(lane_lateral=1.0),
        comfort_ticks=jnp.array([500, 500, 500, 0, 0, 0], jnp.int32),
        **GAIN,
    )
    np.testing.assert_allclose(value, 0.08, rtol=1e-4)
    value, terminated, *_ = one_step(REGULAR.replace(carl_nuplan=CODE), **COLLISION, **GAIN)
    assert float(value) == 0.0 and bool(terminated)


@pytest.mark.parametrize(
    ("config", "collision"), [(REGULAR, -1.0), (SURVIVAL, -0.4), (TUNED, -1.0)]
)
def test_the_step_that_fails_pays_the_penalty_alone(config, collision):
    value, terminated, _, terms = one_step(config, **COLLISION, **GAIN)
    np.testing.assert_allclose(value, collision, rtol=1e-6)
    assert bool(terminated) and ends(terms) == {"collision"}
    assert float(terms.added["progress"]) == 0.0
    value, terminated, _, terms = one_step(config, **OFF_ROAD, **GAIN)
    assert float(value) == 0.0 and bool(terminated) and ends(terms) == {"off_road"}


@pytest.mark.parametrize("config", ALL)
def test_a_collision_with_a_standing_ego_does_not_count(config):
    *_, terms = one_step(config, make_ego(speed=0.04), **COLLISION)
    assert ends(terms) == set()


@pytest.mark.parametrize("config", ALL)
def test_nothing_of_carla_s_ends_the_episode(config):
    situation = make_situation(
        1,
        off_road_frac=0.9,
        route_distance=40.0,
        stop_s=[100.0],
        stop_kind=[2],
        stop_xy=[(0.1, 0.0)],
    )
    before, ego = make_ego(), make_ego((0.5, 0.0))
    _, terminated, _, terms = one_step(config, ego, None, situation, before, stopped_s=f32(95.0))
    assert not bool(terminated) and ends(terms) == set()


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({}, 1.0),
        ({"lane_lateral": 1.8}, 0.0),  # past the marking of a lane of 3.5 m
        ({"lane_lateral": 1.8, "on_parking": True}, 0.0),  # a car park is off the route
        ({"lane_yaw": np.pi}, 0.0),  # against traffic
        ({"lane_yaw": np.pi, "lane_in_junction": True}, 1.0),
        ({"route_lateral": 5.2}, 1.0),  # the lane beside the route's
        ({"route_lateral": -5.3}, 0.0),
        ({"route_lateral": 5.3, "route_idx": 999, "route_s": 999.0}, 1.0),  # the route is over
    ],
)
def test_off_the_route(fields, expected):
    for config in ALL:
        *_, terms = one_step(config, situation=make_situation(**fields))
        assert float(terms.soft["outside_lanes"]) == expected


@pytest.mark.parametrize("config", ALL)
def test_time_to_collision_stays_for_the_episode(config):
    state = make_state(make_ego(), make_agents(), make_situation(), config=config)
    factors = []
    for step in range(520):
        agents = make_agents(xy=[(6.0, 0.0)]) if step == 3 else make_agents()
        _, _, memory, terms = compute(state, make_ego(), agents, make_situation(), config)
        state = state.replace(reward_state=memory)
        factors.append(float(terms.soft["ttc"]))
    violated = 0.0 if config is TUNED else 0.5
    assert factors == [1.0] * 3 + [violated] * 517


def test_comfort_stays_for_the_episode_by_nuplan_s_limits():
    # 3 m/s^2 along the body: beyond nuPlan's 2.40 from the eighth sample on, within CARLA's 10.
    state = make_state(make_ego(), make_agents(), make_situation(), config=REGULAR)
    factors = []
    for step in range(40):
        ego = make_ego(accel=3.0 if step < 8 else 0.0)
        _, _, memory, terms = compute(state, ego, make_agents(), make_situation(), REGULAR)
        state = state.replace(reward_state=memory)
        factors.append(float(terms.soft["comfort"]))
    assert factors[:7] == [1.0] * 7
    np.testing.assert_allclose(factors[7], 11 / 12, rtol=1e-6)
    # The drop to 0 breaks both limits of jerk.
    np.testing.assert_allclose(factors[20:], [9 / 12] * 20, rtol=1e-6)


def test_an_episode_of_survival_pays_100_s():
    total = 0.0
    for step in range(151):  # the step past the limit ends it
        value, *_, terms = one_step(SURVIVAL, step_count=step)
        total += float(value)
        assert bool(terms.timeout) == (step == 150)
    np.testing.assert_allclose(total, 60.0, rtol=1e-4)


def test_a_perfect_tuned_episode_pays_100():
    # 11 / 16 for manners, and 5 / 16 for the whole route.
    total = sum(float(one_step(TUNED, step_count=step)[0]) for step in range(151))
    np.testing.assert_allclose(total + 5 / 16 * 100, 100.0, rtol=1e-4)


@pytest.mark.parametrize(
    ("config", "expected"), [(REGULAR, (True, False)), (SURVIVAL, (False, False))]
)
def test_what_is_paid_for_survival_goes_on_after_the_route(config, expected):
    situation = make_situation(route_idx=999, route_s=999.0)
    _, terminated, _, terms = one_step(config, situation=situation)
    assert bool(terms.finished)
    assert tuple(bool(v) for v in reward.ending(terminated, terms, config)) == expected


@pytest.mark.parametrize("config", ALL)
def test_the_time_limit_truncates(config):
    _, terminated, _, terms = one_step(config, step_count=150)
    assert [bool(v) for v in reward.ending(terminated, terms, config)] == [False, True]
