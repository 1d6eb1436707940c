"""`carljax.train` as one of several processes, in the toy environment: see test_distributed.py.

Arguments: WHEN WHAT, then those of the command. In the update of that number of this start the
process sends itself the signal of that name; 0 for never.
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
from flax import struct

from carljax import build, courses, evaluate, train
from carljax.ppo import trainer
from carljax.ppo.networks import ActorCritic, forward
from carljax.scores import EvalResult, RouteScore

sys.path.append(str(Path(__file__).resolve().parent / "ppo"))
from toy_env import ToyEnv  # noqa: E402


@struct.dataclass
class Named(ToyEnv):
    """The toy environment with the numbers that the command shows."""

    def _state(self, dot, reward, started=False):
        state = super()._state(dot, reward, started)
        shown = {"episode/return": reward, "episode/route_completion": jnp.abs(dot.x)}
        return state.replace(metrics={**state.metrics, **shown})


def setup(values):
    """Stands in for `build.setup`."""
    mesh = trainer.make_mesh(values.run.num_devices)
    values.validate(mesh.size)
    env = Named(starts=jnp.linspace(-0.8, 0.8, 9, dtype=jnp.float32))
    network = ActorCritic(values.network)
    storage = build.obs_storage_on(mesh, values)
    return build.Setup(values, (), trainer.replicate(env, mesh), network, mesh, storage)


def score(course, policy):
    """Stands in for `evaluate.evaluate`: what the critic says of a start, on one own device."""
    first = course.env.observe(course.env.start(jax.random.key(0)))
    obs = jax.tree.map(lambda x: x[None], first.obs)
    value = float(forward(policy.network, policy.params, obs)[2][0])
    route = RouteScore(
        index=0, route_id="0", repetition=0, town="toy", length_km=1.0, driven_km=1.0, seconds=1.0,
        completion=value, clean_completion=value, outside_km=0.0, num_scenarios=0,
        num_triggered=0, speed_percent=(), events=(),
    )  # fmt: skip
    return EvalResult((route,))


def watched(make, when, what):
    """Lets the train steps that a function makes send this process a signal."""
    calls = []

    def made(*args):
        step = make(*args)

        def stepped(env, state):
            calls.append(1)
            if len(calls) == when:
                os.kill(os.getpid(), signal.Signals[what])
            return step(env, state)

        return stepped

    return made


def main() -> int:
    """Runs the command."""
    when, what = int(sys.argv[1]), sys.argv[2]
    build.setup = setup
    courses.held_out = lambda *_: SimpleNamespace(title="toy", env=Named(jnp.zeros(1)))
    evaluate.evaluate = score
    trainer.make_train_step = watched(trainer.make_train_step, when, what)
    return train.main(sys.argv[3:])
