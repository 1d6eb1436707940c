"""`python -m carljax.evaluate --checkpoint DIR`: the Driving Score on held-out routes.

All routes are driven at once by one compiled loop that ends with the last of them. Actions are the
mean of the policy; routes and the key of the traffic are fixed, so the same checkpoint gives the
same score.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.console import Console

from carljax import atomic, build, checkpoint, drive, machine, run_dir, scores
from carljax.checkpoint import CheckpointError
from carljax.config import HELD_OUT_SEED, ConfigError, TrainConfig
from carljax.leaderboard import INFRACTIONS, Drive
from carljax.ppo.networks import ActorCritic
from carljax.render import gif
from carljax.scores import EvalResult, RouteScore
from carljax.sim.env import DrivingEnv
from carljax.sim.road_network import MapError
from carljax.sim.route_generator import RouteError
from carljax.sim.town import Town

FILE = "evaluation.json"
TRAFFIC_SEED = 0


def held_out(config: TrainConfig, towns: Sequence[Town], num_routes: int) -> DrivingEnv:
    """Makes the environment with the routes that are kept for scoring, always the same ones."""
    return build.environment(config, towns, num_routes, HELD_OUT_SEED)


def evaluate(
    env: DrivingEnv, network: ActorCritic, params: Any, town_names: Sequence[str] = ()
) -> EvalResult:
    """Drives every route of an environment's bank once and scores it.

    Args:
      env: with the routes to drive.
      network: actor and critic.
      params: its variables.
      town_names: of the bank's towns, for the result; numbers by default.

    Returns:
      The scores.
    """
    drive_all = drive.compiled(_drive_all, network)
    ended: Drive = jax.device_get(drive_all(env, jax.device_get(params)))
    metrics, counts = ended.state.metrics, ended.counts
    towns = np.asarray(env.bank.routes.town)
    names = town_names or [str(number) for number in range(towns.max() + 1)]
    lengths = np.asarray(env.bank.routes.length)
    return EvalResult(
        tuple(
            RouteScore(
                route=i,
                town=names[towns[i]],
                length_km=float(lengths[i]) / 1000.0,
                driven_km=float(metrics["episode/km"][i]),
                seconds=float(metrics["episode/length"][i]) * env.config.dt,
                completion=float(metrics["episode/route_completion"][i]),
                clean_completion=float(ended.clean_completion[i]),
                outside_frac=_fraction(
                    metrics["episode/outside_lanes_km"][i], metrics["episode/km"][i]
                ),
                infractions=tuple(
                    name for name in INFRACTIONS for _ in range(int(counts[name][i]))
                ),
            )
            for i in range(len(lengths))
        )
    )


def _drive_all(network: ActorCritic, env: DrivingEnv, params: Any) -> Drive:
    """Drives until all routes have ended; (B,) drives as they ended, without key and images."""

    def is_any_running(run: Drive) -> jax.Array:
        return jnp.any(run.state.done == 0)

    def again(run: Drive) -> Drive:
        return drive.step(network, env, params, run)[0]

    episodes = jnp.arange(env.bank.num_episodes)
    run = drive.start(env, episodes, jax.random.key(TRAFFIC_SEED))
    run = jax.lax.while_loop(is_any_running, again, run)
    return run.replace(state=run.state.replace(pipeline_state=None, obs=None))


def _fraction(part: Any, whole: Any) -> float:
    return float(part / whole) if whole > 0 else 0.0


def save(result: EvalResult, path: Path, **context: Any) -> None:
    """Writes the scores as JSON, whole or not at all, with what they were measured on."""
    values = {**context, **result.to_json(), "machine": machine.describe()}
    atomic.write_text(path, json.dumps(values, indent=2) + "\n")


@dataclasses.dataclass(frozen=True)
class Command:
    """Which policy to score, on what, and what to write."""

    checkpoint: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Run directory, or one checkpoint in it: RUN/checkpoints/UPDATE."""
    num_routes: int = 64
    """Held-out routes to drive, the same ones every time, over all towns."""
    maps: Annotated[
        tuple[Path, ...],
        tyro.conf.UseAppendAction,
        tyro.conf.arg(name="map", metavar="FILE.xodr"),
    ] = ()
    """OpenDRIVE file to be scored in; repeatable. None: where the policy was trained."""
    best: bool = False
    """Score the checkpoint with the best mean return instead of the newest."""
    untrained: bool = False
    """Score a newly initialised network of the same kind instead, for comparison."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="OUT.json")] = None
    """Write all scores here."""
    gif: Annotated[Path | None, tyro.conf.arg(metavar="OUT.gif")] = None
    """Draw one route here."""
    gif_route: int = 0
    """Which of the routes to draw."""


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
    except (ConfigError, CheckpointError, MapError, RouteError) as error:
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
    if command.num_routes < 1 or not 0 <= command.gif_route < command.num_routes:
        raise ConfigError(
            f"--gif-route {command.gif_route}: is not among --num-routes {command.num_routes}"
        )
    path, update = run_dir.split_checkpoint(command.checkpoint)
    config = run_dir.load_config(path)
    towns = build.load_towns(command.maps or config.run.maps)
    env = held_out(config, towns, command.num_routes)
    network = ActorCritic(config.network)
    params, update = _load_params(command, path, update, config, env)
    result = evaluate(env, network, params, [town.network.name for town in towns])
    scores.show(result, console)
    if command.json is not None:
        policy = "untrained" if command.untrained else str(path)
        save(result, command.json, policy=policy, update=update)
        console.print(f"scores: {command.json}")
    if command.gif is not None:
        gif.save(command.gif, env, network, params, command.gif_route)
        console.print(f"drawn: {command.gif}")
    return 0


def _load_params(
    command: Command, path: Path, update: int | None, config: TrainConfig, env: DrivingEnv
) -> tuple[Any, int | None]:
    """The parameters to score and the update that they are of; None for new ones."""
    network = ActorCritic(config.network)

    def initialise(env: DrivingEnv) -> Any:
        first = drive.start(env, jnp.arange(1), jax.random.key(TRAFFIC_SEED))
        return network.init(jax.random.key(config.run.seed), first.state.obs)

    if command.untrained:
        return jax.jit(initialise)(env), None
    chosen = checkpoint.best(path) if command.best else update
    like = jax.eval_shape(initialise, env)
    chosen = chosen if chosen is not None else max(checkpoint.updates(path), default=None)
    return checkpoint.restore_params(path, like, chosen), chosen


if __name__ == "__main__":
    sys.exit(main())
