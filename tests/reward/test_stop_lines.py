"""Red lights and stop signs: drives over lines, step by step, through the composed reward."""

import jax.numpy as jnp
import numpy as np
import pytest
from reward_world import VEHICLE, compute, make_agents, make_ego, make_situation, make_state

from carljax.reward import stop_line, stop_sign
from carljax.reward.config import RewardConfig
from carljax.sim import geometry
from carljax.sim.types import (
    LIGHT_GREEN,
    LIGHT_RED,
    LIGHT_YELLOW,
    STOP_LIGHT,
    STOP_SIGN,
    STOP_YIELD,
)

GREEN, YELLOW, RED = LIGHT_GREEN, LIGHT_YELLOW, LIGHT_RED
HALF = VEHICLE.length / 2  # 2.446 m
TAIL = 0.8 * HALF  # 1.957 m


def drive(
    xs, kind=STOP_LIGHT, colours=None, speeds=None, config=None, lateral=0.0, yaw=0.0, stop_s=100.0
):
    """Drives the centre through `xs` with one line at x = 0 to the east.

    Returns the causes of each step after the first place, as lists of names, and the last memory.
    """
    config = config or RewardConfig()
    colours = [GREEN] * len(xs) if colours is None else colours
    speeds = [5.0] * len(xs) if speeds is None else speeds
    agents, state, causes = make_agents(), None, []
    for x, colour, speed in zip(xs, colours, speeds, strict=True):
        ego = make_ego((x, lateral), yaw, speed)
        situation = make_situation(
            1, stop_s=[stop_s], stop_kind=[kind], stop_light=[colour], route_s=100.0
        )
        if state is None:
            state = make_state(ego, agents, situation)
            continue
        _, _, memory, terms = compute(state, ego, agents, situation, config)
        causes.append([name for name, value in terms.terminated.items() if bool(value)])
        state = state.replace(ego=ego, reward_state=memory)
    return causes, state.reward_state


def test_red_light_is_run_when_the_rear_crosses():
    # The tail point, 1.957 m behind the centre, passes x = 0 between x = 1.9 and 2.0.
    causes, memory = drive([-1.0, 1.0, 1.9, 2.0, 3.0], colours=[RED] * 5)
    assert causes == [[], [], ["red_light"], []]
    assert bool(memory.line_crossed[0])


@pytest.mark.parametrize("colour", [GREEN, YELLOW])
def test_green_and_yellow_may_be_crossed(colour):
    causes, memory = drive([1.0, 3.0], colours=[colour] * 2)
    assert causes == [[]]
    assert bool(memory.line_crossed[0])


def test_yellow_is_run_too_where_the_option_says_so():
    config = RewardConfig(yellow_is_red=True)
    for colour, expected in ((GREEN, []), (YELLOW, ["red_light"]), (RED, ["red_light"])):
        assert drive([1.0, 3.0], colours=[colour] * 2, config=config)[0] == [expected]


def test_standing_on_the_line_when_it_turns_red_and_driving_on_runs_it():
    causes, _ = drive([0.0, 1.0, 1.0, 2.5], colours=[GREEN, GREEN, RED, RED])
    assert causes == [[], [], ["red_light"]]


def test_standing_beyond_the_line_when_it_turns_red_does_not():
    causes, _ = drive([1.0, 2.5, 2.5, 4.0], colours=[GREEN, GREEN, RED, RED])
    assert causes == [[], [], []]


def test_waiting_before_the_line_does_not():
    assert drive([-4.0, -3.0, -3.0], colours=[RED] * 3)[0] == [[], []]


def test_a_fast_car_that_skips_over_the_line_in_one_step_runs_it():
    assert drive([-20.0, 20.0], colours=[RED] * 2)[0] == [["red_light"]]


@pytest.mark.parametrize(
    ("lateral", "expected"), [(17.0, ["red_light"]), (-17.0, ["red_light"]), (18.0, [])]
)
def test_lines_reach_five_lane_widths(lateral, expected):
    # 5 * 3.5 m = 17.5 m to either side.
    assert drive([1.0, 3.0], colours=[RED] * 2, lateral=lateral)[0] == [expected]


def test_crossing_against_its_direction_is_not_running_it():
    # Facing west, the tail is east of the centre and goes over x = 0 from beyond.
    assert drive([-1.0, -3.0], colours=[RED] * 2, yaw=np.pi)[0] == [[]]
    # Sliding over it forwards while facing west neither.
    assert drive([-3.0, -1.0], colours=[RED] * 2, yaw=np.pi)[0] == [[]]


def test_a_line_far_along_the_route_does_not_count():
    # The route comes through this junction again in 31 m.
    for stop_s, expected in (
        (131.0, []),
        (130.0, ["red_light"]),
        (69.0, []),
        (70.0, ["red_light"]),
    ):
        assert drive([1.0, 3.0], colours=[RED] * 2, stop_s=stop_s)[0] == [expected]


def test_penalty_is_paid_for_a_red_light_and_not_for_a_stop_sign():
    for kind, expected in ((STOP_LIGHT, 1.0), (STOP_SIGN, 0.0)):
        ego = make_ego((3.0, 0.0))
        situation = make_situation(1, stop_s=[100.0], stop_kind=[kind], stop_light=[RED])
        state = make_state(make_ego((-1.0, 0.0)), make_agents(), situation)
        value, terminated, _, terms = compute(state, ego, make_agents(), situation, RewardConfig())
        assert bool(terminated)
        assert float(terms.penalty) == expected and float(value) == -expected


def test_stop_sign_is_run_when_the_centre_crosses_without_a_halt():
    causes, _ = drive([-1.0, -0.1, 0.1, 1.0], kind=STOP_SIGN)
    assert causes == [[], ["stop_sign"], []]


def test_stop_sign_after_a_halt_before_the_line():
    # Front bumper at -1.0 m: inside the strip of 3 m before the line.
    stops = [-10.0, -3.446, -3.446, -1.0, 1.0, 3.0]
    speeds = [5.0, 1.0, 0.05, 3.0, 5.0, 5.0]
    causes, memory = drive(stops, kind=STOP_SIGN, speeds=speeds)
    assert causes == [[]] * 5
    assert bool(memory.stop_satisfied[0]) and bool(memory.line_crossed[0])


def test_a_rolling_stop_is_none():
    stops, speeds = [-10.0, -3.446, -1.0, 1.0], [5.0, 0.11, 3.0, 5.0]
    causes, memory = drive(stops, kind=STOP_SIGN, speeds=speeds)
    assert causes == [[], [], ["stop_sign"]]
    assert not bool(memory.stop_satisfied[0])


def test_a_halt_too_early_is_none():
    # Front bumper at -3.1 m, the strip begins at -3 m.
    stops, speeds = [-10.0, -5.546, -1.0, 1.0], [5.0, 0.0, 3.0, 5.0]
    assert drive(stops, kind=STOP_SIGN, speeds=speeds)[0] == [[], [], ["stop_sign"]]


def test_the_rear_bumper_can_be_made_to_decide():
    config = RewardConfig(stop_sign_tail_frac=1.0)
    # Centre beyond, rear before the line: a halt there still counts.
    assert drive([-1.0, 1.0, 2.4, 2.5], kind=STOP_SIGN, config=config)[0] == [[], [], ["stop_sign"]]
    causes, _ = drive(
        [-1.0, 1.0, 1.0, 4.0], kind=STOP_SIGN, speeds=[5.0, 2.0, 0.0, 5.0], config=config
    )
    assert causes == [[], [], []]


def test_yield_signs_and_padding_ask_for_nothing():
    for kind in (STOP_YIELD, 0):
        assert drive([-1.0, 3.0], kind=kind, colours=[RED] * 2)[0] == [[]]


def test_a_halt_counts_for_its_own_sign_only():
    situation = make_situation(
        3,
        stop_xy=[(2.0, 0.0), (2.0, 0.0), (40.0, 0.0)],
        stop_kind=[STOP_SIGN, STOP_LIGHT, STOP_SIGN],
    )
    got = stop_sign.halted(make_ego(speed=0.0), VEHICLE, situation, 0.1)
    np.testing.assert_array_equal(got, [True, False, False])


def test_turning_and_shifting_the_world_changes_nothing():
    rng = np.random.default_rng(5)
    turn, shift = jnp.float32(-2.2), jnp.array([30.0, 12.0])
    verdicts = []
    for _ in range(40):
        before = make_ego(rng.uniform(-4, 0, 2), rng.uniform(-0.7, 0.7))
        after = make_ego(before.xy + jnp.array([3.0, 0.5]), rng.uniform(-0.7, 0.7), 0.0)
        situation = make_situation(
            2, stop_xy=rng.uniform(-2, 2, (2, 2)), stop_yaw=rng.normal(size=2), stop_kind=[2, 2]
        )
        moved = situation.replace(
            stop_xy=geometry.rotate(situation.stop_xy, turn) + shift,
            stop_yaw=situation.stop_yaw + turn,
        )

        def move(ego):
            return ego.replace(xy=geometry.rotate(ego.xy, turn) + shift, yaw=ego.yaw + turn)

        here = stop_line.crossed(before, after, 1.0, situation, 0.6)
        there = stop_line.crossed(move(before), move(after), 1.0, moved, 0.6)
        np.testing.assert_array_equal(here, there)
        np.testing.assert_array_equal(
            stop_sign.halted(after, VEHICLE, situation, 0.1),
            stop_sign.halted(move(after), VEHICLE, moved, 0.1),
        )
        verdicts += list(np.asarray(here))
    assert 8 < sum(verdicts) < 72
