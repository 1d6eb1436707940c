"""The light programme of each junction: who is green together, in what order. Host only."""

from __future__ import annotations

import dataclasses

import numpy as np

from carljax.sim import lights
from carljax.sim.junctions import junction_ids
from carljax.sim.lane_table import LaneTable
from carljax.sim.road_network import RoadNetwork
from carljax.sim.types import STOP_LIGHT

JUNCTION_REACH = 60.0  # m beyond a light's lane in which its junction is looked for. source: ours


@dataclasses.dataclass(frozen=True)
class LightTable:
    """Fields as in `RoadMap`: lane_light (K,), cycle (L,), start (L,), junction (L,)."""

    lane_light: np.ndarray
    cycle: np.ndarray
    start: np.ndarray
    junction: np.ndarray


def build(network: RoadNetwork, table: LaneTable) -> LightTable:
    """Orders the controllers of each junction and gives every governed lane its light.

    A light without a controller switches alone. A junction with a single group shows red for one
    slot, so that its light is not green for ever.
    """
    controller_of = {s: c.id for c in network.controllers.values() for s in c.signals}
    groups: dict[str, dict[str, list[int]]] = {}
    for lane in np.flatnonzero(table.stop_kind == STOP_LIGHT):
        signal = table.stop_signal[lane]
        group = controller_of.get(signal, f"signal {signal}")
        groups.setdefault(_junction_of(table, int(lane)), {}).setdefault(group, []).append(
            int(lane)
        )
    lane_light = np.full(len(table.length), -1)
    cycle: list[float] = []
    start: list[float] = []
    junction: list[int] = []
    ids = junction_ids(table)
    for number, name in enumerate(sorted(groups)):
        order = sorted(groups[name], key=lambda g: _sequence(network, name, g))
        period = lights.SLOT_S * max(2, len(order))
        # Neighbouring junctions are not in step: an offset that no multiple of a slot brings back.
        offset = (number * 0.618034 * period) % period
        for place, group in enumerate(order):
            lane_light[groups[name][group]] = len(cycle)
            cycle.append(period)
            junction.append(ids.get(name, -1))
            start.append((place * lights.SLOT_S + offset) % period)
    if not cycle:  # the table is never empty, so that look-ups need no special case
        cycle, start, junction = [lights.SLOT_S], [0.0], [-1]
    return LightTable(lane_light, np.array(cycle), np.array(start), np.array(junction))


def _junction_of(table: LaneTable, lane: int) -> str:
    """The junction a light belongs to: that of its lane or else the first one ahead."""
    seen, ahead = {lane}, [(lane, 0.0)]
    for row, distance in ahead:  # grows: nearer lanes, counted in lanes, come first
        name = table.junction[row]
        if name is not None:
            return name
        beyond = distance + (float(table.length[row]) if row != lane else 0.0)
        new = {int(n) for n in table.successors[row] if n >= 0 and beyond < JUNCTION_REACH} - seen
        seen |= new
        ahead += [(n, beyond) for n in sorted(new)]
    return f"lane {lane}"


def _sequence(network: RoadNetwork, junction: str, group: str) -> tuple[int, int, str]:
    listed = network.junctions[junction].controllers if junction in network.junctions else ()
    place = listed.index(group) if group in listed else len(listed)
    controller = network.controllers.get(group)
    return (place, controller.sequence if controller else 0, group)
