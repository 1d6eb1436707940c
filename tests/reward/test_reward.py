"""The composed reward: formula, causes, memory, options, and that it compiles once."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reward_world import (
    DT,
    VEHICLE,
    compute,
    make_agents,
    make_ego,
    make_situation,
    make_state,
)

from carljax.reward import carl, comfort, reward
from carljax.reward.config import RewardConfig
from carljax.sim import bicycle, geometry

CONFIG = RewardConfig()


def run(ego=None, agents=None, situation=None, config=CONFIG, before=None, step_count=0, **memory):
    ego = make_ego() if ego is None else ego
    agents = make_agents() if agents is None else agents
    situation = make_situation() if situation is None else situation
    state = make_state(before or ego, agents, situation, step_count, **memory)
    return compute(state, ego, agents, situation, config)


def test_plain_driving_pays_the_progress():
    # 2 m of 1000 m: 0.2 %; nothing else in the way.
    value, terminated, memory, terms = run(route_s=jnp.float32(98.0))
    np.testing.assert_allclose(value, 0.2, rtol=1e-4)
    assert not bool(terminated) and not bool(terms.finished) and not bool(terms.timeout)
    assert float(memory.route_s) == 100.0
    assert set(terms.soft) == set(carl.SOFT_FACTORS)
    assert set(terms.terminated) == set(carl.CAUSES)
    np.testing.assert_array_equal([float(f) for f in terms.soft.values()], np.ones(5))


def test_soft_factors_multiply_the_progress():
    # Lane: 1 - 0.7 / 1.75 = 0.6. Speed: 11 m/s at limit 10, 1 - 3.6 / 8 = 0.55. TTC 0.5.
    # Comfort with 3 of 6 timers: 0.75. Progress 0.2: 0.2 * 0.6 * 0.55 * 0.5 * 0.75 = 0.02475.
    value, *_ = run(
        make_ego(speed=11.0),
        situation=make_situation(lane_lateral=0.7),
        route_s=jnp.float32(98.0),
        ttc_ticks=jnp.int32(10),
        comfort_ticks=jnp.array([9, 9, 9, 0, 0, 0], jnp.int32),
    )
    np.testing.assert_allclose(value, 0.02475, rtol=1e-4)


@pytest.mark.parametrize(
    "fields", [{"lane_lateral": 3.0}, {"lane_yaw": np.pi}], ids=["sidewalk", "opposing lane"]
)
def test_outside_lanes_pays_nothing(fields):
    value, terminated, _, terms = run(situation=make_situation(**fields), route_s=jnp.float32(98.0))
    assert float(value) == 0.0 and float(terms.soft["outside_lanes"]) == 0.0
    assert not bool(terminated)


def test_collision_pays_the_increment_and_the_unscaled_penalty():
    # 0.2 * 0.6 (lane) * 0.5 (TTC: the boxes overlap in the forecast too) - 1.
    value, terminated, _, terms = run(
        agents=make_agents(xy=[(4.0, 0.0)]),
        situation=make_situation(lane_lateral=0.7),
        route_s=jnp.float32(98.0),
    )
    assert bool(terminated) and bool(terms.terminated["collision"])
    np.testing.assert_allclose(value, 0.2 * 0.6 * 0.5 - 1.0, rtol=1e-4)


@pytest.mark.parametrize(
    ("cause", "fields", "memory"),
    [
        ("off_road", {"off_road_frac": 0.97}, {}),
        ("route_deviation", {"route_distance": 30.0}, {}),
        ("route_deviation", {"route_distance": 16.0}, {"far_from_route_m": 301.0}),
        ("blocked", {}, {"stopped_s": 90.0}),
    ],
)
def test_other_causes_end_the_episode_without_a_penalty(cause, fields, memory):
    speed = 0.0 if cause == "blocked" else 5.0
    value, terminated, _, terms = run(
        make_ego(speed=speed),
        situation=make_situation(**fields),
        **{name: jnp.float32(v) for name, v in memory.items()},
    )
    assert [name for name, v in terms.terminated.items() if bool(v)] == [cause]
    assert bool(terminated) and float(value) == 0.0 and float(terms.penalty) == 0.0


def test_no_pay_for_going_back_and_forth():
    _, _, memory, _ = run(situation=make_situation(route_s=97.0), route_s=jnp.float32(99.0))
    assert float(memory.route_s) == 99.0
    value, _, memory, _ = run(situation=make_situation(route_s=99.5), route_s=memory.route_s)
    np.testing.assert_allclose(value, 0.05, rtol=1e-4)


def test_a_route_starts_with_an_empty_memory():
    memory = reward.init(make_ego(yaw=2.0), 3, CONFIG)
    assert float(memory.route_s) == 0.0 and int(memory.history.num) == 0
    assert memory.stop_satisfied.shape == memory.line_crossed.shape == (3,)
    np.testing.assert_array_equal(memory.history.yaw, np.full(15, np.float32(2.0)))


def test_end_of_the_route_is_no_failure():
    # 1001 points, the last passed is 999: one left.
    _, terminated, _, terms = run(situation=make_situation(route_idx=999, route_s=999.0))
    assert bool(terms.finished) and not bool(terminated)


def test_time_limit_truncates_and_terminates_where_the_option_says_so():
    for terminates in (False, True):
        config = RewardConfig(timeout_terminates=terminates)
        for steps_before, expected in ((11999, False), (12000, True)):
            _, terminated, _, terms = run(config=config, step_count=steps_before)
            assert bool(terms.timeout) is expected
            assert bool(terminated) is (expected and terminates)


def test_rounded_progress_is_an_option():
    # From 98.00 to 100.04 m of 1000 m: 9.80 % to 10.004 % -> 10.00 %.
    situation = make_situation(route_s=100.04)
    exact, *_ = run(situation=situation, route_s=jnp.float32(98.0))
    rounded, *_ = run(
        situation=situation,
        route_s=jnp.float32(98.0),
        config=RewardConfig(round_progress=True),
    )
    np.testing.assert_allclose([exact, rounded], [0.204, 0.2], rtol=1e-4)


def test_forecast_of_ttc_is_an_option():
    # A standing car 9.2 m ahead at 5 m/s: met after 0.95 s, see test_ttc.
    for forecast, expected in (("arc", 0.5), ("straight", 1.0)):
        *_, terms = run(
            agents=make_agents(xy=[(9.2, 0.0)]), config=RewardConfig(ttc_forecast=forecast)
        )
        assert float(terms.soft["ttc"]) == expected


def test_comfort_limits_are_an_option():
    # 5 m/s at 0.97 rad/s is within CARLA's limits and beyond nuPlan's in yaw rate, for 8 samples.
    for limits, expected in (("carla", 0), ("nuplan", 1)):
        ego = make_ego(yaw_rate=0.97)
        history = comfort.empty_history(ego)
        for step in range(7):
            history = comfort.push(history, ego.replace(yaw=jnp.float32(0.097 * step)))
        config = RewardConfig(comfort_limits=limits)
        _, _, memory, terms = run(
            ego.replace(yaw=jnp.float32(0.097 * 7)), config=config, history=history
        )
        assert int((memory.comfort_ticks > 0).sum()) == expected
        np.testing.assert_allclose(terms.soft["comfort"], 1 - expected / 12, rtol=1e-6)


def test_ttc_penalty_holds_for_its_ticks():
    config = RewardConfig(ttc_ticks=3)
    state = make_state(make_ego(), make_agents(), make_situation())
    factors = []
    for step in range(5):
        agents = make_agents(xy=[(6.0, 0.0)]) if step == 0 else make_agents()
        _, _, memory, terms = compute(state, make_ego(), agents, make_situation(), config)
        state = state.replace(reward_state=memory)
        factors.append(float(terms.soft["ttc"]))
    assert factors == [0.5, 0.5, 0.5, 1.0, 1.0]


@jax.jit
def bicycle_step(ego, steer, throttle):
    return bicycle.step(ego, steer, throttle, jnp.float32(0.0), VEHICLE, DT)


def random_step(rng):
    """A random state and step that may set off anything."""
    situation = make_situation(
        lane_lateral=rng.normal(),
        lane_yaw=rng.uniform(-3, 3),
        lane_in_junction=rng.random() < 0.3,
        off_road_frac=rng.choice([0.0, 0.6, 0.97]),
        route_s=100 + 3 * rng.random(),
        route_distance=rng.choice([0.0, 16.0, 31.0]),
        stop_s=np.full(3, 100.0),
        stop_xy=rng.normal(size=(3, 2)) * 3,
        stop_yaw=rng.normal(size=3),
        stop_kind=rng.integers(0, 4, 3),
        stop_light=rng.integers(0, 3, 3),
    )
    agents = make_agents(
        4, xy=rng.normal(size=(4, 2)) * 8, yaw=rng.normal(size=4), speed=rng.uniform(0, 9, 4)
    )
    before = make_ego(rng.normal(size=2), rng.normal(), rng.uniform(0, 12))
    steer, throttle = (jnp.float32(rng.uniform(*r)) for r in ((-1, 1), (0, 1)))
    ego = bicycle_step(before, steer, throttle)
    state = make_state(before, agents, situation)
    memory = state.reward_state.replace(route_s=jnp.float32(100.0))
    return state.replace(reward_state=memory), ego, agents, situation


def test_turning_and_shifting_the_world_changes_nothing():
    rng = np.random.default_rng(11)
    turn, shift = 0.8, jnp.array([25.0, -60.0])

    def move(thing):
        xy = geometry.rotate(thing.xy, jnp.float32(turn)) + shift
        return thing.replace(xy=xy, yaw=geometry.wrap_angle(thing.yaw + turn))

    causes = set()
    for _ in range(100):
        state, ego, agents, situation = random_step(rng)
        moved_situation = situation.replace(
            lane_yaw=geometry.wrap_angle(situation.lane_yaw + turn),
            stop_xy=geometry.rotate(situation.stop_xy, jnp.float32(turn)) + shift,
            stop_yaw=geometry.wrap_angle(situation.stop_yaw + turn),
        )
        moved_state = make_state(move(state.ego), move(agents), moved_situation)
        moved_state = moved_state.replace(
            reward_state=moved_state.reward_state.replace(route_s=jnp.float32(100.0))
        )
        here = compute(state, ego, agents, situation, CONFIG)
        there = compute(moved_state, move(ego), move(agents), moved_situation, CONFIG)
        np.testing.assert_allclose(here[0], there[0], atol=1e-5)
        chex.assert_trees_all_close(here[3], there[3], atol=1e-5)
        causes |= {name for name, value in here[3].terminated.items() if bool(value)}
    assert {"collision", "off_road", "red_light", "route_deviation"} <= causes


def test_vmap_equals_a_loop():
    rng = np.random.default_rng(12)
    steps = [random_step(rng) for _ in range(8)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *steps)
    looped = jax.tree.map(lambda *x: jnp.stack(x), *[compute(*step, CONFIG) for step in steps])
    batched = jax.vmap(functools.partial(compute, config=CONFIG))(*stacked)
    chex.assert_trees_all_close(batched, looped, atol=1e-4)


def test_memory_keeps_its_types_and_compiles_once():
    rng = np.random.default_rng(13)
    chex.clear_trace_counter()

    @jax.jit
    @chex.assert_max_traces(n=1)
    def compute_once(state, ego, agents, situation):
        return reward.compute(state, ego, agents, situation, VEHICLE, CONFIG, DT)

    state, *step = random_step(rng)
    for _ in range(3):
        value, _, memory, terms = compute_once(state, *step)
        chex.assert_trees_all_equal_shapes_and_dtypes(memory, state.reward_state)
        assert not any(leaf.weak_type for leaf in jax.tree.leaves((value, memory, terms)))
        state = state.replace(reward_state=memory)


def test_numbers_can_be_swept_under_vmap():
    state, ego, agents, situation = random_step(np.random.default_rng(14))
    agents = make_agents(4, xy=[(0.0, 0.0)])
    state = state.replace(agents=agents)
    ego = ego.replace(xy=jnp.zeros(2))

    def penalty(value):
        config = RewardConfig(terminal_penalty=value)
        return reward.compute(state, ego, agents, situation, VEHICLE, config, DT)[3].penalty

    sweep = jax.jit(jax.vmap(penalty))
    np.testing.assert_array_equal(sweep(jnp.array([0.0, 0.5, 2.0])), [0.0, 0.5, 2.0])


def test_metrics_name_every_term():
    *_, terms = run()
    metrics = reward.metrics(terms)
    names = {*carl.SOFT_FACTORS, *carl.CAUSES, "progress", "finished", "timeout", "penalty"}
    assert set(metrics) == {f"reward/{name}" for name in names}
    assert all(value.dtype == jnp.float32 and value.shape == () for value in metrics.values())
