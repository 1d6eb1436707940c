"""Who has which rows of `Agents`: traffic, then the scenarios' cars, their others, pedestrians."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from carljax.sim.scenarios import script
from carljax.sim.types import KIND_NONE, Agents, Walkers


@dataclasses.dataclass(frozen=True)
class Population:
    """How many of each there is room for.

    Attributes:
      num_traffic: cars of ordinary traffic.
      num_slots: H, scenarios in play at once.
      num_walkers: W, pedestrians.
    """

    num_traffic: int
    num_slots: int
    num_walkers: int

    @property
    def num_vehicles(self) -> int:
        """Rows that drive on lanes: traffic, then the scenarios' cars."""
        return self.num_traffic + script.num_cars(self.num_slots)

    @property
    def num_agents(self) -> int:
        """N, all rows."""
        return self.others.stop + self.num_walkers

    @property
    def traffic(self) -> slice:
        """Rows of ordinary traffic."""
        return slice(0, self.num_traffic)

    @property
    def vehicles(self) -> slice:
        """Rows that drive on lanes."""
        return slice(0, self.num_vehicles)

    @property
    def cars(self) -> slice:
        """Rows of the scenarios' cars, see `ScenarioSlots.cars`."""
        return slice(self.num_traffic, self.num_vehicles)

    @property
    def others(self) -> slice:
        """Rows of the scenarios' other actors, see `ScenarioSlots.others`."""
        return slice(self.num_vehicles, self.num_vehicles + script.num_others(self.num_slots))

    @property
    def walkers(self) -> slice:
        """Rows of pedestrians."""
        return slice(self.num_agents - self.num_walkers, self.num_agents)


def nobody(num: int) -> Agents:
    """Empty rows."""
    zeros, false = jnp.zeros(num, jnp.float32), jnp.zeros(num, bool)
    return Agents(
        xy=jnp.zeros((num, 2), jnp.float32),
        z=zeros,
        yaw=zeros,
        speed=zeros,
        yaw_rate=zeros,
        accel=zeros,
        length=zeros,
        width=zeros,
        kind=jnp.full(num, KIND_NONE, jnp.int32),
        model=jnp.zeros(num, jnp.int32),
        signals=jnp.zeros(num, jnp.int32),
        lanes=jnp.full((num, 3), -1, jnp.int32),
        lane_s=zeros,
        past_lane=jnp.full(num, -1, jnp.int32),
        desired_speed_frac=zeros,
        has_stopped=false,
        wait_s=zeros,
        lateral=zeros,
        from_lane=jnp.full(num, -1, jnp.int32),
        from_s=zeros,
        cruise_speed=zeros,
        is_lawless=false,
        is_braking_hard=false,
    )


def no_walkers(num: int) -> Walkers:
    """Rows of `Walkers` with nobody in them."""
    zeros = jnp.zeros(num, jnp.float32)
    none = jnp.full(num, -1, jnp.int32)
    return Walkers(
        node=none, target=none, pace=zeros, offset=zeros, is_reckless=jnp.zeros(num, bool)
    )


def join(*parts: Agents) -> Agents:
    """Rows of several agents one after another."""
    return jax.tree.map(lambda *rows: jnp.concatenate(rows), *parts)


def rows(agents: Agents, part: slice) -> Agents:
    """Some rows of agents."""
    return jax.tree.map(lambda x: x[part], agents)
