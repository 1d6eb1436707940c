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

from carljax import build, checkpoint, evaluate, leaderboard, presets, run_dir
from carljax.config import RunConfig
from carljax.ppo.config import NetworkConfig
from carljax.ppo.networks import ActorCritic
from carljax.ppo.types import TrainState
from carljax.reward import reward
from carljax.reward.config import RewardConfig
from carljax.sim import towns
from carljax.sim.env import EnvConfig
from carljax.sim.raster_canvas import RasterConfig
from carljax.sim.types import KIND_VEHICLE

NUM_ROUTES = 3
CONFIG = dataclasses.replace(
    presets.CPU,
    env=EnvConfig(
        num_agents=8,
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
def env(routes_drawn_once):
    """The held-out routes that the command draws."""
    loaded = build.load_towns(CONFIG.run.maps)
    return evaluate.held_out(CONFIG, loaded, NUM_ROUTES)


@pytest.fixture(scope="module")
def params(env):
    """A policy that drives off: a new network with the throttle's Beta shifted upwards."""
    network = ActorCritic(CONFIG.network)
    obs = jax.eval_shape(lambda e: e.reset(jax.random.key(0)).obs, env)
    obs = jax.tree.map(lambda x: jnp.zeros((1, *x.shape), x.dtype), obs)
    made = network.init(jax.random.key(0), obs)
    made["params"]["alpha"]["bias"] = jnp.array([0.0, 4.0])
    return made


@pytest.fixture(scope="module")
def result(env, params):
    """All routes at once."""
    return evaluate.evaluate(env, ActorCritic(CONFIG.network), params, ["village"])


@pytest.fixture(scope="module")
def one_by_one(env, params):
    """The same routes in a Python loop that knows the rules of the leaderboard by itself."""
    network = ActorCritic(CONFIG.network)

    @jax.jit
    def first(episode):
        key = jax.random.fold_in(jax.random.key(evaluate.TRAFFIC_SEED), episode)
        return env.observe(env.start_episode(episode, key))

    @jax.jit
    def step(state):
        alpha, beta, _ = network.apply(params, jax.tree.map(lambda x: x[None], state.obs))
        return env.step(state, 2 * (alpha / (alpha + beta))[0] - 1)

    return [drive_by_the_rules(first(jnp.int32(i)), step, env.vehicle) for i in range(NUM_ROUTES)]


def drive_by_the_rules(state, step, vehicle):
    """Returns the last state, metres driven and outside lanes, infractions, clean completion."""
    metres, outside, happened, clean = 0.0, 0.0, [], None
    while True:
        was_moving = float(state.pipeline_state.ego.speed) >= 0.1
        state = step(state)
        sim, metrics = state.pipeline_state, state.metrics
        moved = float(sim.ego.speed) * 0.1
        metres += moved
        outside += moved if metrics["reward/outside_lanes"] == 0 else 0.0
        completion = float(metrics["episode/route_completion"])
        causes = [name for name in reward.CAUSES if metrics[f"reward/{name}"] > 0]
        new = [name for name in causes if name != "collision"]
        if "collision" in causes:
            struck = boxes_that_meet(sim, vehicle)
            assert struck.any()
            new += ["vehicle_collision"] * was_moving
            kind = jnp.where(struck, 0, sim.agents.kind)
            still = sim.ego.replace(speed=jnp.float32(0), yaw_rate=jnp.float32(0))
            sim = sim.replace(agents=sim.agents.replace(kind=kind), ego=still)
        if new and clean is None:
            clean = completion
        happened += new
        if {"off_road", "route_deviation", "blocked"} & set(new) or metrics["reward/finished"]:
            return state, metres, outside, happened, completion if clean is None else clean
        state = state.replace(pipeline_state=sim, done=jnp.float32(0))


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
        assert route.outside_frac == pytest.approx(outside / metres, abs=2e-3)
        progress = float(state.pipeline_state.reward_state.route_s) / (1000 * route.length_km)
        assert route.completion == pytest.approx(100 * progress, abs=0.5)
        assert route.clean_completion == pytest.approx(clean, abs=1e-3)
        assert sorted(route.infractions) == sorted(happened)


def test_the_policy_here_drives(result):
    assert min(route.driven_km for route in result.routes) > 0.005


def test_the_same_policy_gets_the_same_score(env, params, result):
    again = evaluate.evaluate(env, ActorCritic(CONFIG.network), params, ["village"])
    assert again == result


def test_held_out_routes_are_fixed_and_not_those_of_training(env):
    loaded = build.load_towns(CONFIG.run.maps)
    again = evaluate.held_out(CONFIG, loaded, NUM_ROUTES + 1)
    training = build.environment(CONFIG, loaded, NUM_ROUTES, seed=0)
    np.testing.assert_array_equal(again.bank.routes.xy[:NUM_ROUTES], env.bank.routes.xy)
    for held_out in np.asarray(env.bank.routes.xy):
        for trained in np.asarray(training.bank.routes.xy):
            assert not np.array_equal(held_out, trained)


def test_a_collision_names_what_was_touched(env):
    state = jax.jit(lambda: env.reset(jax.random.key(1)))()
    sim = state.pipeline_state
    agents = sim.agents.replace(
        xy=sim.agents.xy.at[0].set(sim.ego.xy),
        z=sim.agents.z.at[0].set(sim.ego.z),
        kind=sim.agents.kind.at[0].set(KIND_VEHICLE),
    )
    touching = state.replace(pipeline_state=sim.replace(agents=agents))
    struck = leaderboard.struck_agents(env, touching)
    moving = state.replace(pipeline_state=sim.replace(ego=sim.ego.replace(speed=jnp.float32(5))))
    happened = leaderboard.infractions(moving, touching, struck)
    assert {name for name, hit in happened.items() if hit} == {"vehicle_collision"}
    # A car at rest that is struck is not to blame.
    assert not any(leaderboard.infractions(state, touching, struck).values())


def test_a_collision_halts_the_ego_and_takes_the_struck_car_away(env):
    state = jax.jit(lambda: env.reset(jax.random.key(1)))()
    sim = state.pipeline_state
    moving = sim.replace(ego=sim.ego.replace(speed=jnp.float32(5)))
    struck = jnp.arange(sim.agents.kind.shape[0]) == 0
    after = leaderboard.go_on(state.replace(pipeline_state=moving, done=jnp.float32(1)), struck)
    assert float(after.done) == 0 and float(after.pipeline_state.ego.speed) == 0
    assert not after.pipeline_state.agents.valid[0]
    np.testing.assert_array_equal(after.pipeline_state.agents.kind[1:], sim.agents.kind[1:])


@pytest.fixture(scope="module")
def run(tmp_path_factory, params):
    """A run directory with two checkpoints; the second one's policy is a different one."""
    path = tmp_path_factory.mktemp("run")
    run_dir.create(path, CONFIG)
    rest = {"opt_state": jnp.zeros(1), "env_state": jnp.zeros(1), "key": jnp.zeros(1)}
    for update, scale in ((1, 1.0), (2, 0.5)):
        policy = jax.tree.map(lambda x, s=scale: s * x, params)
        state = TrainState(params=policy, update=jnp.int32(update), **rest)
        checkpoint.save(path, state, update, score=-update, keep=2)
    return path


def command(*arguments):
    return evaluate.main([*arguments, "--num-routes", str(NUM_ROUTES)])


def test_the_command_writes_scores_and_picture(run, result, tmp_path, capsys):
    out, gif = tmp_path / "scores.json", tmp_path / "new" / "drive.gif"
    chosen = str(run / "checkpoints" / "1")
    assert command("--checkpoint", chosen, "--json", str(out), "--gif", str(gif)) == 0
    values = json.loads(out.read_text())
    assert values["update"] == 1
    assert values["driving_score_mean"] == pytest.approx(result.driving_score[0])
    assert "Driving Score" in capsys.readouterr().out
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
        updates[name] = json.loads(out.read_text())["update"]
    assert updates == {"newest": 2, "best": 1, "new": None}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--checkpoint", "nowhere"], "nowhere: holds no run"),
        (["--checkpoint", "RUN/checkpoints/7"], "no checkpoint of update 7; there are [1, 2]"),
        (["--checkpoint", "RUN", "--gif-route", "9"], "--gif-route 9"),
        (["--checkpoint", "RUN", "--map", "missing.xodr"], "missing.xodr"),
    ],
)
def test_a_mistake_ends_with_one_line_and_status_2(run, arguments, message, capsys):
    assert command(*[text.replace("RUN", str(run)) for text in arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1
    assert message in error
