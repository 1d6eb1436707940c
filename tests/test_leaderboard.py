"""What happens on an evaluated drive: collisions and after, speeds by stages, ends of routes.

Most of it on a straight road of one lane to the east, where the numbers can be worked out.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import opendrive_files as files
import pytest

from carljax import aftermath, event_log, leaderboard, min_speed
from carljax.leaderboard import BLOCKED_S, EVENTS, TIME_S
from carljax.reward.config import RewardConfig
from carljax.sim import env as env_module
from carljax.sim import episodes, population, town
from carljax.sim.env import EnvConfig
from carljax.sim.raster_canvas import RasterConfig
from carljax.sim.types import KIND_PEDESTRIAN, KIND_STATIC, KIND_VEHICLE

LIMIT = 10.0  # m/s
LENGTH = 300.0  # m, of the route
DT = 0.1
NUM_CARS = 2
# First of the rows in which things stand that no traffic rule moves.
HERE = EnvConfig(
    num_agents=NUM_CARS, num_pedestrians=0, num_scenario_slots=1
).population.others.start
GO, ROLL, STAND = (0.0, 1.0), (0.0, 0.0), (0.0, -1.0)


@pytest.fixture(scope="module")
def env(tmp_path_factory):
    """One route on an empty straight road; training's limits are not the leaderboard's."""
    path = tmp_path_factory.mktemp("map") / "straight.xodr"
    limit = f'<type s="0" type="town"><speed max="{LIMIT}" unit="m/s"/></type>'
    lanes = files.section([files.lane(-1)])
    path.write_text(files.document(files.road(1, 700.0, sections=lanes, kind=limit)))
    config = EnvConfig(
        num_agents=NUM_CARS,
        num_pedestrians=0,
        num_scenario_slots=1,
        route_length=LENGTH,
        raster=RasterConfig(16, 16, pixels_per_metre=0.5, ego_from_bottom_px=4),
    )
    bank = episodes.make_bank([town.load(path)], 1, config.population, 0, LENGTH)
    bank = bank.replace(agents=jax.tree.map(jnp.zeros_like, bank.agents))
    assert float(bank.routes.speed_limit[0, 0]) == LIMIT
    return env_module.make_env(bank, config, RewardConfig(blocked_s=5.0, time_limit_s=20.0))


@pytest.fixture(scope="module")
def begin(env):
    """The first moment of the drive."""
    start = jax.jit(lambda env: env.start_episode(jnp.int32(0), jax.random.key(0)))
    return leaderboard.begin(start(env))


advance = jax.jit(leaderboard.advance)


def drive_on(env, drive, action, num_steps):
    """Every drive on the way, the last step's included."""
    drives = []
    for _ in range(num_steps):
        drive = advance(env, drive, jnp.float32(action))
        drives.append(drive)
    return drives


def altered(drive, ego=None, agents=None, **values):
    """The same drive with another ego, other agents or other values of the simulator."""
    sim = drive.state.pipeline_state
    sim = sim.replace(ego=sim.ego.replace(**(ego or {})), **values)
    if agents is not None:
        sim = sim.replace(agents=agents)
    return drive.replace(state=drive.state.replace(pipeline_state=sim))


def parked(drive, ahead, kind=KIND_VEHICLE, row=HERE):
    """The agents and one more: 4 m by 2 m, at rest on the ego's lane, so far ahead of it."""
    sim = drive.state.pipeline_state
    place = {
        "xy": sim.ego.xy + jnp.float32([ahead, 0.0]),
        "length": 4.0,
        "width": 2.0,
        "kind": kind,
    }
    agents = sim.agents
    return agents.replace(
        **{name: getattr(agents, name).at[row].set(x) for name, x in place.items()}
    )


def moving(drive, x=50.0, speed=10.0):
    """The drive with the ego at a speed, so many metres on its way."""
    sim = drive.state.pipeline_state
    place = sim.ego.xy + jnp.float32([x, 0.0])
    return altered(
        drive,
        {"xy": place, "speed": jnp.float32(speed)},
        route_idx=jnp.int32(x),
    )


def number_of(drive, name):
    return int(drive.counts[name])


@pytest.fixture(scope="module")
def crash(env, begin):
    """A drive at 10 m/s into a car that stands 10 m ahead, throttle down all the time."""
    drive = moving(begin)
    return drive_on(env, altered(drive, agents=parked(drive, 10.0)), GO, 80)


def impact(drives):
    return next(i for i, drive in enumerate(drives) if number_of(drive, "vehicle_collision"))


def test_the_impact_stops_the_ego(crash):
    at = impact(crash)
    # From bumper to bumper 10 - (4.892 + 4) / 2 = 5.55 m, at 10 m/s and more: within 0.6 s.
    assert at <= 5
    assert float(crash[at - 1].state.pipeline_state.ego.speed) > 9.0
    assert float(crash[at].state.pipeline_state.ego.speed) == 0.0
    assert float(crash[at].state.done) == 0.0


def test_for_a_moment_nobody_moves_then_the_struck_is_gone_and_the_ego_drives_on(crash):
    at = impact(crash)
    xy = np.array([drive.state.pipeline_state.ego.xy for drive in crash])
    car = np.array([drive.state.pipeline_state.agents.xy[HERE] for drive in crash])
    here = np.array([bool(drive.state.pipeline_state.agents.valid[HERE]) for drive in crash])
    stay = round(aftermath.STAY / DT)
    np.testing.assert_array_equal(xy[at : at + stay], np.tile(xy[at], (stay, 1)))
    np.testing.assert_array_equal(car[at : at + stay], np.tile(car[at], (stay, 1)))
    assert here[at : at + stay].all() and not here[at + stay :].any()
    assert xy[at + stay + 10, 0] > xy[at, 0] + 1.0
    # Not through the other: it had gone before the ego moved.
    assert np.argmax(xy[at:, 0] > xy[at, 0]) >= stay


def test_the_contact_counts_once(crash):
    assert number_of(crash[-1], "vehicle_collision") == 1
    log = crash[-1].log
    assert int(log.num) == 1
    assert EVENTS[int(log.kind[0])] == "vehicle_collision"
    assert int(log.agent[0]) == HERE
    assert int(log.step[0]) == impact(crash) + 1
    ego = crash[impact(crash)].state.pipeline_state.ego
    np.testing.assert_array_equal(log.xyz[0], [*ego.xy, ego.z])


def test_the_first_infraction_ends_the_clean_completion(crash):
    at = impact(crash)
    assert float(crash[-1].completion) > float(crash[at].completion)
    assert float(crash[-1].clean_completion) == float(crash[at].completion)


def test_who_runs_into_a_standing_ego_is_not_charged_to_it(env, begin):
    drive = moving(begin, speed=0.0)
    after = drive_on(env, altered(drive, agents=parked(drive, 3.0)), STAND, 35)
    assert number_of(after[-1], "vehicle_collision") == 0
    # It is taken away all the same.
    assert bool(after[0].state.pipeline_state.agents.valid[HERE])
    assert not bool(after[-1].state.pipeline_state.agents.valid[HERE])


@pytest.mark.parametrize(("gap", "num"), [(4.0, 1), (12.0, 2)])
def test_one_place_counts_once_within_five_metres(env, begin, gap, num):
    """A second obstacle that the ego meets so much farther on."""
    drive = moving(begin)
    agents = parked(drive, 6.0, KIND_STATIC)
    drive = altered(drive, agents=agents)
    drive = altered(drive, agents=parked(drive, 6.0 + gap, KIND_STATIC, row=HERE + 1))
    after = drive_on(env, drive, GO, 120)
    assert not np.asarray(after[-1].state.pipeline_state.agents.valid).any()  # both were struck
    assert number_of(after[-1], "static_collision") == num


def test_of_several_struck_at_once_the_gravest_counts(env, begin):
    drive = moving(begin)
    agents = parked(drive, 5.0, KIND_STATIC)
    for row, kind in ((HERE + 1, KIND_PEDESTRIAN), (HERE + 2, KIND_VEHICLE)):
        agents = parked(altered(drive, agents=agents), 5.0, kind, row)
    after = drive_on(env, altered(drive, agents=agents), GO, 5)[-1]
    counts = {name: int(num) for name, num in after.counts.items() if num}
    assert counts == {"pedestrian_collision": 1}
    assert int(after.log.agent[0]) == HERE + 1


def test_a_row_belongs_to_somebody_new_once_the_simulator_fills_it_again():
    gone = population.nobody(2)
    here = gone.replace(kind=jnp.full(2, KIND_VEHICLE, jnp.int32), speed=jnp.float32([5.0, 6.0]))
    struck = aftermath.nothing(2).replace(struck_s=jnp.float32([aftermath.STAY, -1.0]))
    after, agents = aftermath.settle(struck, gone, here, DT)
    assert agents.kind.tolist() == [KIND_VEHICLE, KIND_VEHICLE]
    assert after.struck_s.tolist() == [-1.0, -1.0]
    # Where it has gone on to be filled, it is taken away.
    after, agents = aftermath.settle(struck, here, here, DT)
    assert agents.valid.tolist() == [False, True]
    assert after.struck_s.tolist() == [pytest.approx(aftermath.STAY + DT), -1.0]


def follow_with(begin, ego_speed, traffic_speed, steps):
    """Mean speeds measured by `min_speed` alone, the ego going evenly along the route."""
    length = jnp.float32(400.0)
    sim = begin.state.pipeline_state
    traffic = population.nobody(2)
    traffic = traffic.replace(
        xy=sim.ego.xy + jnp.float32([[20.0, 0.0], [150.0, 0.0]]),
        kind=jnp.full(2, KIND_VEHICLE, jnp.int32),
        speed=jnp.float32([traffic_speed, 1000.0]),  # the second one is too far away to count
    )
    ego = sim.ego.replace(speed=jnp.float32(ego_speed))

    def step(measured, route_s):
        return min_speed.update(measured, ego, traffic, route_s, length), None

    route_s = jnp.float32(ego_speed * DT) * jnp.arange(1, steps + 1, dtype=jnp.float32)
    measured, _ = jax.lax.scan(step, min_speed.start(), route_s)
    return min_speed.finish_where(jnp.bool_(True), measured, route_s[-1], length)


@pytest.mark.parametrize(
    ("ego_speed", "traffic_speed", "steps", "percent"),
    [
        # 400 m in four stages of 100 m; 5 m/s among cars at 10 m/s; 199 m are one stage and a half
        (5.0, 10.0, 398, [50.0]),
        (5.0, 10.0, 800, [50.0, 50.0, 50.0, 50.0]),  # the last one is closed at the end, at 400 m
        (5.0, 10.0, 740, [50.0, 50.0, 50.0]),  # 370 m are less than 95 %
        (12.0, 10.0, 333, [120.0] * 4),
        (5.0, 0.0, 800, [100.0] * 4),  # traffic that stands all the time asks for nothing
    ],
)
def test_the_speed_of_each_stage_in_percent_of_the_traffics(
    begin, ego_speed, traffic_speed, steps, percent
):
    measured = follow_with(begin, ego_speed, traffic_speed, steps)
    num = int(measured.num_stages)
    np.testing.assert_allclose(measured.percent[:num], percent, rtol=1e-5)
    np.testing.assert_array_equal(measured.percent[num:], 100.0)


def test_stages_differ(begin):
    """Half as fast as the traffic on the first stage, twice as fast from then on."""
    sim = begin.state.pipeline_state
    traffic = population.nobody(1).replace(
        xy=sim.ego.xy[None], kind=jnp.ones(1, jnp.int32), speed=jnp.float32([8.0])
    )

    def step(measured, now):
        speed, route_s = now
        ego = sim.ego.replace(speed=speed)
        return min_speed.update(measured, ego, traffic, route_s, jnp.float32(400.0)), None

    speed = np.float32([4.0] * 260 + [16.0] * 200)  # 104 m, then 320 m
    route_s = np.cumsum(speed * np.float32(DT), dtype=np.float32)
    now = (jnp.asarray(speed[route_s <= 390]), jnp.asarray(route_s[route_s <= 390]))
    measured, _ = jax.lax.scan(step, min_speed.start(), now)
    # Stage 1 ends with the step that passes 100 m, 250 steps at 4 m/s; then 10 steps more at 4.
    assert int(measured.num_stages) == 3
    assert float(measured.percent[0]) == pytest.approx(50.0)
    second = float(measured.percent[1])
    # 10 steps at 4 m/s (4 m) and 61 at 16 m/s (97.6 m) pass 100 m: (40 + 976) / 71 / 8
    assert second == pytest.approx(100 * 1016 / 71 / 8, rel=0.02)
    assert float(measured.percent[2]) == pytest.approx(200.0)


def test_on_the_road_the_speed_is_measured_against_ordinary_traffic(env, begin):
    """A standing ego, a car of traffic that drives away from it and something that stands."""
    agents = parked(altered(begin, agents=parked(begin, 40.0, row=0)), 30.0)
    routes = env.bank.routes
    agents = agents.replace(
        lanes=agents.lanes.at[0].set(routes.lane[0, 0]),
        lane_s=agents.lane_s.at[0].set(routes.lane_s[0, 0] + 40.0),
        desired_speed_frac=jnp.ones(agents.kind.shape[0], jnp.float32),
    )
    after = drive_on(env, altered(begin, agents=agents), STAND, 20)
    speeds = [float(each.state.pipeline_state.agents.speed[0]) for each in after]
    assert speeds[-1] > 1.0
    assert float(after[-1].min_speed.traffic_sum) == pytest.approx(sum(speeds), rel=1e-4)
    assert float(after[-1].min_speed.ego_sum) == 0.0


def stood(begin, seconds):
    return begin.replace(stopped_s=jnp.float32(seconds))


def test_blocked_is_the_leaderboards_and_not_the_trainings(env, begin):
    """Training's blocked_s is 5 s here."""
    after = drive_on(env, begin, STAND, 60)
    assert float(after[-1].stopped_s) == pytest.approx(6.0, abs=1e-3)
    assert float(after[-1].state.done) == 0.0
    after = drive_on(env, stood(begin, BLOCKED_S - 0.2), STAND, 5)
    done = [float(drive.state.done) for drive in after]
    assert done == [0.0, 0.0, 1.0, 1.0, 1.0]  # 179.9, 180.0, 180.1 s
    assert number_of(after[-1], "blocked") == 1


def test_the_time_limit_grows_with_the_way(env, begin):
    after = drive_on(env, begin, GO, 100)[-1]
    sim = after.state.pipeline_state
    passed = float(env.bank.routes.s[0, sim.route_idx])
    assert passed > 50.0
    # Every metre adds 1 / (10 % of 10 m/s) = 1 s.
    assert float(after.time_limit_s) == pytest.approx(TIME_S + passed, rel=1e-5)


def test_the_route_ends_with_its_time(env, begin):
    late = altered(begin, step_count=jnp.int32(TIME_S / DT - 1))
    after = drive_on(env, late, STAND, 2)
    assert [float(drive.state.done) for drive in after] == [0.0, 1.0]  # at 300.1 s
    assert number_of(after[-1], "timeout") == 1
    # A route that has begun has more time.
    on_the_way = moving(late).replace(time_limit_s=jnp.float32(350.0))
    assert float(drive_on(env, on_the_way, STAND, 2)[-1].state.done) == 0.0


def test_a_finished_route_is_complete(env, begin):
    """Past 99 % of 300 m, 297 m, and within 10 m of the goal."""
    after = drive_on(env, moving(begin, x=290.0), GO, 12)
    done = np.array([float(drive.state.done) for drive in after])
    completion = np.array([float(drive.completion) for drive in after])
    first = int(np.argmax(done))
    assert 97.0 < completion[first - 1] <= 99.0
    assert completion[first] == 100.0
    assert not any(number_of(after[-1], name) for name in EVENTS)
    # It stays as it ended.
    for drive in after[first:]:
        assert int(drive.state.pipeline_state.step_count) == first + 1


def test_past_99_percent_but_beside_the_goal_is_not_finished(env, begin):
    sim = begin.state.pipeline_state
    ego = {"xy": sim.ego.xy + jnp.float32([299.0, 12.0]), "speed": jnp.float32(1.0)}
    drive = altered(begin, ego, route_idx=jnp.int32(299))
    after = drive_on(env, drive, ROLL, 1)[-1]
    assert number_of(after, "off_road") == 1
    assert float(after.completion) < 100.0


def test_leaving_the_road_or_the_route_ends_it(env, begin):
    for aside, name in ((15.0, "off_road"), (31.0, "route_deviation")):
        sim = begin.state.pipeline_state
        ego = {"xy": sim.ego.xy + jnp.float32([50.0, aside]), "speed": jnp.float32(5.0)}
        after = drive_on(env, altered(begin, ego, route_idx=jnp.int32(50)), ROLL, 1)[-1]
        assert float(after.state.done) == 1.0
        assert number_of(after, name) == 1


def test_metres_of_the_route_outside_lanes(env, begin):
    """2.4 m beside the lane's middle: more than half of 3.5 m and 0.5 m."""
    sim = begin.state.pipeline_state
    ego = {"xy": sim.ego.xy + jnp.float32([50.0, 2.4]), "speed": jnp.float32(10.0)}
    drive = altered(begin, ego, route_idx=jnp.int32(50))
    after = drive_on(env, drive, ROLL, 10)[-1]
    passed = float(env.bank.routes.s[0, after.state.pipeline_state.route_idx]) - 50.0
    assert passed > 8.0
    assert float(after.outside_m) == pytest.approx(passed, abs=1e-3)
    inside = drive_on(env, moving(begin), ROLL, 10)[-1]
    assert float(inside.outside_m) == 0.0
    assert float(inside.driven_m) == pytest.approx(10.0, rel=0.05)


def test_what_scenarios_hold_against_the_ego_is_counted(env, begin):
    after = drive_on(env, moving(begin), ROLL, 1)[-1]
    slots = after.state.pipeline_state.scenarios
    for field, name in (
        ("has_timed_out", "scenario_timeout"),
        ("has_failed_to_yield", "failed_to_yield"),
    ):
        told = altered(after, scenarios=slots.replace(**{field: jnp.bool_(True)}))
        happened = leaderboard.infractions(told, jnp.int32(-1), DT)
        assert {each for each, did in happened.items() if did} == {name}


def test_the_log_keeps_order_and_counts_on_when_it_is_full():
    happened = jnp.zeros((40, 3), bool).at[:, 1].set(True).at[0, 2].set(True).at[5].set(False)

    def step(log, now):
        number, which = now
        xyz = jnp.stack([number, 0.0, 0.0]).astype(jnp.float32)
        return event_log.append(log, which, xyz, number, jnp.full(3, -1, jnp.int32)), None

    for repeat in (1, 3):
        now = (jnp.arange(40 * repeat), jnp.tile(happened, (repeat, 1)))
        log, _ = jax.lax.scan(step, event_log.empty(), now)
        expected = [
            (kind, number)
            for number in range(40 * repeat)
            for kind in (1, 2)
            if happened[number % 40, kind]
        ]
        assert int(log.num) == len(expected)
        kept = expected[: event_log.CAPACITY]
        written = list(zip(log.kind.tolist(), log.step.tolist(), strict=True))
        assert written[: len(kept)] == kept
        assert all(kind == -1 for kind, _ in written[len(kept) :])
        np.testing.assert_array_equal(log.xyz[: len(kept), 0], [number for _, number in kept])


def test_a_step_keeps_shapes_and_types(env, begin):
    action = jnp.float32(GO)
    after = jax.eval_shape(leaderboard.advance, env, begin, action)
    kinds = jax.tree.map(lambda x: (x.shape, x.dtype), (begin, after))
    assert kinds[0] == kinds[1]
    assert not any(x.weak_type for x in jax.tree.leaves(after))
