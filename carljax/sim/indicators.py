"""What vehicles show one another: indicators before turns and lane changes, brake lights."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from carljax.sim.right_of_way import planned_lane
from carljax.sim.road_map import RoadMap
from carljax.sim.types import SIGNAL_BRAKE, SIGNAL_LEFT, SIGNAL_RIGHT, Agents

BEFORE_TURN = 30.0  # m at which a turn is shown. source: 100 feet by law in most of the USA
BRAKES = -1.0  # m/s^2, what is more than letting off the gas. source: ours, an engine's drag
STANDS = 0.1  # m/s


def signals(agents: Agents, road_map: RoadMap) -> jax.Array:
    """(N,) int32: indicators and brake lights anew, all other bits as they were.

    A lane change is shown from its beginning, when the car hardly moves sideways yet.

    Args:
      agents: (N,) vehicles after a step.
      road_map: the map.
    """
    lane, following = planned_lane(agents, 0), planned_lane(agents, 1)
    near = road_map.lane_length[lane] - agents.lane_s - 0.5 * agents.length < BEFORE_TURN
    turn = road_map.lane_signal[lane]
    turn = jnp.where((turn == 0) & near, road_map.lane_signal[following], turn)
    # Left of the new lane's middle: it comes from there and goes to the right.
    change = jnp.where(agents.lateral > 0.0, SIGNAL_RIGHT, SIGNAL_LEFT)
    side = jnp.where(agents.from_lane >= 0, change, turn)
    brake = (agents.accel < BRAKES) | (agents.speed < STANDS)
    kept = agents.signals & ~(SIGNAL_LEFT | SIGNAL_RIGHT | SIGNAL_BRAKE)
    shown = kept | side | jnp.where(brake, SIGNAL_BRAKE, 0)
    return jnp.where(agents.valid, shown, 0).astype(jnp.int32)
