"""How a rollout keeps its observations until the update has used them.

An image of 256 x 256 x 10 bytes is 655 kB; the paper's batch of 65,536 would be 43 GB. So it can be
kept as it is, in fewer bits, or not at all: the rasterizer is pure, and draws the same image again
from the state of the simulator, a few kB. What the learner sees is the same in all three.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from carljax.ppo import bit_pack
from carljax.sim.autoreset import Env
from carljax.sim.types import Observation, State

StorageName = Literal["store", "pack", "rerender"]

IMAGES_FRAC = 0.5  # of a device's memory that kept images may take


class ObsStorage(NamedTuple):
    """A way to keep an observation; both functions unbatched.

    Attributes:
      name: what it is called.
      keep: (env, state) to what is kept of `state.obs`, a pytree of arrays.
      recall: (env, kept) to the observation.
    """

    name: StorageName
    keep: Callable[[Env, State], Any]
    recall: Callable[[Env, Any], Observation]


def _pack(env: Env, state: State) -> Observation:
    return state.obs.replace(raster=bit_pack.pack(state.obs.raster, env.levels))


def _unpack(env: Env, kept: Observation) -> Observation:
    return kept.replace(raster=bit_pack.unpack(kept.raster, env.levels))


def _keep_what_is_seen(env: Env, state: State) -> State:
    """Returns the state with None for every array that the observation does not depend on."""
    state = state.replace(obs=None)
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), state)
    program = jax.make_jaxpr(lambda state: env.observe(state).obs)(like).jaxpr
    needed = set(map(id, program.outvars))
    for equation in reversed(program.eqns):
        if not needed.isdisjoint(map(id, equation.outvars)):
            needed.update(map(id, equation.invars))
    leaves, structure = jax.tree.flatten(state)
    seen = [
        leaf if id(x) in needed else None for leaf, x in zip(leaves, program.invars, strict=True)
    ]
    return jax.tree.unflatten(structure, seen)


def _draw_again(env: Env, kept: State) -> Observation:
    whole = jax.eval_shape(env.start, jax.random.key(0))
    state = jax.tree.map(_or_blank, whole, kept)
    return env.observe(state).obs


def _or_blank(like: jax.ShapeDtypeStruct, kept: jax.Array | None) -> jax.Array:
    """Returns what is kept, or an array of the shape of what is not: nobody reads its values."""
    if kept is not None:
        return kept
    if jax.dtypes.issubdtype(like.dtype, jax.dtypes.prng_key):
        return jnp.broadcast_to(jax.random.key(0), like.shape)
    return jnp.zeros(like.shape, like.dtype)


STORE = ObsStorage("store", lambda env, state: state.obs, lambda env, kept: kept)
PACK = ObsStorage("pack", _pack, _unpack)
RERENDER = ObsStorage("rerender", _keep_what_is_seen, _draw_again)
STORAGES = {storage.name: storage for storage in (STORE, PACK, RERENDER)}


def choose(
    image: tuple[int, int, int], levels: tuple[bit_pack.Levels, ...], num: int, available: int
) -> ObsStorage:
    """Chooses the quickest way whose images take no more than half of the memory.

    Args:
      image: height, width and channels.
      levels: of each channel, see `bit_pack`.
      num: images of a rollout on one device.
      available: bytes that one device may use.

    Returns:
      To store, to pack or to draw again.
    """
    most = IMAGES_FRAC * available
    if num * math.prod(image) <= most:
        return STORE
    if num * math.prod(image[:2]) * bit_pack.num_bytes(levels) <= most:
        return PACK
    return RERENDER
