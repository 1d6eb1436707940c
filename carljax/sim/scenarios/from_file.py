"""The scenarios of route files: from their trigger points to places on a route. Host only."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from carljax.sim.leaderboard_files import V1_TYPES, Trigger
from carljax.sim.route import Route
from carljax.sim.scenarios import generator, registry
from carljax.sim.scenarios import site as site_module
from carljax.sim.scenarios.script import Scenario
from carljax.sim.scenarios.site import Site
from carljax.sim.town import Offsets, Town

# Triggers that a file gives to one route lie up to 10.5 m beside it. source: longest6
REACH, YAW_TOLERANCE = 12.0, np.radians(45.0)
# Those that a file gives to a whole town are a route's where they lie on it. source: the authors'
# generator, and leaderboard 1.0
TOWN_REACH, TOWN_YAW_TOLERANCE = 2.0, np.radians(10.0)
SHIFT = 10  # route points that a trigger is moved at most where it doesn't suit. source: ours
SHIFT_STEP = 2
SAME_PLACE = 2.0  # m; of town triggers so near to one another one is drawn. source: leaderboard 1.0


@dataclasses.dataclass(frozen=True)
class Placement:
    """What became of a scenario of a file.

    Attributes:
      route: id of its route.
      name, type: as in the file.
      kind: from `registry.KINDS`; "" where it was not placed.
      trigger_s: m on the route; NaN where it was not placed.
      away: m from the file's place to the trigger, or to the route where it was not placed.
      reason: why it was not placed; "" where it was.
      parameters: names of values of the file that were not used.
    """

    route: str
    name: str
    type: str
    kind: str
    trigger_s: float
    away: float
    reason: str
    parameters: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Stage:
    """Where scenarios are put: a town, a route on it and the route's id in its file."""

    town: Town
    first: Offsets
    route: Route
    route_id: str

    @property
    def xy(self) -> np.ndarray:
        """(num_points, 2) m."""
        return np.asarray(self.route.xy[: int(self.route.num_points)], float)

    @property
    def yaw(self) -> np.ndarray:
        """(num_points,) rad."""
        return np.asarray(self.route.yaw[: int(self.route.num_points)], float)


def place_all(
    stage: Stage, groups: Iterable[Sequence[Trigger]], seed: Sequence[int]
) -> tuple[tuple[Scenario, ...], tuple[Placement, ...]]:
    """Places the scenarios of a route.

    Args:
      stage: where.
      groups: triggers of which at most one is placed: the first that suits in an order that is
        drawn.
      seed: of all that is drawn.

    Returns:
      The scenarios in order of `arm_s`, and what became of each trigger, in order of the groups.
    """
    found: list[Scenario] = []
    placements: list[Placement] = []
    for number, group in enumerate(groups):
        rng = np.random.default_rng([*seed, number])
        taken = ""
        for i in rng.permutation(len(group)):
            if taken:
                reason = f"{taken} was drawn for this place"
                placements.append(_report(stage, group[i], reason=reason))
                continue
            scenario, placement = _place(stage, group[i], found, rng)
            placements.append(placement)
            if scenario is not None:
                found.append(scenario)
                taken = placement.name
    return tuple(sorted(found, key=lambda scenario: float(scenario.arm_s))), tuple(placements)


def on_route(stage: Stage, triggers: Sequence[Trigger]) -> list[list[Trigger]]:
    """The triggers of a town that lie on a route, those at one place together."""
    groups: list[list[Trigger]] = []
    for trigger in triggers:
        if not _passes(stage, trigger, TOWN_REACH, TOWN_YAW_TOLERANCE):
            continue
        for group in groups:
            if np.hypot(*(group[0].xy - trigger.xy)) < SAME_PLACE:
                group.append(trigger)
                break
        else:
            groups.append([trigger])
    return groups


def _place(
    stage: Stage, trigger: Trigger, others: Sequence[Scenario], rng: np.random.Generator
) -> tuple[Scenario | None, Placement]:
    """Tries the places near a trigger, the nearest first."""
    kinds = [kind for kind in V1_TYPES.get(trigger.type, (trigger.type,)) if kind in registry.PLACE]
    if not kinds:
        return None, _report(stage, trigger, reason="there is no such kind of scenario here")
    passes = _passes(stage, trigger, REACH, YAW_TOLERANCE)
    if not passes:
        away = float(np.hypot(*(stage.xy - _local(stage, trigger)).T).min())
        off = f"lies {away:.1f} m off the route"
        reason = off if away > REACH else "the route does not go its way there"
        return None, _report(stage, trigger, reason=reason)
    reason = _refusal(stage, kinds, passes[0])
    for index in _indices(passes, len(stage.xy)):
        for kind in kinds:
            site = Site(stage.town, stage.first, stage.route, index)
            scenario = registry.place(kind, site, rng)
            if scenario is None:
                continue
            if any(generator.clash(scenario, other) for other in others):
                reason = "another scenario needs the road at the same time"
                continue
            return scenario, _report(stage, trigger, kind=kind, index=index)
    return None, _report(stage, trigger, reason=reason)


def _refusal(stage: Stage, kinds: Sequence[str], index: int) -> str:
    """Why no kind may suit a place, as far as can be told from outside."""
    if not generator.AT_JUNCTION.issuperset(kinds):
        left = float(stage.route.length - stage.route.s[index])
        return f"does not suit the route there, {left:.0f} m before its end"
    crossing = site_module.next_junction(Site(stage.town, stage.first, stage.route, index))
    if crossing is None:
        return "there is no junction ahead that the route passes"
    lanes = (*crossing.lanes, crossing.approach)
    lights = "has" if site_module.light_of(stage.town, lanes) >= 0 else "has no"
    return (
        f"does not suit the junction ahead, which {lights} lights, has the route go {crossing.way} "
        "and may lack an arm long enough"
    )


def _local(stage: Stage, trigger: Trigger) -> np.ndarray:
    """A trigger in the town's own coordinates."""
    return trigger.xy - stage.town.offset


def _passes(stage: Stage, trigger: Trigger, reach: float, tolerance: float) -> list[int]:
    """Where the route passes a trigger in its direction: one index a pass, the nearest first."""
    away = np.hypot(*(stage.xy - _local(stage, trigger)).T)
    turned = np.abs((stage.yaw - trigger.yaw + np.pi) % (2 * np.pi) - np.pi)
    fits = np.flatnonzero((away <= reach) & (turned <= tolerance))
    if len(fits) == 0:
        return []
    runs = np.split(fits, np.flatnonzero(np.diff(fits) > 1) + 1)
    nearest = [int(run[away[run].argmin()]) for run in runs]
    return sorted(nearest, key=lambda index: float(away[index]))


def _indices(passes: Sequence[int], num: int) -> Iterator[int]:
    """Places to try: at each pass the point itself, then those before and after it in turn."""
    for index in passes:
        for shift in range(0, SHIFT + 1, SHIFT_STEP):
            for at in dict.fromkeys((index - shift, index + shift)):
                if 0 <= at < num:
                    yield at


def _report(
    stage: Stage, trigger: Trigger, kind: str = "", index: int = -1, reason: str = ""
) -> Placement:
    away = np.hypot(*(stage.xy - _local(stage, trigger)).T)
    return Placement(
        route=stage.route_id,
        name=trigger.name,
        type=trigger.type,
        kind=kind,
        trigger_s=float(stage.route.s[index]) if kind else float("nan"),
        away=float(away[index] if kind else away.min()),
        reason=reason,
        parameters=trigger.parameters,
    )
