"""Time to collision against hand-worked meetings and a float64 oracle with polygons."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reward_world import VEHICLE, make_agents, make_ego
from scipy.integrate import solve_ivp

from carljax.reward import ttc
from carljax.sim import geometry
from carljax.sim.types import KIND_PEDESTRIAN, KIND_STATIC, KIND_VEHICLE

WITH_AND_WITHOUT_JIT = [lambda f: f, jax.jit]
FORECASTS = {
    "arc": (ttc.forecast_arc, [0.2, 0.4, 0.6, 0.8, 1.0]),
    "straight": (ttc.forecast_straight, [0.1, 0.3, 0.5, 0.7, 0.9]),
}


def is_violated(ego, agents, forecast=ttc.forecast_arc):
    return bool(ttc.violated(ego, agents, VEHICLE, forecast, 0.1, 3.0))


def corners(xy, yaw, length, width):
    local = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * np.array([length, width]) / 2
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    return local @ turn.T + xy


def separation(box_a, box_b):
    """Largest gap between the boxes' shadows over all side normals; negative where they overlap."""
    gaps = []
    for box in (box_a, box_b):
        for i in (0, 1):
            side = box[i + 1] - box[i]
            normal = np.array([-side[1], side[0]]) / np.linalg.norm(side)
            a, b = box_a @ normal, box_b @ normal
            gaps.append(max(a.min() - b.max(), b.min() - a.max()))
    return max(gaps)


def place(kind, xy, yaw, slip, speed, yaw_rate, t):
    """Pose after t s, float64: closed form of the circle, or straight along the heading."""
    if kind == "straight":
        return xy + speed * t * np.array([np.cos(yaw), np.sin(yaw)]), yaw
    course = yaw + slip
    if abs(yaw_rate) < 1e-9:
        return xy + speed * t * np.array([np.cos(course), np.sin(course)]), yaw
    radius = speed / yaw_rate
    end = course + yaw_rate * t
    offset = [np.sin(end) - np.sin(course), np.cos(course) - np.cos(end)]
    return xy + radius * np.array(offset), yaw + yaw_rate * t


@pytest.mark.parametrize("kind", ["arc", "straight"])
@pytest.mark.parametrize("variant", WITH_AND_WITHOUT_JIT)
def test_random_scenes_match_float64_oracle(kind, variant):
    rng = np.random.default_rng(7)
    forecast, times = FORECASTS[kind]
    violated = variant(lambda e, a: ttc.violated(e, a, VEHICLE, forecast, 0.1, 3.0))
    seen = []
    for _ in range(60):
        xy, yaw = rng.uniform(-100, 100, 2), rng.uniform(-3, 3)
        slip, speed, rate = rng.normal() * 0.1, rng.uniform(1, 12), rng.normal() * 0.4
        num = 4
        agent_xy = xy + rng.normal(size=(num, 2)) * 14
        agent_yaw, agent_speed = rng.uniform(-3, 3, num), rng.uniform(0, 12, num)
        agent_rate = np.where(rng.random(num) < 0.3, 0.0, rng.normal(size=num) * 0.5)
        margin = min(
            separation(
                corners(*place(kind, xy, yaw, slip, speed, rate, t), 4.892, 1.836),
                corners(
                    *place(kind, agent_xy[i], agent_yaw[i], 0, agent_speed[i], agent_rate[i], t),
                    4.0,
                    2.0,
                ),
            )
            for t in times
            for i in range(num)
        )
        got = violated(
            make_ego(xy, yaw, speed, slip=slip, yaw_rate=rate),
            make_agents(num, xy=agent_xy, yaw=agent_yaw, speed=agent_speed, yaw_rate=agent_rate),
        )
        if abs(margin) > 1e-3:  # float32 can't decide a touch
            seen.append(margin < 0)
            assert bool(got) == (margin < 0)
    assert 15 < sum(seen) < 45


def test_arc_is_what_scipy_integrates():
    def rates(_, state):
        return [5 * np.cos(state[2] + 0.1), 5 * np.sin(state[2] + 0.1), 0.6]

    truth = solve_ivp(rates, (0, 1), [1, 2, 0.4], t_eval=FORECASTS["arc"][1], rtol=1e-10).y
    values = (jnp.float32(v) for v in (0.4, 0.1, 5.0, 0.6))
    xy, yaw = ttc.forecast_arc(jnp.array([1.0, 2.0]), *values)
    np.testing.assert_allclose(xy, truth[:2].T, atol=1e-4)
    np.testing.assert_allclose(yaw, truth[2], atol=1e-5)


def test_forecast_times_are_the_paper_s_and_the_code_s():
    np.testing.assert_allclose(ttc.ARC_TIMES, FORECASTS["arc"][1])
    np.testing.assert_allclose(ttc.STRAIGHT_TIMES, FORECASTS["straight"][1])


@pytest.mark.parametrize(
    ("distance", "expected"),
    # 5 m/s towards a standing car; boxes meet at 4.446 m, after 1 s within 5 + 4.446 = 9.446 m.
    [(9.4, True), (9.5, False)],
)
def test_standing_car_ahead(distance, expected):
    assert is_violated(make_ego(speed=5.0), make_agents(xy=[(distance, 0.0)])) is expected


def test_the_code_looks_a_tenth_of_a_second_less_far():
    # After 0.9 s: 4.5 + 4.446 = 8.946 m.
    for distance, expected in ((8.9, True), (9.0, False)):
        agents = make_agents(xy=[(distance, 0.0)])
        assert is_violated(make_ego(speed=5.0), agents, ttc.forecast_straight) is expected


def test_following_at_equal_speed_is_safe():
    agents = make_agents(xy=[(6.0, 0.0)], speed=[10.0])
    assert not is_violated(make_ego(speed=10.0), agents)


def test_being_rear_ended_counts():
    agents = make_agents(xy=[(-8.0, 0.0)], speed=[15.0])
    assert is_violated(make_ego(speed=5.0), agents)


def test_crossing_paths_meet_only_at_the_same_time():
    # Both reach (8, 0) after 0.8 s; with a lead of 10 m the other is through.
    meeting = make_agents(xy=[(8.0, -8.0)], yaw=[np.pi / 2], speed=[10.0])
    passed = make_agents(xy=[(8.0, 2.0)], yaw=[np.pi / 2], speed=[10.0])
    assert is_violated(make_ego(speed=10.0), meeting)
    assert not is_violated(make_ego(speed=10.0), passed)


def test_turning_away_is_seen_by_the_arc_alone():
    # At 8 m/s and 1 rad/s (radius 8 m) the ego is 2.4 m to the left when it reaches the wall's x.
    wall = make_agents(
        xy=[(10.0, -3.0), (-60.0, 60.0)],
        length=[1.0, 4.0],
        width=[6.0, 2.0],
        kind=[KIND_STATIC, KIND_VEHICLE],
    )
    ego = make_ego(speed=8.0, yaw_rate=1.0)
    assert not is_violated(ego, wall)
    assert is_violated(ego, wall, ttc.forecast_straight)


def test_standing_ego_is_not_judged():
    agents = make_agents(xy=[(-6.0, 0.0)], speed=[10.0])
    assert not is_violated(make_ego(speed=0.09), agents)
    assert is_violated(make_ego(speed=0.1), agents)


def test_static_things_count_only_where_somebody_is_around():
    thing = make_agents(xy=[(6.0, 0.0)], kind=[KIND_STATIC])
    walker = make_agents(xy=[(6.0, 0.0), (90.0, 0.0)], kind=[KIND_STATIC, KIND_PEDESTRIAN])
    assert not is_violated(make_ego(speed=5.0), thing)
    assert is_violated(make_ego(speed=5.0), walker)


def test_cars_on_the_overpass_do_not_count():
    assert not is_violated(make_ego(), make_agents(xy=[(6.0, 0.0)], z=[7.0]))


@pytest.mark.parametrize("kind", ["arc", "straight"])
def test_turning_and_shifting_the_world_changes_nothing(kind):
    rng = np.random.default_rng(8)
    turn, shift = jnp.float32(1.1), jnp.array([40.0, -25.0])
    for _ in range(20):
        ego = make_ego((0, 0), rng.uniform(-3, 3), 8.0, yaw_rate=rng.normal())
        agents = make_agents(xy=rng.normal(size=(2, 2)) * 12, speed=rng.uniform(0, 9, 2))

        def move(thing):
            return thing.replace(
                xy=geometry.rotate(thing.xy, turn) + shift,
                yaw=geometry.wrap_angle(thing.yaw + turn),
            )

        forecast = FORECASTS[kind][0]
        assert is_violated(ego, agents, forecast) == is_violated(move(ego), move(agents), forecast)


def test_factor_is_half_while_the_timer_runs():
    np.testing.assert_array_equal(ttc.factor(jnp.array([0, 1, 500]), 0.5), [1.0, 0.5, 0.5])
