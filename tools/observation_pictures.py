"""Draws the pictures of docs/observations.md: `python tools/observation_pictures.py [DIRECTORY]`.

One moment of a drive by PDM-Lite, the liveliest of a minute, seen by each kind of observation: on
the left in colour with the ego put in, on the right every channel by itself in grey.
"""

from __future__ import annotations

import pathlib
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from carljax.planners import PLANNERS
from carljax.render import image
from carljax.reward.config import RewardConfig
from carljax.sim import episodes, observation, town, towns
from carljax.sim.env import DrivingEnv, EnvConfig, make_env
from carljax.sim.observation import KINDS
from carljax.sim.types import KIND_PEDESTRIAN, KIND_VEHICLE, STOP_LIGHT, State

TARGET = pathlib.Path(__file__).resolve().parent.parent / "docs" / "images"
TOWN, EPISODES, STEPS = "grid", 4, 600
TILE, LABEL, MARGIN, PICTURE = 144, 16, 6, 480


def main(arguments: list[str]) -> int:
    """Writes one picture for each kind."""
    target = pathlib.Path(arguments[0]) if arguments else TARGET
    there = [town.load(towns.path(TOWN))]
    bank = episodes.make_bank(there, EPISODES, config("roach").population, 3, 600.0, 100.0)
    # Roach's states remember most; what the other kinds remember follows from two of them.
    states, lively = jax.jit(drive)(make_env(bank, config("roach"), RewardConfig()))
    episode, step = np.unravel_index(int(np.argmax(np.asarray(lively))), lively.shape)
    before, sim = (
        jax.tree.map(lambda x, s=s: x[episode, s], states.pipeline_state) for s in (step - 1, step)
    )
    for kind in KINDS:
        env = make_env(bank, config(kind), RewardConfig())
        now = sim if kind == "roach" else observation.remember(env, before, sim)
        seen = jax.jit(observation.observe)(env, now)
        path = target / f"observation_{kind}.png"
        sheet(np.asarray(seen.raster), kind, env).save(path, optimize=True)
        print(f"{path}: episode {episode}, step {step}, {np.asarray(seen.scalars).round(2)}")
    return 0


def config(kind: Any) -> EnvConfig:
    """A crowded town."""
    return EnvConfig(num_agents=48, num_pedestrians=24, observation=kind)


def drive(env: DrivingEnv) -> tuple[State, jax.Array]:
    """All states of the episodes, (E, STEPS), and how much there is to see in each."""
    planner = PLANNERS["pdm-lite"]

    def one(episode: jax.Array) -> tuple[State, jax.Array]:
        start = env.start_episode(episode, jax.random.key(7))

        def step(carry: tuple, _: None) -> tuple[tuple, tuple]:
            state, memory = carry
            action, memory = planner.act(env, state.pipeline_state, memory)
            state = env.advance(state, action)
            return (state, memory), (state, _liveliness(env, state))

        return jax.lax.scan(step, (start, planner.init(env)), None, length=STEPS)[1]

    return jax.lax.map(one, jnp.arange(EPISODES))


def _liveliness(env: DrivingEnv, state: State) -> jax.Array:
    """Moving vehicles and pedestrians within 18 m, and whether a light is just ahead."""
    sim = state.pipeline_state
    routes = jax.tree.map(lambda x: x[sim.episode_idx], env.bank.routes)
    near = jnp.linalg.norm(sim.agents.xy - sim.ego.xy, axis=-1) < 18.0
    moving = sim.agents.speed > 1.0
    kinds = sim.agents.kind
    cars = 3 * jnp.sum(near & moving & (kinds == KIND_VEHICLE))
    walkers = jnp.sum(near & (kinds == KIND_PEDESTRIAN))
    ahead = routes.stop_idx - sim.route_idx
    light = jnp.any((routes.stop_kind == STOP_LIGHT) & (ahead > 5) & (ahead < 20))
    return jnp.where(state.done > 0, 0, (cars + walkers) * (1 + light))


def sheet(raster: np.ndarray, kind: str, env: DrivingEnv) -> Image.Image:
    """The coloured picture and the channels beside it."""
    names = env.config.channels
    rows = 3
    columns = -(-len(names) // rows)
    size = (PICTURE + MARGIN * 2 + columns * (TILE + MARGIN), rows * (TILE + LABEL) + 2 * MARGIN)
    out = Image.new("RGB", size, (24, 26, 30))
    draw, font = ImageDraw.Draw(out), ImageFont.load_default(size=11)
    vehicle = (float(env.vehicle.length), float(env.vehicle.width))
    coloured = image.bev_image(raster, env.config.raster, 2, vehicle, kind)
    picture = Image.fromarray(coloured).resize((PICTURE, PICTURE), Image.Resampling.LANCZOS)
    out.paste(picture, (MARGIN, MARGIN))
    for i, name in enumerate(names):
        x = PICTURE + 2 * MARGIN + (i % columns) * (TILE + MARGIN)
        y = MARGIN + (i // columns) * (TILE + LABEL)
        draw.text((x, y), f"{i} {name}", (232, 232, 228), font)
        tile = Image.fromarray(raster[..., i]).resize((TILE, TILE), Image.Resampling.BOX)
        out.paste(tile, (x, y + LABEL))
    return out


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
