"""The evaluation command against a plain loop of one environment, one step at a time."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from helpers import once
from PIL import Image

from carljax import (
    build,
    checkpoint,
    courses,
    evaluate,
    leaderboard,
    presets,
    route_bank,
    routes,
    run_dir,
)
from carljax.config import RunConfig
from carljax.drive import NetworkPolicy
from carljax.ppo.config import NetworkConfig
from carljax.ppo.networks import ActorCritic
from carljax.ppo.types import TrainState
from carljax.reward.config import RewardConfig
from carljax.sim import towns
from carljax.sim.env import EnvConfig
from carljax.sim.raster_canvas import RasterConfig

NUM_ROUTES = 3
FEW = ("--num-routes", str(NUM_ROUTES))
CONFIG = dataclasses.replace(
    presets.CPU,
    env=EnvConfig(
        num_agents=8,
        num_pedestrians=4,
        num_scenario_slots=1,
        route_length=300.0,
        raster=RasterConfig(height=16, width=16, pixels_per_metre=1.0, ego_from_bottom_px=4),
    ),
    reward=RewardConfig(blocked_s=5.0),
    network=NetworkConfig(encoder="patch", hidden_size=16, joint_size=16),
    run=RunConfig(maps=(Path(towns.path("village")),)),
)


@pytest.fixture(scope="module", autouse=True)
def routes_drawn_once():
    """One configuration in this file, so the same seed means the same routes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "environment", once(build.environment))
        yield


@pytest.fixture(scope="module")
def course(routes_drawn_once):
    """The held-out routes that the command draws."""
    loaded = build.load_towns(CONFIG.run.maps)
    return courses.held_out(CONFIG, loaded, NUM_ROUTES)


@pytest.fixture(scope="module")
def env(course):
    """What is driven in."""
    return course.env


@pytest.fixture(scope="module")
def policy(env):
    """A policy that drives off: a new network with the throttle's Beta shifted upwards."""
    network = ActorCritic(CONFIG.network)
    obs = jax.eval_shape(lambda e: e.reset(jax.random.key(0)).obs, env)
    obs = jax.tree.map(lambda x: jnp.zeros((1, *x.shape), x.dtype), obs)
    made = network.init(jax.random.key(0), obs)
    made["params"]["alpha"]["bias"] = jnp.array([0.0, 4.0])
    return NetworkPolicy(made, network)


@pytest.fixture(scope="module")
def result(course, policy):
    """All routes at once."""
    return evaluate.evaluate(course, policy)


@pytest.fixture(scope="module")
def one_by_one(env, policy):
    """The same routes in a Python loop that knows the rules of the leaderboard by itself."""

    @jax.jit
    def first(episode):
        key = jax.random.fold_in(jax.random.key(evaluate.TRAFFIC_SEED), episode)
        return env.observe(env.start_episode(episode, key))

    @jax.jit
    def step(state, brakes):
        obs = jax.tree.map(lambda x: x[None], state.obs)
        alpha, beta, _ = policy.network.apply(policy.params, obs)
        action = 2 * (alpha / (alpha + beta))[0] - 1
        return env.step(state, jnp.where(brakes, jnp.float32([0, -1]), action))

    return [drive_by_the_rules(first(jnp.int32(i)), step, env) for i in range(NUM_ROUTES)]


class Wrecks:
    """Who has been struck, in NumPy: they stand for 3 s and are then taken away."""

    def __init__(self, vehicle):
        self.vehicle, self.struck_at, self.charged_at, self.held = vehicle, {}, None, 0

    def keep(self, before, agents, number):
        """Holds the struck where they were; changes agents in place."""
        self.held -= self.held > 0
        for row, since in list(self.struck_at.items()):
            if agents.kind[row] and not before.kind[row]:
                del self.struck_at[row]  # somebody else
            elif number - since < 30:
                for name in agents.__dataclass_fields__:
                    getattr(agents, name)[row] = getattr(before, name)[row]
            else:
                agents.kind[row] = 0

    def meet(self, sim, number, was_moving):
        """Halts whom the ego meets; whether it does, and what is charged."""
        struck = np.flatnonzero(boxes_that_meet(sim, self.vehicle))
        fresh = [row for row in struck if row not in self.struck_at]
        if self.charged_at is not None and np.hypot(*(sim.ego.xy - self.charged_at)) > 5.0:
            self.charged_at = None
        if not fresh:
            return False, []
        self.struck_at |= dict.fromkeys(fresh, number)
        self.held = 30
        for name in ("speed", "yaw_rate", "accel"):
            getattr(sim.agents, name)[fresh] = 0.0
        if self.charged_at is not None or not was_moving:
            return True, []
        self.charged_at = np.array(sim.ego.xy)
        kinds = {int(sim.agents.kind[row]) for row in fresh}
        order = {2: "pedestrian", 1: "vehicle", 3: "static"}
        return True, [next(f"{name}_collision" for kind, name in order.items() if kind in kinds)]


def drive_by_the_rules(state, step, env):
    """Returns the last state, metres driven and outside lanes, infractions, clean completion."""
    metres, outside, happened, clean = 0.0, 0.0, [], None
    wrecks, stood, time_limit = Wrecks(env.vehicle), 0, 300.0
    episode = int(state.pipeline_state.episode_idx)
    route_s = np.asarray(env.bank.routes.s[episode])
    limits = np.asarray(env.bank.routes.speed_limit[episode])
    for number in range(1, 10**6):
        before = state.pipeline_state
        state = step(state, wrecks.held > 0)
        metrics = state.metrics
        assert not metrics["reward/finished"], "this policy is not that good"
        sim = state.pipeline_state.replace(
            agents=jax.tree.map(np.array, state.pipeline_state.agents)
        )
        wrecks.keep(before.agents, sim.agents, number)
        is_hit, new = wrecks.meet(sim, number, float(before.ego.speed) >= 0.1)
        if is_hit:
            still = jnp.float32(0)
            sim = sim.replace(ego=sim.ego.replace(speed=still, yaw_rate=still))
        metres += 0.05 * (float(before.ego.speed) + float(sim.ego.speed))
        passed = route_s[int(sim.route_idx)] - route_s[int(before.route_idx)]
        outside += passed if metrics["reward/outside_lanes"] == 0 else 0.0
        time_limit += passed / (0.1 * limits[int(sim.route_idx)])
        stood = stood + 1 if float(sim.ego.speed) < 0.1 else 0
        completion = 100.0 * route_s[int(sim.route_idx)] / route_s.max()
        told = (*leaderboard.GOES_ON, "off_road", "route_deviation")
        new += [name for name in told if metrics[f"reward/{name}"] > 0]
        ends = {"blocked": stood > 1800, "timeout": 0.1 * number > time_limit + 0.05}
        new += [name for name, is_so in ends.items() if is_so]
        clean = completion if new and clean is None else clean
        happened += new
        sim = sim.replace(agents=jax.tree.map(jnp.asarray, sim.agents))
        state = state.replace(pipeline_state=sim, done=jnp.float32(0))
        if set(leaderboard.ENDS) & set(new):
            return state, metres, outside, happened, clean


def boxes_that_meet(sim, vehicle):
    """(N,) bool, by polygons in float64."""

    def box(xy, yaw, length, width):
        corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * [length / 2, width / 2]
        c, s = np.cos(yaw), np.sin(yaw)
        return shapely.Polygon(np.asarray(xy) + corners @ np.array([[c, s], [-s, c]]))

    ego = box(sim.ego.xy, sim.ego.yaw, vehicle.length, vehicle.width)
    others = sim.agents
    rows = zip(others.xy, others.yaw, others.length, others.width, others.kind, strict=True)
    return np.array([kind > 0 and box(*pose).intersects(ego) for *pose, kind in rows])


def test_driving_all_at_once_is_driving_one_by_one(result, one_by_one):
    for route, drive in zip(result.routes, one_by_one, strict=True):
        state, metres, outside, happened, clean = drive
        assert route.seconds == pytest.approx(0.1 * int(state.pipeline_state.step_count))
        assert route.driven_km == pytest.approx(metres / 1000, rel=1e-3)
        assert route.outside_km == pytest.approx(outside / 1000, abs=1e-5)
        progress = float(state.pipeline_state.reward_state.route_s) / (1000 * route.length_km)
        assert route.completion == pytest.approx(100 * progress, abs=0.5)
        assert route.clean_completion == pytest.approx(clean, abs=1e-3)
        assert sorted(name for name in route.infractions if name != "min_speed") == sorted(happened)


def test_the_policy_here_drives(result):
    assert min(route.driven_km for route in result.routes) > 0.005


def test_the_same_policy_gets_the_same_score(course, policy, result):
    assert evaluate.evaluate(course, policy) == result


def test_a_repetition_is_another_drive_of_the_same_routes(course, policy, result):
    twice = evaluate.evaluate(course, policy, repetitions=2)
    assert twice.routes[:NUM_ROUTES] == result.routes
    again = twice.routes[NUM_ROUTES:]
    assert [route.repetition for route in again] == [1] * NUM_ROUTES
    assert [route.route_id for route in again] == [route.route_id for route in result.routes]
    assert [route.length_km for route in again] == [route.length_km for route in result.routes]


def test_what_a_policy_was_trained_to_mind_does_not_change_the_score(course, policy, result):
    """Another reward, whose time limit is over at once and which ends when blocked for 0 s."""
    strict = RewardConfig(name="roach", blocked_s=0.0, time_limit_s=0.0, off_road_frac=0.1)
    other = dataclasses.replace(course, env=course.env.replace(reward_config=strict))
    assert evaluate.evaluate(other, policy) == result


def test_held_out_routes_are_fixed_and_not_those_of_training(env):
    loaded = build.load_towns(CONFIG.run.maps)
    again = courses.held_out(CONFIG, loaded, NUM_ROUTES + 1).env
    training = build.environment(CONFIG, loaded, NUM_ROUTES, seed=0)
    np.testing.assert_array_equal(again.bank.routes.xy[:NUM_ROUTES], env.bank.routes.xy)
    for held_out in np.asarray(env.bank.routes.xy):
        for trained in np.asarray(training.bank.routes.xy):
            assert not np.array_equal(held_out, trained)


def test_places_of_events_are_the_maps_own(course, env, policy, result):
    """Each route here ends off its road, near the end of what was completed of it."""
    offset = course.towns[0].offset
    for route in result.routes:
        last = route.events[-1]
        xy = np.asarray(env.bank.routes.xy[route.index]) + offset
        done = np.asarray(env.bank.routes.s[route.index]) / (10.0 * route.length_km)
        at = int(np.argmin(np.abs(done - route.completion)))
        assert np.hypot(*(xy[at] - last.xyz[:2])) < 30.0
        assert last.seconds == pytest.approx(route.seconds)


@pytest.fixture(scope="module")
def run(tmp_path_factory, policy):
    """A run directory with two checkpoints; the second one's policy is a different one."""
    path = tmp_path_factory.mktemp("run")
    run_dir.create(path, CONFIG)
    rest = {"opt_state": jnp.zeros(1), "env_state": jnp.zeros(1), "key": jnp.zeros(1)}
    for update, scale in ((1, 1.0), (2, 0.5)):
        values = jax.tree.map(lambda x, s=scale: s * x, policy.params)
        state = TrainState(params=values, update=jnp.int32(update), **rest)
        checkpoint.save(path, state, update, score=-update, keep=2)
    return path


def command(*arguments):
    return evaluate.main([*arguments, *FEW])


def test_the_command_writes_scores_and_picture(run, result, tmp_path, capsys):
    out, gif = tmp_path / "scores.json", tmp_path / "new" / "drive.gif"
    chosen = str(run / "checkpoints" / "1")
    assert command("--checkpoint", chosen, "--json", str(out), "--gif", str(gif)) == 0
    values = json.loads(out.read_text())
    assert values["carljax"]["update"] == 1
    assert values["carljax"]["driving_score_mean"] == pytest.approx(result.driving_score[0])
    scores = values["_checkpoint"]["global_record"]["scores_mean"]
    assert scores["score_composed"] == pytest.approx(result.driving_score[0], abs=1e-5)
    assert len(values["_checkpoint"]["records"]) == NUM_ROUTES
    assert "held-out routes" in capsys.readouterr().out
    steps = round(result.routes[0].seconds / 0.1)
    with Image.open(gif) as picture:
        assert picture.n_frames == -(-steps // 3)  # every third step and the last
        colours = np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)
    assert len(colours) > 10


def test_best_newest_and_untrained_are_different_policies(run, tmp_path):
    updates = {}
    for name, extra in {"newest": [], "best": ["--best"], "new": ["--untrained"]}.items():
        out = tmp_path / f"{name}.json"
        assert command("--checkpoint", str(run), "--json", str(out), *extra) == 0
        updates[name] = json.loads(out.read_text())["carljax"]["update"]
    assert updates == {"newest": 2, "best": 1, "new": None}


def test_the_action_is_an_option_and_samples_are_the_same_each_time(run, tmp_path):
    """The run's own choice is the default; a sample is another drive than the mean, twice alike."""
    scores = {}
    chosen = str(run / "checkpoints" / "1")
    for name, extra in {"run": [], "once": ["sample"], "again": ["sample"]}.items():
        out = tmp_path / f"{name}.json"
        flags = ["--action", *extra] if extra else []
        assert command("--checkpoint", chosen, "--json", str(out), *flags) == 0
        values = json.loads(out.read_text())["carljax"]
        scores[name] = values["action"], values["routes"]
    assert scores["run"][0] == CONFIG.run.eval_action == "mean"
    assert scores["once"][0] == "sample"
    assert scores["once"] == scores["again"]
    assert scores["once"][1] != scores["run"][1]


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    """A bank of routes in the village."""
    path = tmp_path_factory.mktemp("bank") / "village.npz"
    arguments = ["--map", "village", "--num", "2", "--length", "300", "--seed", "3"]
    assert routes.main(["make", *arguments, str(path)]) == 0
    return path


def test_a_bank_is_driven_in_the_world_as_it_is_by_default(bank):
    course = courses.of_bank(CONFIG, bank, None)
    assert course.route_ids == ("0", "1")
    assert [town.network.name for town in course.towns] == ["village"]
    world = EnvConfig()
    assert course.env.config.num_agents == world.num_agents > CONFIG.env.num_agents
    assert course.env.bank.agents.kind.shape == (2, world.population.num_agents)
    assert course.env.config.raster == CONFIG.env.raster
    assert course.num_scenarios.sum() == route_bank.summary(bank)["scenarios"] > 0
    same = courses.of_bank(CONFIG, bank, towns.path("village"))
    np.testing.assert_array_equal(same.env.bank.routes.xy, course.env.bank.routes.xy)


def test_a_route_file_is_a_course_under_its_own_names(course, tmp_path):
    """Route 1 of the village as a file of leaderboard 2.0: every 20 m, y to the south."""
    routes, town = course.env.bank.routes, course.towns[0]
    xy = np.asarray(routes.xy[1], float)[: int(routes.num_points[1])] + town.offset
    points = "".join(f'<position x="{x:.3f}" y="{-y:.3f}" z="0"/>' for x, y in xy[::20])
    file = tmp_path / "routes.xml"
    file.write_text(
        f'<routes><route id="17" town="village"><waypoints>{points}</waypoints>'
        "<scenarios/></route></routes>"
    )
    read = courses.of_route_file(CONFIG, file, towns.path("village").parent, None, None)
    assert (read.title, read.route_ids) == ("routes.xml", ("17",))
    assert read.num_scenarios.tolist() == [0]
    driven = np.asarray(read.env.bank.routes.xy[0]) + read.towns[0].offset
    away = np.hypot(*(driven[:, None] - xy[:260]).transpose(2, 0, 1)).min(axis=0)
    assert away.max() < 1.0


@pytest.mark.slow
def test_a_planner_drives_without_a_checkpoint(bank, tmp_path, capsys):
    out = tmp_path / "planner.json"
    assert evaluate.main(["--planner", "idm", "--routes", str(bank), "--json", str(out)]) == 0
    values = json.loads(out.read_text())["carljax"]
    assert (values["policy"], values["course"]) == ("idm", "village.npz")
    assert [route["route_id"] for route in values["routes"]] == ["0", "1"]
    assert values["route_completion_mean"] > 50.0
    assert values["num_scenarios"] == route_bank.summary(bank)["scenarios"]
    assert "village.npz, idm" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--checkpoint", "nowhere"], "nowhere: holds no run"),
        (
            ["--checkpoint", "RUN/checkpoints/7", *FEW],
            "no checkpoint of update 7; there are [1, 2]",
        ),
        (["--checkpoint", "RUN", "--gif", "x.gif", "--gif-route", "9", *FEW], "--gif-route 9"),
        (["--checkpoint", "RUN", "--map", "missing.xodr"], "missing.xodr"),
        (["--checkpoint", "RUN", "--num-routes", "0"], "--num-routes 0"),
        (["--checkpoint", "RUN", "--repetitions", "0"], "--repetitions 0"),
        (["--checkpoint", "RUN", "--planner", "idm"], "one of --checkpoint DIR and --planner"),
        ([], "one of --checkpoint DIR and --planner"),
        (["--planner", "magic"], "--planner magic: there is no such planner; there are: idm"),
        (["--planner", "idm", "--best"], "go with --checkpoint"),
        (["--planner", "idm", "--action", "mode"], "--action goes with --checkpoint"),
        (["--planner", "idm", "--routes", "routes.txt"], "routes.txt: is neither"),
        (["--planner", "idm", "--routes", "a.xml"], "--maps DIR go together"),
        (["--planner", "idm", "--maps", "."], "--maps DIR go together"),
        (["--planner", "idm", "--routes", "a.xml", "--maps", "."], "a.xml: "),
        (["--planner", "idm", "--routes", "a.npz"], "a.npz: is not there"),
        (["--planner", "idm", "--routes", "a.npz", *FEW], "one of --routes and --num-routes"),
        (
            ["--planner", "idm", "--routes", "a.npz", "--triggers", "t.json"],
            "go with --routes FILE",
        ),
        (["--planner", "idm", "--routes", "BANK", "--map", "GRID"], "was made for the map village"),
    ],
)
def test_a_mistake_ends_with_one_line_and_status_2(run, bank, arguments, message, capsys):
    places = {"RUN": str(run), "BANK": str(bank), "GRID": str(towns.path("grid"))}
    for name, place in places.items():
        arguments = [text.replace(name, place) for text in arguments]
    capsys.readouterr()
    assert evaluate.main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1
    assert message in error
