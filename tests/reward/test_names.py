"""Rewards by name: what can be asked for, what is refused, what is logged, compiled once each."""

import typing

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reward_world import DT, VEHICLE, make_agents, make_ego, make_situation, make_state, one_step

from carljax import config as config_module
from carljax import train
from carljax.config import ConfigError, TrainConfig
from carljax.reward import config, reward
from carljax.reward.carl_nuplan import CarlNuplanConfig
from carljax.reward.config import RewardConfig
from carljax.reward.roach import RoachConfig
from carljax.reward.think2drive import Think2DriveConfig


def test_every_name_has_its_reward():
    assert set(typing.get_args(config.Name)) == set(reward.REWARDS)
    assert RewardConfig().name == "carl"


@pytest.mark.parametrize("name", reward.REWARDS)
def test_what_is_logged_is_what_was_announced(name):
    *_, terms = one_step(RewardConfig(name=name))
    chosen = reward.REWARDS[name]
    assert set(terms.added) == set(chosen.added) and set(terms.soft) == set(chosen.soft)
    assert set(terms.terminated) == set(chosen.causes)
    metrics = reward.metrics(terms)
    assert set(metrics) == {f"reward/{term}" for term in chosen.terms}
    assert len(metrics) == len(chosen.terms)  # no name twice
    assert all(value.dtype == jnp.float32 and value.shape == () for value in metrics.values())


@pytest.mark.parametrize("name", reward.REWARDS)
def test_memory_keeps_its_types_and_compiles_once(name):
    values = RewardConfig(name=name)
    ego, agents, situation = make_ego(), make_agents(xy=[(9.0, 0.0)]), make_situation()
    chex.clear_trace_counter()

    @jax.jit
    @chex.assert_max_traces(n=1)
    def compute_once(state, ego, agents, situation):
        return reward.compute(state, ego, agents, situation, VEHICLE, values, DT)

    state = make_state(ego, agents, situation, config=values)
    for _ in range(3):
        value, ended, memory, terms = compute_once(state, ego, agents, situation)
        chex.assert_trees_all_equal_shapes_and_dtypes(memory, state.reward_state)
        assert not any(x.weak_type for x in jax.tree.leaves((value, ended, memory, terms)))
        state = state.replace(reward_state=memory)


@pytest.mark.parametrize("name", reward.REWARDS)
def test_numbers_can_be_swept_under_vmap(name):
    situation = make_situation(lane_lateral=0.9, speed_limit=4.0)
    ego, agents = make_ego(), make_agents(xy=[(4.0, 0.0)])
    state = make_state(ego, agents, situation, config=RewardConfig(name=name))

    def value(factor):
        start = RewardConfig(name=name)
        swept = jax.tree.map(lambda x: jnp.float32(x) * factor, start)
        return reward.compute(state, ego, agents, situation, VEHICLE, swept, DT)[0]

    got = jax.jit(jax.vmap(value))(jnp.float32([0.9, 1.0, 1.1]))
    assert got.shape == (3,) and np.isfinite(got).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RewardConfig(name="karl"), "reward.name: 'karl' is none of carl, carl-nuplan,"),
        (lambda: CarlNuplanConfig(lane_room=-1), "reward.carl_nuplan.lane_room: -1 is below"),
        (lambda: CarlNuplanConfig(survival_ratio=1.5), "reward.carl_nuplan.survival_ratio: 1.5 is"),
        (lambda: RoachConfig(light_margin=-2.0), "reward.roach.light_margin: -2.0 is below"),
        (lambda: RoachConfig(span=0.0), "reward.roach.span: 0 is not above 0"),
        (lambda: Think2DriveConfig(goal_bonus=-1), "reward.think2drive.goal_bonus: -1 is below"),
        (lambda: Think2DriveConfig(speed_span=0), "reward.think2drive.speed_span: 0 is not"),
    ],
)
def test_a_mistake_is_one_line_that_names_the_field(make, message):
    with pytest.raises(ValueError, match="^" + message.replace(".", r"\.")) as caught:
        make()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"name": "karl"}, "reward.name: 'karl' is none of 'carl', 'carl-nuplan'"),
        ({"roach": {"span": -5.0}}, "reward.roach.span: -5.0 is below"),
        ({"roach": {"spam": 5.0}}, "reward.roach.spam: no such field; near: span"),
        ({"carl_nuplan": {"ttc_forecast": "bent"}}, "'bent' is none of 'arc', 'straight'"),
    ],
)
def test_a_mistake_in_a_file_is_one_line(values, message):
    with pytest.raises(ConfigError) as caught:
        config_module.from_json(TrainConfig, {"reward": values})
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_the_command_line_reaches_every_reward():
    arguments = ["--reward.name", "carl-nuplan-survival", "--reward.roach.span", "4"]
    arguments += ["--reward.carl-nuplan.survival-ratio", "0.2"]
    got = train.parse(arguments).config.reward
    assert (got.name, got.carl_nuplan.survival_ratio, got.roach.span) == (
        "carl-nuplan-survival",
        0.2,
        4.0,
    )
    again = config_module.from_json(
        TrainConfig, config_module.to_json(train.parse(arguments).config)
    )
    assert again.reward == got


@pytest.mark.parametrize("arguments", [["--reward.name", "karl"], ["--reward.roach.span", "-1"]])
def test_the_command_line_refuses_with_status_2(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        train.parse(arguments)
    assert caught.value.code == 2
    assert "reward" in capsys.readouterr().err


def test_defaults_are_the_papers():
    nuplan, roach, drive = CarlNuplanConfig(), RoachConfig(), Think2DriveConfig()
    assert (nuplan.survival_ratio, nuplan.terminal_penalty, nuplan.lane_room) == (0.6, 1.0, 0.5)
    assert (nuplan.lane_weight, nuplan.comfort_weight, nuplan.comfort_limits) == (1, 0.5, "nuplan")
    assert nuplan.collision_min_speed == 0.05
    assert (roach.max_speed, roach.vehicle_margin, roach.pedestrian_margin) == (6, 8, 6)
    assert (roach.light_margin, roach.stop_sign_margin, roach.charge_every_end) == (5, 5, False)
    assert (drive.vehicle_margin, drive.light_margin, drive.stop_sign_margin) == (8, 4, 2.5)
    assert (drive.limit_frac, drive.speed_span, drive.span, drive.blocked_s) == (
        0.8,
        7.5,
        12.5,
        100,
    )
