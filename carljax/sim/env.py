"""The driving environment: the only file that composes the simulator.

One environment, unbatched; `vmap` goes above. Order of a step: the ego moves by the action, traffic
moves by its own rules, one far-away car may be used again nearby, the clock of the lights goes on,
scenarios are played, pedestrians walk; then the reward looks at where everything is now.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
from flax import struct

from carljax.reward import reward
from carljax.reward.config import RewardConfig
from carljax.sim import (
    bicycle,
    lights,
    nuplan_atlas,
    observation,
    pedestrians,
    population,
    respawn,
    route,
    situation,
    spawn,
    threefry,
    traffic,
)
from carljax.sim.bicycle import VehicleParams
from carljax.sim.episodes import EpisodeBank
from carljax.sim.idm import IDMParams
from carljax.sim.nuplan_atlas import NuplanAtlas
from carljax.sim.observation_nuplan import NuplanOptions
from carljax.sim.observation_roach import RoachOptions
from carljax.sim.population import Population
from carljax.sim.raster_canvas import RasterConfig
from carljax.sim.right_of_way import EgoPlace
from carljax.sim.route import Route
from carljax.sim.scenarios import engine, script
from carljax.sim.scenarios.actors import Scene
from carljax.sim.types import (
    Agents,
    EgoState,
    LightClock,
    RewardTerms,
    SimState,
    Situation,
    State,
    Walkers,
)

ObservationKind = Literal["carla", "roach", "nuplan"]  # of `observation.KINDS`

ACTION_SIZE = 2
# m/s^2. source: ours, brisker than the textbook's city drivers: a queue clears in a green of 10 s.
TRAFFIC_ACCEL, TRAFFIC_BRAKE = 2.0, 3.0
LIGHT_CLOCK = 600.0  # s, the light clock starts anywhere in it


@dataclasses.dataclass(frozen=True)
class EnvConfig:
    """The simulated world and what is seen of it."""

    dt: float = 0.1
    """Length of a step, s. source: paper, Engineering, 10 Hz"""
    num_agents: int = 32
    """Most vehicles of ordinary traffic around the ego at once."""
    num_pedestrians: int = 12
    """Most pedestrians around the ego at once."""
    num_scenario_slots: int = 3
    """Most scenarios in play at once."""
    route_length: float = 1000.0
    """Length of a route, m. source: paper, Scenario Generation"""
    scenario_spacing: float | None = 100.0
    """Metres of route for each scenario; None or 0 for none. source: paper, Scenario Generation"""
    observation: ObservationKind = "carla"
    """What is seen: CaRL's observation in CARLA, Roach's with its history, or CaRL's in nuPlan."""
    raster: RasterConfig = None  # type: ignore[assignment]
    """The bird's-eye view image; by default of the observation's own size."""
    roach: RoachOptions = dataclasses.field(default_factory=RoachOptions)
    """Options of the observation `roach`."""
    nuplan: NuplanOptions = dataclasses.field(default_factory=NuplanOptions)
    """Options of the observation `nuplan`."""

    def __post_init__(self) -> None:
        """Gives the image the size that the observation's authors gave it, where none is said."""
        if self.raster is None:
            object.__setattr__(self, "raster", observation.KINDS[self.observation].raster)

    @property
    def population(self) -> Population:
        """Who has which rows of the agents."""
        return Population(self.num_agents, self.num_scenario_slots, self.num_pedestrians)

    def with_observation(self, kind: ObservationKind) -> EnvConfig:
        """The same with another observation; an image of the old one's own size gets the new's."""
        is_own = self.raster == observation.KINDS[self.observation].raster
        raster = observation.KINDS[kind].raster if is_own else self.raster
        return dataclasses.replace(self, observation=kind, raster=raster)

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the image's channels."""
        return observation.KINDS[self.observation].channels

    @property
    def levels(self) -> tuple[tuple[int, ...] | None, ...]:
        """The values other than 0 that each channel takes; None where it may take any."""
        return tuple(observation.KINDS[self.observation].levels.get(x) for x in self.channels)

    def validate(self) -> None:
        """Checks the image and that no option is for another kind of observation.

        Raises:
          ValueError: in one line, the field and what is wrong with it.
        """
        self.raster.validate()
        for name, default in (("roach", RoachOptions()), ("nuplan", NuplanOptions())):
            if self.observation != name and getattr(self, name) != default:
                raise ValueError(
                    f"env.{name}: these options are of --env.observation {name}, "
                    f"which is {self.observation}"
                )


class DrivingEnv(struct.PyTreeNode):
    """Everything an episode needs and doesn't change; an argument of jitted functions.

    Attributes:
      bank: towns, routes and traffic.
      reward_config: numbers and options of the reward.
      vehicle: the ego's car.
      idm: the other drivers.
      config: sizes, static.
      nuplan: what the observation `nuplan` draws its map from; None for the others.
    """

    bank: EpisodeBank
    reward_config: RewardConfig
    vehicle: VehicleParams
    idm: IDMParams
    config: EnvConfig = struct.field(pytree_node=False)
    nuplan: NuplanAtlas | None = None

    @property
    def action_size(self) -> int:
        """Length of an action: steering and longitudinal, each in [-1, 1]."""
        return ACTION_SIZE

    @property
    def levels(self) -> tuple[tuple[int, ...] | None, ...]:
        """See `EnvConfig.levels`."""
        return self.config.levels

    def reset(self, key: jax.Array) -> State:
        """Returns the first state of an episode drawn from the bank."""
        return self.observe(self.start(key))

    def step(self, state: State, action: jax.Array) -> State:
        """Returns the state after one step of `config.dt`.

        Args:
          state: unbatched, not done.
          action: (2,) float32 in [-1, 1]: steering (positive left), throttle (positive) or brake.
        """
        return self.observe(self.advance(state, action))

    def start(self, key: jax.Array) -> State:
        """Returns what `reset` does, without the observation."""
        key_episode, key_rest = jax.random.split(threefry.written_out(key))
        episode_idx = jax.random.randint(key_episode, (), 0, self.bank.num_episodes)
        return self.start_episode(episode_idx, threefry.like(key_rest, key))

    def start_episode(self, episode_idx: jax.Array, key: jax.Array) -> State:
        """Returns the first state of a given episode, without the observation.

        Args:
          episode_idx: () int32, row of the bank.
          key: PRNG key, of all that the bank leaves open.
        """
        key_light, key_scenarios, key_next = jax.random.split(threefry.written_out(key), 3)
        routes, zero_idx = self.bank.routes, jnp.zeros((), jnp.int32)
        ego = ego_at(routes.xy[episode_idx, 0], routes.z[episode_idx], routes.yaw[episode_idx, 0])
        place = EgoPlace(routes.lane[episode_idx, 0], zero_idx - 1, routes.lane_s[episode_idx, 0])
        slots, agents = engine.start(
            script.empty_slots(self.config.num_scenario_slots),
            jax.tree.map(lambda x: x[episode_idx], self.bank.agents),
            self.bank.scenarios,
            episode_idx,
            self._scene(ego, place, jnp.zeros((), jnp.float32), is_start=True),
            key_scenarios,
        )
        sim = SimState(
            ego=ego,
            agents=agents,
            reward_state=reward.init(ego, routes.stop_kind.shape[1], self.reward_config),
            episode_idx=episode_idx.astype(jnp.int32),
            route_idx=zero_idx,
            walkers=jax.tree.map(lambda x: x[episode_idx], self.bank.walkers),
            scenarios=slots,
            lights=lights.clock(
                jax.random.uniform(key_light, (), maxval=LIGHT_CLOCK),
                self.config.num_scenario_slots,
            ),
            step_count=zero_idx,
            key=threefry.like(key_next, key),
        )
        zero = jnp.zeros((), jnp.float32)
        return State(
            pipeline_state=observation.begin(self, sim),
            obs=None,  # type: ignore[arg-type]
            reward=zero,
            done=zero,
            metrics=dict.fromkeys(metric_names(self.reward_config), zero),
            info={"truncation": zero},
        )

    def advance(self, state: State, action: jax.Array) -> State:
        """Returns what `step` does, without the observation."""
        before = state.pipeline_state
        keys = jax.random.split(threefry.written_out(before.key), 5)
        key_next, key_traffic, key_respawn, key_scenarios, key_walk = keys
        dt, road_map = self.config.dt, self.bank.road_map
        stretch, first = route.window(self.bank.routes, before.episode_idx, before.route_idx)
        idx = before.route_idx - first
        action = engine.disturb(
            action,
            before.scenarios,
            self.bank.scenarios,
            before.episode_idx,
            engine.progress(stretch, idx, before.ego),
        )
        ego = bicycle.step(before.ego, *bicycle.from_action(action), self.vehicle, dt)
        place = situation.ego_place(before.ego, road_map, stretch, idx)
        rows = self.config.population
        vehicles = population.rows(before.agents, rows.vehicles)
        others = population.rows(before.agents, slice(rows.num_vehicles, None))
        vehicles = traffic.step(
            vehicles,
            others,
            before.ego,
            jnp.float32(self.vehicle.length),
            place,
            road_map,
            before.lights,
            key_traffic,
            self.idm,
            dt,
        )
        traffic_rows = respawn.respawn(
            population.rows(vehicles, rows.traffic),
            population.rows(vehicles, rows.cars),
            ego,
            self.bank.routes,
            before.episode_idx,
            before.route_idx,
            road_map,
            key_respawn,
            spawn.CELL,
        )
        cars = population.rows(vehicles, rows.cars)
        agents = population.join(traffic_rows, cars, others)
        idx = route.advance(stretch, idx, ego.xy)
        slots, agents, clock = engine.step(
            before.scenarios,
            agents,
            before.lights.replace(time=before.lights.time + dt),
            self.bank.scenarios,
            before.episode_idx,
            self._scene(ego, place, engine.progress(stretch, idx, ego), is_start=False),
            key_scenarios,
            dt,
        )
        agents, walkers = self._walk(agents, before.walkers, ego, stretch.town, key_walk)
        seen = self._situation(ego, agents, stretch, first, idx, clock)
        paid, terminated, memory, terms = reward.compute(
            before, ego, agents, seen, self.vehicle, self.reward_config, dt
        )
        after = before.replace(
            ego=ego.replace(z=seen.lane_z),
            agents=agents,
            reward_state=memory,
            route_idx=seen.route_idx,
            walkers=walkers,
            scenarios=slots,
            lights=clock,
            step_count=before.step_count + 1,
            key=threefry.like(key_next, before.key),
        )
        ended, truncated = reward.ending(terminated, terms, self.reward_config)
        return State(
            pipeline_state=observation.remember(self, before, after),
            obs=None,  # type: ignore[arg-type]
            reward=paid,
            done=(ended | truncated).astype(jnp.float32),
            metrics=_metrics(state.metrics, after, seen, paid, terms, dt),
            info={"truncation": truncated.astype(jnp.float32)},
        )

    def observe(self, state: State) -> State:
        """Returns the state with what the policy and the critic see of it."""
        return state.replace(obs=observation.observe(self, state.pipeline_state))

    def _walk(
        self, agents: Agents, walkers: Walkers, ego: EgoState, town: jax.Array, key: jax.Array
    ) -> tuple[Agents, Walkers]:
        """Moves the pedestrians, after everybody else has moved."""
        rows, road_map = self.config.population, self.bank.road_map
        if rows.num_walkers == 0:
            return agents, walkers
        key_way, key_place = jax.random.split(key)
        others = population.rows(agents, slice(0, rows.walkers.start))
        bodies = population.rows(agents, rows.walkers)
        size = jnp.stack([jnp.float32(self.vehicle.length), jnp.float32(self.vehicle.width)])
        bodies, walkers = pedestrians.step(
            bodies, walkers, others, ego, size, road_map, key_way, self.config.dt
        )
        bodies, walkers = pedestrians.respawn(
            bodies, walkers, ego, town, road_map, key_place, spawn.CELL
        )
        return population.join(others, bodies), walkers

    def _scene(self, ego: EgoState, place: EgoPlace, route_s: jax.Array, is_start: bool) -> Scene:
        return Scene(
            ego=ego,
            ego_length=jnp.float32(self.vehicle.length),
            ego_place=place,
            route_s=route_s,
            road_map=self.bank.road_map,
            is_start=is_start,
            rows=self.config.population,
        )

    def _situation(
        self,
        ego: EgoState,
        agents: Agents,
        stretch: Route,
        first: jax.Array,
        idx: jax.Array,
        clock: LightClock,
    ) -> Situation:
        return situation.situation(
            ego,
            jnp.stack([jnp.float32(self.vehicle.length), jnp.float32(self.vehicle.width)]),
            agents,
            self.bank.road_map,
            stretch,
            first,
            idx,
            clock,
        )


def make_env(bank: EpisodeBank, config: EnvConfig, reward_config: RewardConfig) -> DrivingEnv:
    """Puts an environment together: CARLA's saloon as the ego among IDM's city drivers.

    Args:
      bank: towns, routes and traffic.
      config: sizes and the kind of observation.
      reward_config: numbers and options of the reward.

    Returns:
      The environment.

    Raises:
      ValueError: an image without pixels or without the ego in it, or an option of another kind of
        observation.
    """
    config.validate()
    is_nuplan = config.observation == "nuplan"
    return DrivingEnv(
        bank=bank,
        reward_config=reward_config,
        vehicle=VehicleParams(),
        idm=IDMParams(accel_max=TRAFFIC_ACCEL, comfort_brake=TRAFFIC_BRAKE),
        config=config,
        nuplan=nuplan_atlas.build(bank.road_map, bank.routes) if is_nuplan else None,
    )


def ego_at(xy: jax.Array, z: jax.Array, yaw: jax.Array) -> EgoState:
    """The ego at rest."""
    zero = jnp.zeros((), jnp.float32)
    return EgoState(
        xy=xy,
        z=z,
        yaw=yaw,
        speed=zero,
        slip=zero,
        yaw_rate=zero,
        accel=zero,
        steer=zero,
        throttle=zero,
        brake=zero,
    )


EPISODE_METRICS = (
    "episode/return",
    "episode/length",
    "episode/route_completion",
    "episode/km",
    "episode/scenarios",
)
OUTSIDE_LANES = "outside_lanes"  # the soft factor whose kilometres are logged


def metric_names(reward_config: RewardConfig) -> tuple[str, ...]:
    """Names of all that an environment logs; each reward has terms and ends of its own."""
    chosen = reward.chosen(reward_config)
    outside = (f"episode/{OUTSIDE_LANES}_km",) if OUTSIDE_LANES in chosen.soft else ()
    return (
        *(f"reward/{name}" for name in chosen.terms),
        *EPISODE_METRICS,
        *outside,
        *(f"episode/{name}_frac" for name in chosen.ends),
        "ego/speed",
    )


def _metrics(
    old: dict[str, jax.Array],
    after: SimState,
    seen: Situation,
    paid: jax.Array,
    terms: RewardTerms,
    dt: float,
) -> dict[str, jax.Array]:
    """What is logged of a step; `episode/` values add up within an episode and hold at its end."""
    step = reward.metrics(terms)
    driven = after.ego.speed * dt / 1000.0
    completion = 100.0 * seen.route_s / seen.route_length
    ends = (*terms.terminated, "finished", "timeout")
    kilometres = {}
    if OUTSIDE_LANES in terms.soft:
        outside = jnp.where(terms.soft[OUTSIDE_LANES] < 1.0, driven, 0.0)
        name = f"episode/{OUTSIDE_LANES}_km"
        kilometres[name] = old[name] + outside
    return {
        **step,
        **kilometres,
        **{f"episode/{name}_frac": step[f"reward/{name}"] for name in ends},
        "episode/return": old["episode/return"] + paid,
        "episode/length": after.step_count.astype(jnp.float32),
        "episode/route_completion": jnp.where(terms.finished, 100.0, completion),
        "episode/km": old["episode/km"] + driven,
        "episode/scenarios": after.scenarios.num_triggered.astype(jnp.float32),
        "ego/speed": after.ego.speed,
    }
