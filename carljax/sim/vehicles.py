"""The classes of vehicles in traffic: their sizes, how briskly they drive, and where they fit.

Sizes are the bounding boxes of CARLA 0.9.15's blueprints. A bus and lorries are no wider than 2.6 m
here, as on the road: CARLA's boxes hold the mirrors too. Dynamics are those of SUMO's default
vehicle classes, as multiples of its passenger car's 2.6 and 4.5 m/s^2 ("Vehicle Type Parameter
Defaults" in its documentation). Shares, bends and roads are ours.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from carljax.sim.idm import IDMParams
from carljax.sim.lane_table import LATERAL_ACCEL
from carljax.sim.road_map import RoadMap

ANY_SPEED = 100.0  # m/s


@dataclasses.dataclass(frozen=True)
class VehicleClass:
    """One class.

    Attributes:
      length, width: m, shortest and longest, narrowest and widest.
      accel, brake: acceleration and comfortable braking, as multiples of a car's.
      speed_cap: m/s, never driven faster.
      share: of the traffic.
      bend_radius: m, it keeps off tighter bends where it has the choice: a long box placed on the
        middle of its lane reaches L^2 / (8 R) beyond it there.
      fastest_road: m/s, it keeps off roads with higher limits where it has the choice.
    """

    length: tuple[float, float]
    width: tuple[float, float]
    accel: float
    brake: float
    speed_cap: float
    share: float
    bend_radius: float = 0.0
    fastest_road: float = ANY_SPEED


CAR, VAN, TRUCK, BUS, MOTORBIKE, BICYCLE = range(6)

# The rows of `Agents.model`.
CLASSES = (
    # source: most of CARLA's cars, Nissan Micra to Dodge Charger
    VehicleClass((3.6, 5.4), (1.8, 2.2), 1.0, 1.0, ANY_SPEED, share=0.76),
    # source: Volkswagen T2 4.4 x 1.8, Mercedes Sprinter 5.9 x 2.0, Ford ambulance 6.4 x 2.4
    VehicleClass((4.4, 6.4), (1.8, 2.3), 1.0, 1.0, 36.0, share=0.09),
    # source: Carlacola 5.2 x 2.6, European HGV 7.9, firetruck 8.5; 80 km/h by law in much of Europe
    VehicleClass((5.2, 8.5), (2.4, 2.6), 0.5, 0.9, 22.2, share=0.06, bend_radius=20.0),
    # source: Mitsubishi Fusorosa 10.3
    VehicleClass((9.9, 10.3), (2.5, 2.6), 0.46, 0.9, 22.2, share=0.02, bend_radius=25.0),
    # source: Vespa 1.8 x 0.87 to Harley-Davidson 2.4 x 0.77; SUMO's is 2.3 times as brisk as a car
    VehicleClass((1.8, 2.4), (0.76, 0.87), 1.5, 1.2, ANY_SPEED, share=0.04),
    # source: Diamondback Century 1.7 x 0.58, Gazelle Omafiets 1.8 x 0.66; SUMO rides at 20 km/h
    VehicleClass((1.6, 1.9), (0.58, 0.66), 0.46, 0.67, 5.6, share=0.03, fastest_road=14.0),
)


def _column(field: str) -> np.ndarray:
    return np.array([getattr(one, field) for one in CLASSES], np.float32)


_SHARE = np.cumsum(_column("share"))
# Speed at which a bend of that radius is comfortable: what `RoadMap.lane_curve_speed` says of it.
_BEND_SPEED = np.sqrt(LATERAL_ACCEL * _column("bend_radius")).astype(np.float32)
_MAX_LENGTH = _column("length")[:, 1]


def draw(
    lane: jax.Array, room: jax.Array, road_map: RoadMap, key: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Vehicles that suit their places.

    Args:
      lane: (N,) int32, where each will be.
      room: (N,) m, longest vehicle that has room there.
      road_map: the map.
      key: PRNG key.

    Returns:
      (N,) int32 row of `CLASSES`; (N,) m length; (N,) m width. What does not suit becomes a car.
    """
    key_model, key_size = jax.random.split(key)
    shape = lane.shape
    drawn = jax.random.uniform(key_model, shape)
    model = (drawn[:, None] > jnp.asarray(_SHARE[:-1])).sum(axis=1).astype(jnp.int32)
    fits = jnp.asarray(_MAX_LENGTH)[model] <= room
    fits &= suits(model, jnp.maximum(lane, 0), road_map)
    model = jnp.where(fits, model, CAR)
    size = jax.random.uniform(key_size, (*shape, 2))
    low_high = [jnp.asarray(_column(name))[model] for name in ("length", "width")]
    length, width = (
        ends[:, 0] + (ends[:, 1] - ends[:, 0]) * size[:, i] for i, ends in enumerate(low_high)
    )
    return model, length, width


def suits(model: jax.Array, lane: jax.Array, road_map: RoadMap) -> jax.Array:
    """Whether a vehicle of that class would choose that lane: bool, elementwise.

    Args:
      model: int32, rows of `CLASSES`.
      lane: int32, rows of the lane table, not negative; broadcasts against model.
      road_map: the map.
    """
    wide = road_map.lane_curve_speed[lane] >= jnp.asarray(_BEND_SPEED)[model]
    limit = jnp.asarray(_column("fastest_road"))[model]
    return wide & (road_map.lane_speed_limit[lane] <= limit)


def driver(model: jax.Array, params: IDMParams) -> IDMParams:
    """A car's driver model as drivers of each class have it.

    Args:
      model: (N,) int32, rows of `CLASSES`.
      params: of a car.

    Returns:
      The parameters, `accel_max` and `comfort_brake` (N,).
    """
    return params.replace(
        accel_max=params.accel_max * jnp.asarray(_column("accel"))[model],
        comfort_brake=params.comfort_brake * jnp.asarray(_column("brake"))[model],
    )


def speed_cap(model: jax.Array) -> jax.Array:
    """m/s, of model's shape: what a vehicle never exceeds."""
    return jnp.asarray(_column("speed_cap"))[model]


def typical_size(model: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Length and width in the middle of a class's ranges, m: for the cars of scripts."""
    middle = [jnp.asarray(_column(name).mean(axis=1))[model] for name in ("length", "width")]
    return middle[0], middle[1]
