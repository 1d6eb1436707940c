"""Routes and their scenarios in a file: drawn once, used by many runs.

A bank is an .npz file without pickles: the arrays of `Route` and `Scenario` with one town's own row
numbers, how they were drawn, and two fingerprints. The map's says for which file the bank was
drawn; that of its tables says how this version of the package numbers the map's lanes and lights,
so that a bank never points at other lanes than it was drawn on.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

import carljax
from carljax import atomic
from carljax.sim import episodes, route_assembly
from carljax.sim.journey import Journey, stack_routes, stack_scenarios
from carljax.sim.route import Route
from carljax.sim.scenarios import registry, script
from carljax.sim.scenarios.script import Scenario
from carljax.sim.town import Town

FORMAT = 1  # changes with the meaning of the arrays


class BankError(ValueError):
    """A bank that can't be read or doesn't fit: one line that names file and reason."""


@dataclasses.dataclass(frozen=True)
class Origin:
    """Where the routes of a bank come from: the same values give the same bank.

    Attributes:
      map_name: of the town.
      map_sha256: of its file, hex digits.
      tables_sha256: of its tables of lanes and lights, hex digits.
      num_routes: how many.
      seed: of all that was drawn.
      route_length: m.
      scenario_spacing: m of route for each scenario; 0 for none.
      version: of the package that drew them.
    """

    map_name: str
    map_sha256: str
    tables_sha256: str
    num_routes: int
    seed: int
    route_length: float
    scenario_spacing: float
    version: str


def origin(
    town: Town,
    map_file: Path,
    num_routes: int,
    seed: int,
    route_length: float,
    scenario_spacing: float,
) -> Origin:
    """How a bank of this version would be described."""
    return Origin(
        map_name=town.network.name,
        map_sha256=map_sha256(map_file),
        tables_sha256=tables_sha256(town),
        num_routes=num_routes,
        seed=seed,
        route_length=float(route_length),
        scenario_spacing=float(scenario_spacing),
        version=carljax.__version__,
    )


def map_sha256(map_file: Path) -> str:
    """The fingerprint of a map's file."""
    return hashlib.sha256(Path(map_file).read_bytes()).hexdigest()


def tables_sha256(town: Town) -> str:
    """The fingerprint of the numbers that a town's lanes, junctions and lights have here."""
    table = town.lanes
    parts: tuple[Any, ...] = (table.raw_lane, table.num_points, table.successors, table.stop_kind)
    parts += (town.lights.lane_light, town.junctions.junction)
    digest = hashlib.sha256()
    for part in parts:
        digest.update(np.ascontiguousarray(part, np.int64).tobytes())
    digest.update(np.round(table.length, 3).tobytes())
    return digest.hexdigest()


def make(town: Town, wanted: Origin) -> list[Journey]:
    """Draws the routes of a bank.

    Args:
      town: that of `wanted`.
      wanted: how many, how long, from which seed.

    Returns:
      The journeys, in the town's own row numbers.

    Raises:
      RouteError: the town is too small for such routes.
    """
    return episodes.draw_journeys(
        [town], wanted.num_routes, wanted.seed, wanted.route_length, wanted.scenario_spacing
    )


def save(path: Path, journeys: Sequence[Journey], made: Origin) -> None:
    """Writes a bank, whole or not at all; the same journeys give the same bytes.

    Args:
      path: the .npz file.
      journeys: in the town's own row numbers.
      made: where they come from.
    """
    trimmed = [Journey(route_assembly.trim(j.route), j.scenarios) for j in journeys]
    arrays: dict[str, Any] = {"format": np.int64(FORMAT), "kinds": np.array(registry.KINDS)}
    arrays |= {f"origin.{name}": np.array(x) for name, x in dataclasses.asdict(made).items()}
    arrays |= _flat("route", stack_routes(trimmed))
    arrays |= _flat("scenario", stack_scenarios(trimmed))
    data = io.BytesIO()
    np.savez_compressed(data, allow_pickle=False, **arrays)
    atomic.write_bytes(path, data.getvalue())


def _flat(name: str, tree: Any) -> dict[str, np.ndarray]:
    """Arrays of a struct by their dotted names."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {name + jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves}


def read_origin(path: Path) -> Origin:
    """Reads where the routes of a bank come from.

    Raises:
      BankError: it can't be read, is no bank, or one of another format.
    """
    return _origin(path, _arrays(path))


def _arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of a bank of this format."""
    if not path.is_file():
        raise BankError(f"{path}: is not there, or no file")
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zipfile.error) as error:
        raise BankError(f"{path}: is not a bank of routes: {_one_line(error)}") from None
    if "format" not in arrays or "kinds" not in arrays:
        raise BankError(f"{path}: is not a bank of routes: it has no format and kinds")
    if arrays["format"].shape != () or int(arrays["format"]) != FORMAT:
        raise BankError(
            f"{path}: is a bank of format {arrays['format']}, this version reads {FORMAT}; "
            "make it again"
        )
    return arrays


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:100]


def _origin(path: Path, arrays: dict[str, np.ndarray]) -> Origin:
    values = {}
    for field in dataclasses.fields(Origin):
        stored = arrays.get(f"origin.{field.name}")
        if stored is None or stored.shape != ():
            raise BankError(f"{path}: is damaged: it does not say its {field.name}")
        values[field.name] = stored.item()
    return Origin(**values)


def load(path: Path, town: Town, map_file: Path) -> list[Journey]:
    """Reads a bank onto its town.

    Args:
      path: the .npz file.
      town: for which it was made.
      map_file: the town's file.

    Returns:
      The journeys, in the town's own row numbers.

    Raises:
      BankError: unreadable, of another format, or made for another map.
    """
    arrays = _arrays(path)
    made = _origin(path, arrays)
    found = map_sha256(map_file)
    if made.map_sha256 != found:
        raise BankError(
            f"{path}: was made for the map {made.map_name} with SHA-256 {made.map_sha256[:12]}, "
            f"not for {map_file} with {found[:12]}"
        )
    if made.tables_sha256 != tables_sha256(town):
        raise BankError(
            f"{path}: was made by version {made.version}, which numbered the lanes of "
            f"{made.map_name} in another way; make it again"
        )
    scenarios = _tree(path, "scenario", script.nothing(1), arrays, made.num_routes)
    names: dict[str, Any] = dict.fromkeys(Route.__dataclass_fields__, 0)  # only names count here
    routes = _tree(path, "route", Route(**names), arrays, made.num_routes)
    scenarios = scenarios.replace(kind=_kinds(path, arrays["kinds"], scenarios.kind))
    return [_journey(routes, scenarios, i) for i in range(made.num_routes)]


def _tree(path: Path, name: str, like: Any, arrays: dict[str, np.ndarray], num: int) -> Any:
    """A struct from its arrays."""
    leaves, treedef = jax.tree_util.tree_flatten_with_path(like)
    names = [name + jax.tree_util.keystr(where) for where, _ in leaves]
    for key in names:
        if key not in arrays or arrays[key].ndim == 0 or len(arrays[key]) != num:
            raise BankError(f"{path}: is damaged or of another version: {key} is amiss")
    return jax.tree_util.tree_unflatten(treedef, [arrays[key] for key in names])


def _kinds(path: Path, names: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """Kinds by this version's numbers."""
    unknown = [str(name) for name in names if name not in registry.KINDS]
    if unknown:
        raise BankError(f"{path}: has scenarios of a kind that is not here: {unknown[0]}")
    places = np.array([registry.KINDS.index(str(name)) for name in names], np.int32)
    return np.where(kind >= 0, places[np.maximum(kind, 0)], np.int32(-1))


def _journey(routes: Route, scenarios: Scenario, number: int) -> Journey:
    """One journey of stacked ones."""
    own = jax.tree.map(lambda rows: rows[number], scenarios)
    used = int((own.kind >= 0).sum())
    return Journey(
        route=route_assembly.trim(jax.tree.map(lambda rows: rows[number], routes)),
        scenarios=tuple(jax.tree.map(lambda rows, i=i: rows[i], own) for i in range(used)),
    )


def summary(path: Path) -> dict[str, Any]:
    """What is in a bank, as JSON takes it.

    Raises:
      BankError: it can't be read.
    """
    arrays = _arrays(path)
    made = _origin(path, arrays)
    for name in ("scenario.kind", "route.length"):
        if name not in arrays or len(arrays[name]) != made.num_routes:
            raise BankError(f"{path}: is damaged or of another version: {name} is amiss")
    kind, length = arrays["scenario.kind"], arrays["route.length"]
    each = (kind >= 0).sum(axis=1)
    counts = {str(name): int((kind == i).sum()) for i, name in enumerate(arrays["kinds"])}
    return {
        **dataclasses.asdict(made),
        "km": round(float(length.sum()) / 1000.0, 1),
        "scenarios": int(each.sum()),
        "scenarios on a route": f"{each.min()} to {each.max()}",
        **counts,
    }
