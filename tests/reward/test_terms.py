"""The small terms, one by one, at hand-worked values."""

import jax.numpy as jnp
import numpy as np
import pytest
from reward_world import DT, VEHICLE, f32, make_agents, make_ego

from carljax.reward import (
    blocked,
    collision,
    lane,
    off_road,
    outside_lanes,
    route_completion,
    route_deviation,
    speed_limit,
    timeout,
    timer,
)
from carljax.reward.config import RewardConfig
from carljax.sim.types import KIND_NONE, KIND_PEDESTRIAN, KIND_STATIC, KIND_VEHICLE


@pytest.mark.parametrize(
    ("before", "after", "length", "expected"),
    [
        (100, 103, 1200, 0.25),
        (0, 1, 1000, 0.1),
        (998, 1000, 1000, 0.2),
        (50, 50, 400, 0.0),
        (0, 200, 200, 100.0),
        (100, 90, 1200, 0.0),  # never negative
    ],
)
def test_progress_is_the_percentage_of_the_route(before, after, length, expected):
    gained = route_completion.increment(f32(before), f32(after), f32(length))
    np.testing.assert_allclose(gained, expected, rtol=1e-5)


def test_rounded_progress_is_never_negative():
    assert float(route_completion.rounded_increment(f32(100.0), f32(90.0), f32(1200.0))) == 0.0


def test_rounded_progress_is_a_difference_of_rounded_completions():
    # 100 / 1300 = 7.6923 % -> 7.69, 101 / 1300 = 7.7692 % -> 7.77: 0.08, not 0.0769.
    gained = route_completion.rounded_increment(f32(100.0), f32(101.0), f32(1300.0))
    np.testing.assert_allclose(gained, 0.08, rtol=1e-5)


def test_rounded_progress_adds_up_to_the_whole_route():
    places = np.arange(0.0, 777.5, 0.7, dtype=np.float32)
    gained = route_completion.rounded_increment(f32(places[:-1]), f32(places[1:]), f32(777.0))
    np.testing.assert_allclose(gained.sum(), 100 * places[-1] / 777, atol=0.006)


@pytest.mark.parametrize(
    ("route_idx", "num_points", "finished"),
    [
        (0, 100, False),
        (97, 100, False),  # two points left
        (98, 100, True),  # one
        (99, 100, True),
        (98, 101, False),  # the same place of a longer route
        (0, 2, True),
    ],
)
def test_finished_with_fewer_than_two_points_left(route_idx, num_points, finished):
    got = route_completion.is_finished(jnp.int32(route_idx), jnp.int32(num_points))
    assert bool(got) is finished


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        # Ego 4.892 long, the other 4.0: bumpers meet at 2.446 + 2 = 4.446 m.
        ({"xy": [(4.4, 0.0)]}, True),
        ({"xy": [(4.5, 0.0)]}, False),
        # Side by side: 0.918 + 1 = 1.918 m.
        ({"xy": [(0.0, 1.9)]}, True),
        ({"xy": [(0.0, -1.95)]}, False),
        ({"xy": [(4.4, 0.0)], "kind": [KIND_NONE]}, False),
        ({"xy": [(4.4, 0.0)], "kind": [KIND_STATIC]}, True),
        ({"xy": [(50.0, 0.0), (1.0, 0.5)], "kind": [KIND_VEHICLE, KIND_PEDESTRIAN]}, True),
        ({"xy": [(0.0, 0.0)], "z": [6.0]}, False),  # on the overpass above
        ({"xy": [(0.0, 0.0)], "z": [-2.0]}, True),
    ],
)
def test_collision(fields, expected):
    got = collision.collided(make_ego(), make_agents(**fields), VEHICLE, 3.0)
    assert bool(got) is expected


@pytest.mark.parametrize(
    ("frac", "expected"),
    [(0.0, False), (0.5, False), (0.94, False), (0.95, False), (0.96, True), (1.0, True)],
)
def test_off_road(frac, expected):
    assert bool(off_road.is_off_road(f32(frac), f32(0.95))) is expected


@pytest.mark.parametrize(
    ("distance", "far", "expected"),
    [
        (0.0, 0.0, False),
        (29.9, 0.0, False),
        (30.0, 0.0, True),
        (80.0, 0.0, True),
        (0.0, 300.0, False),
        (0.0, 300.5, True),
    ],
)
def test_route_deviation_by_distance(distance, far, expected):
    got = route_deviation.has_deviated(f32(distance), 30.0, f32(far), 300.0)
    assert bool(got) is expected


def test_route_deviation_by_advance_far_from_it():
    far = f32(0.0)
    for distance in (14.0, 16.0, 16.0, 15.0):  # 2 m each; only beyond 15 m counts
        far = route_deviation.far_advance(far, f32(2.0), f32(distance), 15.0)
    assert float(far) == 4.0
    assert not bool(route_deviation.has_deviated(f32(16.0), 30.0, far, 0.3 * 20.0))
    assert bool(route_deviation.has_deviated(f32(0.0), 30.0, far, 0.3 * 10.0))


def test_blocked_after_more_than_ninety_seconds_of_standing():
    standing, steps = f32(0.0), 0
    while not bool(blocked.is_blocked(standing, 90.0, DT)):
        standing = blocked.standing_time(standing, f32(0.05), 0.1, DT)
        steps += 1
    assert steps == 901  # 90.0 s are allowed, 90.1 s are not
    assert float(blocked.standing_time(standing, f32(0.1), 0.1, DT)) == 0.0  # moving again


@pytest.mark.parametrize(
    ("steps", "limit", "expected"),
    [
        (1, 1200.0, False),
        (12000, 1200.0, False),
        (12001, 1200.0, True),
        (150, 15.0, False),
        (151, 15.0, True),
        (1, 0.0, True),
    ],
)
def test_timeout_after_the_limit(steps, limit, expected):
    assert bool(timeout.is_timeout(jnp.int32(steps), limit, DT)) is expected


@pytest.mark.parametrize(
    ("before", "speed", "expected"),
    [(0, 0.05, 0.1), (5, 0.0, 5.1), (5, 0.1, 0.0), (5, 3.0, 0.0), (89.9, 0.09, 90.0), (0, 1, 0.0)],
)
def test_standing_time(before, speed, expected):
    got = blocked.standing_time(f32(before), f32(speed), 0.1, DT)
    np.testing.assert_allclose(got, expected, atol=1e-5)


@pytest.mark.parametrize(
    ("lateral", "on_parking", "expected"),
    [
        (0.0, False, False),
        (2.2, False, False),
        (-2.2, False, False),
        (2.3, False, True),
        (-2.3, False, True),
        (2.3, True, False),
    ],
)
def test_off_lanes_half_a_metre_past_the_edge(lateral, on_parking, expected):
    # Lane of 3.5 m: 1.75 + 0.5 = 2.25 m.
    got = outside_lanes.is_off_lanes(f32(lateral), f32(3.5), jnp.bool_(on_parking), 0.5)
    assert bool(got) is expected


@pytest.mark.parametrize(
    ("degrees", "in_junction", "expected"),
    [
        (0, False, False),
        (119, False, False),
        (-119, False, False),
        (121, False, True),
        (-121, False, True),
        (180, True, False),
    ],
)
def test_wrong_way_outside_junctions(degrees, in_junction, expected):
    # Around the seam at +-180 degrees: the lane points to 170 degrees.
    lane_yaw = np.radians(170)
    got = outside_lanes.is_wrong_way(
        f32(lane_yaw + np.radians(degrees) - 2 * np.pi),
        f32(lane_yaw),
        jnp.bool_(in_junction),
        RewardConfig().wrong_way_angle,
    )
    assert bool(got) is expected


@pytest.mark.parametrize(
    ("lateral", "in_junction", "expected"),
    [
        (0.0, False, 1.0),
        (0.7, False, 0.6),
        (-1.4, False, 0.2),
        (1.75, False, 0.0),
        (5.0, False, 0.0),
        (5.0, True, 1.0),
    ],
)
def test_lane_centre_factor(lateral, in_junction, expected):
    # Half a lane is 1.75 m: 0.7 / 1.75 = 0.4, 1.4 / 1.75 = 0.8.
    got = lane.factor(f32(lateral), f32(3.5), jnp.bool_(in_junction))
    np.testing.assert_allclose(got, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("over_kmh", "expected"),
    [(-20.0, 1.0), (0.0, 1.0), (2.0, 0.75), (4.0, 0.5), (6.0, 0.25), (9.0, 0.0)],
)
def test_speeding_factor_reaches_zero_at_eight_kmh(over_kmh, expected):
    got = speed_limit.factor(
        f32((50 + over_kmh) / 3.6), f32(50 / 3.6), RewardConfig().speeding_range
    )
    np.testing.assert_allclose(got, expected, atol=1e-6)


def test_timer_holds_for_exactly_its_duration():
    left, held = jnp.int32(0), []
    for violated in [True] + [False] * 6:
        left = timer.tick(left, jnp.bool_(violated), 4)
        held.append(bool(left > 0))
    assert held == [True] * 4 + [False] * 3
    assert left.dtype == jnp.int32 and not left.weak_type


def test_timer_starts_anew_on_another_violation():
    left, held = jnp.int32(0), []
    for violated in (True, False, True, False, False, False):
        left = timer.tick(left, jnp.bool_(violated), 3)
        held.append(int(left))
    assert held == [3, 2, 3, 2, 1, 0]


@pytest.mark.parametrize("field", ["ttc_ticks", "terminal_penalty", "time_limit_s"])
def test_config_refuses_negative_numbers_by_name(field):
    with pytest.raises(ValueError, match=f"reward.{field}: -1 is below"):
        RewardConfig(**{field: -1})


def test_config_refuses_a_division_by_zero():
    with pytest.raises(ValueError, match="reward.speeding_range"):
        RewardConfig(speeding_range=0.0)


def test_defaults_are_the_paper_s():
    config = RewardConfig()
    assert (config.ttc_forecast, config.comfort_limits) == ("arc", "carla")
    assert (config.ttc_ticks, config.comfort_ticks) == (500, 500)
    assert (config.ttc_factor, config.comfort_weight, config.terminal_penalty) == (0.5, 0.5, 1.0)
    assert (config.deviation_distance, config.blocked_speed, config.blocked_s) == (30.0, 0.1, 90.0)
    np.testing.assert_allclose(config.speeding_range * 3.6, 8.0)
