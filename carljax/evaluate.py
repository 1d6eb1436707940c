"""`python -m carljax.evaluate`: the Driving Score of a policy or of a rule-based planner.

All routes are driven at once by one compiled loop that ends with the last of them. Routes and the
key of the traffic, and of a policy that samples, are fixed, so the same driver gets the same score.
A repetition has another key of its own.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.console import Console

from carljax import (
    atomic,
    build,
    checkpoint,
    compile_cache,
    courses,
    drive,
    machine,
    result_file,
    run_dir,
)
from carljax import score_table as table
from carljax.checkpoint import CheckpointError
from carljax.compile_cache import CacheFolder
from carljax.config import Action, ConfigError, TrainConfig
from carljax.courses import Course
from carljax.drive import NetworkPolicy, PlannerPolicy, Policy, Run
from carljax.leaderboard import EVENTS, Drive
from carljax.planners import PLANNERS
from carljax.ppo.networks import ActorCritic
from carljax.render import gif
from carljax.route_bank import BankError
from carljax.scores import EvalResult, Event, RouteScore
from carljax.sim.env import DrivingEnv
from carljax.sim.leaderboard_files import RouteFileError
from carljax.sim.road_network import MapError
from carljax.sim.route_generator import RouteError

FILE = "evaluation.json"
TRAFFIC_SEED = 0
USER_ERRORS = (ConfigError, CheckpointError, MapError, RouteError, RouteFileError, BankError)
HELD_OUT_ROUTES = 64  # where --map alone is given


def evaluate(course: Course, policy: Policy, repetitions: int = 1) -> EvalResult:
    """Drives every route of a course and scores it.

    Args:
      course: the routes.
      policy: who drives.
      repetitions: how often, each time with other lights and other choices of the traffic.

    Returns:
      The scores.
    """
    drive_all = drive.compiled(_drive_all)
    episodes = jnp.arange(len(course.route_ids))
    routes: list[RouteScore] = []
    for repetition in range(repetitions):
        key = jax.random.key(TRAFFIC_SEED + repetition)
        ended: Drive = jax.device_get(drive_all(policy, course.env, episodes, key))
        routes += [
            _score(course, jax.tree.map(lambda x, i=i: x[i], ended), i, repetition)
            for i in range(len(course.route_ids))
        ]
    return EvalResult(tuple(routes))


def _drive_all(policy: Policy, env: DrivingEnv, episodes: jax.Array, key: jax.Array) -> Drive:
    """Drives (B,) episodes until all have ended; (B,) as they ended, without key and images."""

    def is_any_running(run: Run) -> jax.Array:
        return jnp.any(run.drive.state.done == 0)

    def again(run: Run) -> Run:
        return drive.step(policy, env, run)[0]

    run = drive.start(policy, env, episodes, key)
    ended = jax.lax.while_loop(is_any_running, again, run).drive
    sim = ended.state.pipeline_state.replace(key=None)
    return ended.replace(state=ended.state.replace(pipeline_state=sim, obs=None))


def _score(course: Course, ended: Drive, index: int, repetition: int) -> RouteScore:
    """The score of one drive, on the host."""
    town = course.towns[course.town_of_route[index]]
    num_stages = int(ended.min_speed.num_stages)
    return RouteScore(
        index=index,
        route_id=course.route_ids[index],
        repetition=repetition,
        town=town.network.name,
        length_km=float(course.env.bank.routes.length[index]) / 1000.0,
        driven_km=float(ended.driven_m) / 1000.0,
        seconds=int(ended.state.pipeline_state.step_count) * course.env.config.dt,
        completion=float(ended.completion),
        clean_completion=float(ended.clean_completion),
        outside_km=float(ended.outside_m) / 1000.0,
        num_scenarios=int(course.num_scenarios[index]),
        num_triggered=int(ended.state.pipeline_state.scenarios.num_triggered),
        speed_percent=tuple(ended.min_speed.percent[:num_stages].tolist()),
        events=_events(ended, town.offset, course.env.config.dt),
    )


def _events(ended: Drive, offset: np.ndarray, dt: float) -> tuple[Event, ...]:
    """The log in words; what it had no room for follows without a place."""
    log = ended.log
    filled = min(int(log.num), len(log.kind))
    seconds = int(ended.state.pipeline_state.step_count) * dt
    events = [
        Event(
            name=EVENTS[kind],
            xyz=(float(xyz[0] + offset[0]), float(xyz[1] + offset[1]), float(xyz[2])),
            seconds=int(step) * dt,
            agent=int(agent) if agent >= 0 else None,
        )
        for kind, xyz, step, agent in zip(
            log.kind[:filled], log.xyz, log.step, log.agent, strict=False
        )
    ]
    names = [event.name for event in events]
    for name in EVENTS:
        missing = int(ended.counts[name]) - names.count(name)
        events += [Event(name, None, seconds)] * missing
    return tuple(events)


def save(result: EvalResult, path: Path, system_seconds: float, **context: Any) -> None:
    """Writes the scores as JSON, whole or not at all, with what they were measured on.

    Args:
      result: the scores.
      path: the file.
      system_seconds: wall time of the evaluation.
      context: what else is to be known, in values that JSON can hold.
    """
    values = {
        **result_file.layout(result, system_seconds),
        "carljax": {**context, **result.to_json(), "machine": machine.describe()},
    }
    atomic.write_text(path, json.dumps(values, indent=2) + "\n")


@dataclasses.dataclass(frozen=True)
class Command:
    """Who drives, on what, and what to write."""

    checkpoint: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Score this policy: a run directory, or one checkpoint in it, RUN/checkpoints/UPDATE."""
    best: bool = False
    """Take the checkpoint with the best mean return instead of the newest."""
    untrained: bool = False
    """Take a newly initialised network of the same kind instead, for comparison."""
    action: Action | None = None
    """Drive with the mean of the policy (CaRL), its mode (Roach) or samples; as the run says by
    default."""
    planner: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Score this rule-based planner instead of a checkpoint."""
    routes: Annotated[Path | None, tyro.conf.arg(metavar="FILE.xml|BANK.npz")] = None
    """Drive the routes of this leaderboard file or bank instead of the carljax-36 benchmark."""
    map_folder: Annotated[Path | None, tyro.conf.arg(name="maps", metavar="DIR")] = None
    """Folder with TOWN.xodr for every town of a route file."""
    triggers: Annotated[Path | None, tyro.conf.arg(metavar="FILE.json")] = None
    """Leaderboard 1.0's scenarios, for a route file that has none."""
    yaws: Annotated[Path | None, tyro.conf.arg(metavar="FILE.xml")] = None
    """A route file's routes in version 1, which has the waypoints' yaw."""
    num_routes: int | None = None
    """Drive so many held-out routes in the policy's own world instead, over all towns."""
    maps: Annotated[
        tuple[Path, ...],
        tyro.conf.UseAppendAction,
        tyro.conf.arg(name="map", metavar="FILE.xodr"),
    ] = ()
    """OpenDRIVE file of a bank, or of held-out routes (repeatable; by default the bundled towns, or
    those of the policy's training)."""
    repetitions: int = 1
    """Drive every route so many times, each time in other traffic."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="OUT.json")] = None
    """Write all scores here, in the layout of CARLA's leaderboard."""
    gif: Annotated[Path | None, tyro.conf.arg(metavar="OUT.gif")] = None
    """Draw one route here."""
    gif_route: int = 0
    """Which of the routes to draw."""
    compile_cache: CacheFolder = None
    """Folder for compiled programs, or `off` for none; the user's cache folder by default."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command.

    Args:
      argv: arguments; those of the process by default.

    Returns:
      Exit status: 2 after a mistake in what the user gave, said in one line.
    """
    command = tyro.cli(
        Command,
        args=argv,
        prog="python -m carljax.evaluate",
        description=__doc__,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    try:
        return run(command, Console())
    except USER_ERRORS as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def run(command: Command, console: Console) -> int:
    """Does what the command says.

    Args:
      command: see `main`.
      console: where the table is printed.

    Returns:
      Exit status.
    """
    _check(command)
    config = _config(command)
    compile_cache.enable(command.compile_cache)
    course = _course(command, config)
    if command.gif is not None and not 0 <= command.gif_route < len(course.route_ids):
        raise ConfigError(
            f"--gif-route {command.gif_route}: there are {len(course.route_ids)} routes"
        )
    policy, who = _policy(command, config, course.env)
    since = time.perf_counter()
    result = evaluate(course, policy, command.repetitions)
    seconds = time.perf_counter() - since
    table.show(result, console, title=f"{course.title}, {who['policy']}")
    if command.json is not None:
        save(result, command.json, seconds, **who, course=course.title)
        console.print(f"scores: {command.json}")
    if command.gif is not None:
        gif.save(command.gif, course.env, policy, command.gif_route)
        console.print(f"drawn: {command.gif}")
    return 0


def _check(command: Command) -> None:
    """Refuses arguments that do not go together."""
    if (command.checkpoint is None) == (command.planner is None):
        raise ConfigError("give one of --checkpoint DIR and --planner NAME")
    if command.planner is not None:
        if command.planner not in PLANNERS:
            raise ConfigError(
                f"--planner {command.planner}: there is no such planner; there are:"
                f" {', '.join(PLANNERS)}"
            )
        if command.best or command.untrained:
            raise ConfigError("--best and --untrained go with --checkpoint, not with --planner")
        if command.action is not None:
            raise ConfigError("--action goes with --checkpoint, not with --planner")
    for name, value in (("num-routes", command.num_routes), ("repetitions", command.repetitions)):
        if value is not None and value < 1:
            raise ConfigError(f"--{name} {value}: is below the least allowed, 1")
    _check_routes(command)


def _check_routes(command: Command) -> None:
    """Refuses arguments about routes that are not for the kind of routes given."""
    path = command.routes
    kind = None if path is None else path.suffix
    if kind not in (None, ".xml", ".npz"):
        raise ConfigError(f"--routes {path}: is neither a route file .xml nor a bank .npz")
    if (kind == ".xml") != (command.map_folder is not None):
        raise ConfigError("--routes FILE.xml and --maps DIR go together")
    if kind != ".xml" and (command.triggers or command.yaws):
        raise ConfigError("--triggers and --yaws go with --routes FILE.xml")
    if path is not None and command.num_routes is not None:
        raise ConfigError("give one of --routes and --num-routes")
    if (kind == ".xml" and command.maps) or (kind == ".npz" and len(command.maps) > 1):
        raise ConfigError("--map is for held-out routes, or once for a bank; a file has --maps DIR")


def _course(command: Command, config: TrainConfig) -> Course:
    """What is driven."""
    path = command.routes
    if path is not None and command.map_folder is not None:
        folder, triggers, yaws = command.map_folder, command.triggers, command.yaws
        return courses.of_route_file(config, path, folder, triggers, yaws)
    if path is not None:
        return courses.of_bank(config, path, command.maps[0] if command.maps else None)
    if command.num_routes is None and not command.maps:
        return courses.carljax_36(config)
    towns = build.load_towns(command.maps or config.run.maps)
    return courses.held_out(config, towns, command.num_routes or HELD_OUT_ROUTES)


def _config(command: Command) -> TrainConfig:
    """The configuration of the policy; a planner takes the world as it is by default."""
    if command.checkpoint is None:
        return TrainConfig()
    return run_dir.load_config(run_dir.split_checkpoint(command.checkpoint)[0])


def _policy(
    command: Command, config: TrainConfig, env: DrivingEnv
) -> tuple[Policy, dict[str, Any]]:
    """Who drives, and how to write that down."""
    if command.checkpoint is None:
        name = str(command.planner)
        return PlannerPolicy(PLANNERS[name]), {"policy": name, "update": None}
    path, update = run_dir.split_checkpoint(command.checkpoint)
    network = ActorCritic(config.network)
    action: Action = command.action or config.run.eval_action

    def initialise(env: DrivingEnv) -> Any:
        first = env.reset(jax.random.key(TRAFFIC_SEED))
        batch = jax.tree.map(lambda x: x[None], first.obs)
        return network.init(jax.random.key(config.run.seed), batch)

    if command.untrained:
        params = jax.jit(initialise)(env)
        who: dict[str, Any] = {"policy": "untrained", "update": None, "action": action}
        return NetworkPolicy(params, network, action), who
    chosen = checkpoint.best(path) if command.best else update
    chosen = chosen if chosen is not None else max(checkpoint.updates(path), default=None)
    params = checkpoint.restore_params(path, jax.eval_shape(initialise, env), chosen)
    who = {"policy": str(path), "update": chosen, "action": action}
    return NetworkPolicy(params, network, action), who


if __name__ == "__main__":
    sys.exit(main())
