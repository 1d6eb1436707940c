"""From a configuration to what runs: towns, episode banks, environment, network, devices."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import jax
from jax.sharding import Mesh

from carljax import machine, route_bank
from carljax.config import ConfigError, TrainConfig
from carljax.ppo import obs_storage, trainer
from carljax.ppo.networks import ActorCritic
from carljax.ppo.obs_storage import ObsStorage
from carljax.ppo.types import TrainState
from carljax.route_bank import BankError
from carljax.sim import bank_padding, episodes, journey, town, towns
from carljax.sim.env import DrivingEnv, make_env
from carljax.sim.journey import Journey
from carljax.sim.town import Town


@dataclasses.dataclass(frozen=True)
class Setup:
    """All that a run needs but its training state.

    Attributes:
      config: what it was made from.
      towns: on the host.
      env: with the training routes, on every device.
      network: actor and critic.
      mesh: the devices.
      storage: how the observations of a batch are kept.
    """

    config: TrainConfig
    towns: Sequence[Town]
    env: DrivingEnv
    network: ActorCritic
    mesh: Mesh
    storage: ObsStorage


def setup(config: TrainConfig) -> Setup:
    """Reads the towns, draws the training routes and puts them on the devices.

    Args:
      config: the run's configuration.

    Returns:
      Everything but the training state.

    Raises:
      ConfigError: sizes that do not go together.
      MapError: a town can't be read.
      RouteError: a town is too small for the routes.
    """
    try:
        mesh = trainer.make_mesh(config.run.num_devices)
    except ValueError as error:
        raise ConfigError(f"run.num_devices: {error}") from error
    config.validate(mesh.size)
    loaded = load_towns(config.run.maps)
    run = config.run
    seed = run.seed if run.routes_seed is None else run.routes_seed
    if run.routes:
        training = environment_on(config, loaded, read_banks(config, loaded), seed)
    else:
        training = environment(config, loaded, run.num_routes, seed)
    training = trainer.replicate(training, mesh)
    network = ActorCritic(config.network)
    return Setup(config, loaded, training, network, mesh, obs_storage_on(mesh, config))


def obs_storage_on(mesh: Mesh, config: TrainConfig) -> ObsStorage:
    """Returns the way to keep observations that is asked for, or chooses it by their size."""
    asked = config.run.obs_storage
    if asked != "auto":
        return obs_storage.STORAGES[asked]
    raster, channels = config.env.raster, len(config.env.channels)
    return obs_storage.choose(
        (raster.height, raster.width, channels),
        config.env.levels,
        config.ppo.batch_size // mesh.size,
        memory_of_device(mesh),
    )


def memory_of_device(mesh: Mesh) -> int:
    """Returns the bytes that a device may use; those on the CPU share their host's."""
    available = machine.device_memory()
    return available // mesh.local_mesh.size if jax.default_backend() == "cpu" else available


def load_towns(maps: Sequence[Path]) -> list[Town]:
    """Reads the user's maps, or the bundled towns to train in where there are none."""
    return [town.load(path) for path in _map_files(maps)]


def _map_files(maps: Sequence[Path]) -> Sequence[Path]:
    return maps or [towns.path(name) for name in towns.TRAINING]


def read_banks(config: TrainConfig, loaded: Sequence[Town]) -> list[Journey]:
    """Reads the configuration's banks of routes.

    Args:
      config: with `run.routes`.
      loaded: the towns of its maps.

    Returns:
      The journeys of all banks, in the tables that the towns share.

    Raises:
      ConfigError: a bank can't be read, is of another map, or a town has none.
    """
    files = list(_map_files(config.run.maps))
    digests = [route_bank.map_sha256(file) for file in files]
    firsts = town.offsets(loaded)
    journeys: list[Journey] = []
    missing = set(range(len(files)))
    try:
        for path in config.run.routes:
            made = route_bank.read_origin(path)
            if made.map_sha256 not in digests:
                raise ConfigError(
                    f"run.routes: {path}: was made for the map {made.map_name} with SHA-256 "
                    f"{made.map_sha256[:12]}, which is none of this run's maps"
                )
            at = digests.index(made.map_sha256)
            read = route_bank.load(path, loaded[at], files[at])
            journeys += [journey.shift(one, firsts[at]) for one in read]
            missing.discard(at)
    except BankError as error:
        raise ConfigError(f"run.routes: {error}") from error
    if missing:
        lacking = files[min(missing)]
        raise ConfigError(f"run.routes: there is no bank for {lacking}, one of this run's maps")
    return journeys


def environment(
    config: TrainConfig, loaded: Sequence[Town], num_routes: int, seed: int
) -> DrivingEnv:
    """Draws routes and makes the environment that drives on them.

    Args:
      config: the run's configuration.
      loaded: the towns.
      num_routes: over all towns.
      seed: of routes and first places of traffic; `config.HELD_OUT_SEED` for scoring.

    Returns:
      The environment.
    """
    bank = episodes.make_bank(
        loaded,
        num_routes,
        config.env.population,
        seed,
        config.env.route_length,
        config.env.scenario_spacing,
    )
    return make_env(bank_padding.pad(bank), config.env, config.reward)


def environment_on(
    config: TrainConfig, loaded: Sequence[Town], journeys: Sequence[Journey], seed: int
) -> DrivingEnv:
    """Makes the environment that drives on given routes.

    Args:
      config: the run's configuration.
      loaded: the towns.
      journeys: the routes with their scenarios, in the tables that the towns share.
      seed: of first places of traffic.

    Returns:
      The environment.
    """
    bank = episodes.populate(loaded, journeys, config.env.population, seed)
    return make_env(bank_padding.pad(bank), config.env, config.reward)


def initial_state(made: Setup) -> TrainState:
    """Makes the training state before the first update."""
    key = jax.random.key(made.config.run.seed)
    return trainer.init(key, made.env, made.network, made.config.ppo, made.mesh)
