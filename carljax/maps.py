"""Looks at a town: `python -m carljax.maps info|draw|lanes FILE.xodr`.

FILE is an OpenDRIVE file or the name of a bundled town. A file that can't be read ends with one
line on stderr and exit status 2, and nothing is written.
"""

from __future__ import annotations

import collections
import dataclasses
import json
import os
import pathlib
import sys
import tempfile
from collections.abc import Callable, Sequence
from typing import IO, Annotated

import numpy as np
import tyro

from carljax.sim import opendrive, towns
from carljax.sim.opendrive_signals import lane_distance
from carljax.sim.road_network import Lane, MapError, RoadNetwork

File = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
PICTURE_SUFFIXES = (".png", ".jpg", ".pdf", ".svg")


@dataclasses.dataclass(frozen=True)
class Info:
    """Print what is in a town.

    Attributes:
      file: an OpenDRIVE file, or the name of a bundled town.
      json: print JSON instead of a table.
    """

    file: File
    json: bool = False


@dataclasses.dataclass(frozen=True)
class Draw:
    """Draw a town.

    Attributes:
      file: an OpenDRIVE file, or the name of a bundled town.
      out: the picture (.png, .jpg, .pdf or .svg); the town's name with .png if not given.
      pixels: the longer side of the picture.
    """

    file: File
    out: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[OUT.png]")] = None
    pixels: int = 2400


@dataclasses.dataclass(frozen=True)
class Lanes:
    """Write the driving lanes of a town as NumPy arrays.

    lane_xy (N,2) m, lane_ptr (L+1), lane_width (N) m, lane_z (N) m, lane_key (L,3) = road id,
    section, lane id, succ (E,2) lane i leads to lane j, is_junction (L), speed_limit (L) m/s or
    nan, crosswalk_xy with crosswalk_ptr, signal_id, signal_kind. Right-handed metres.

    Attributes:
      file: an OpenDRIVE file, or the name of a bundled town.
      out: the .npz file.
    """

    file: File
    out: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="OUT.npz")]


def read(file: str) -> RoadNetwork:
    """Reads an OpenDRIVE file or a bundled town by name, and prints its warnings to stderr.

    Raises:
      MapError: can't be read.
    """
    bundled = file in towns.names() and not pathlib.Path(file).exists()
    network = opendrive.load(towns.path(file) if bundled else file)
    for line in network.warnings:
        print(f"{file}: warning: {line}", file=sys.stderr)
    return network


def driving(network: RoadNetwork) -> tuple[list[Lane], dict[int, int]]:
    """The driving lanes, and their new indices by those in the network."""
    kept = [i for i, lane in enumerate(network.lanes) if lane.kind == "driving"]
    return [network.lanes[i] for i in kept], {old: new for new, old in enumerate(kept)}


def counts(network: RoadNetwork) -> dict[str, object]:
    """What `info` prints: numbers, km, ranges."""
    lanes, _ = driving(network)
    length = np.array([lane_distance(lane)[-1] for lane in lanes])
    inside = np.array([lane.junction is not None for lane in lanes])
    width = np.concatenate([lane.width for lane in lanes])
    xyz = np.concatenate([lane.xyz for lane in lanes])
    kinds = collections.Counter(signal.kind for signal in network.signals)
    limits = sorted({round(x.speed_limit * 3.6) for x in lanes if x.speed_limit is not None})
    return {
        "name": network.name,
        "traffic": "left-hand" if network.left_hand_traffic else "right-hand",
        "roads": len({lane.road_id for lane in network.lanes}),
        "driving lanes": len(lanes),
        "of them in junctions": int(inside.sum()),
        "lane km": round(float(length.sum()) / 1000, 2),
        "of them outside junctions": round(float(length[~inside].sum()) / 1000, 2),
        "lane links": sum(len(lane.successors) for lane in lanes),
        "junctions": len(network.junctions),
        "traffic lights": kinds["light"],
        "light controllers": len(network.controllers),
        "stop signs": kinds["stop"],
        "yield signs": kinds["yield"],
        "speed signs": kinds["speed"],
        "other signals": kinds["other"],
        "crosswalks": len(network.crosswalks),
        "stop lines": len(network.stop_lines),
        "speed limits km/h": limits,
        "lane width m": [round(float(f(width)), 2) for f in (np.min, np.median, np.max)],
        "x m": [round(float(f(xyz[:, 0])), 1) for f in (np.min, np.max)],
        "y m": [round(float(f(xyz[:, 1])), 1) for f in (np.min, np.max)],
        "z m": [round(float(f(xyz[:, 2])), 1) for f in (np.min, np.max)],
        "warnings": len(network.warnings),
    }


_RANGES = {
    "lane width m": "{}, median {}, to {}",
    "x m": "{} to {}",
    "y m": "{} to {}",
    "z m": "{} to {}",
}


def table(values: dict[str, object]) -> str:
    """The counts as aligned lines."""
    lines = []
    for name, value in values.items():
        if isinstance(value, list):
            value = _RANGES.get(name, ", ".join(["{}"] * len(value)) or "none given").format(*value)
        lines.append(f"{name:<26} {value}")
    return "\n".join(lines)


def _road_numbers(lanes: Sequence[Lane]) -> dict[str, int]:
    """Road ids as integers: their own where all are, else -1, -2, ... for those that aren't."""
    ids = dict.fromkeys(lane.road_id for lane in lanes)
    whole = {i: int(i) for i in ids if i.isascii() and i.isdecimal() and int(i) < 2**63}
    others = (i for i in ids if i not in whole)
    return whole | {name: -1 - k for k, name in enumerate(others)}


def lane_arrays(network: RoadNetwork) -> dict[str, np.ndarray]:
    """The arrays that `lanes` writes; see `Lanes`."""
    lanes, index = driving(network)
    road = _road_numbers(lanes)
    succ = [(i, index[j]) for i, lane in enumerate(lanes) for j in lane.successors]
    walks = [np.zeros((0, 3)), *network.crosswalks]
    limits = [np.nan if x.speed_limit is None else x.speed_limit for x in lanes]
    return {
        "lane_xy": np.concatenate([lane.xyz[:, :2] for lane in lanes]),
        "lane_z": np.concatenate([lane.xyz[:, 2] for lane in lanes]),
        "lane_ptr": np.cumsum([0, *(len(lane.xyz) for lane in lanes)]),
        "lane_width": np.concatenate([lane.width for lane in lanes]),
        "lane_key": np.array([(road[x.road_id], x.section, x.lane_id) for x in lanes], np.int64),
        "road_id": np.array([lane.road_id for lane in lanes]),
        "succ": np.array(succ, np.int64).reshape(-1, 2),
        "is_junction": np.array([lane.junction is not None for lane in lanes]),
        "speed_limit": np.array(limits),
        "crosswalk_xy": np.concatenate(walks)[:, :2],
        "crosswalk_ptr": np.cumsum([len(walk) for walk in walks]),
        "signal_id": np.array([signal.id for signal in network.signals], str),
        "signal_kind": np.array([signal.kind for signal in network.signals], str),
    }


def write_whole(out: str, source: str, write: Callable[[IO[bytes]], None]) -> None:
    """Writes a file all at once: beside it first, then in its place.

    Raises:
      MapError: it can't be written, or is the file read from.
    """
    target = pathlib.Path(out)
    if target.exists() and pathlib.Path(source).exists() and target.samefile(source):
        raise MapError(f"{out}: is the file to read, won't overwrite it")
    temporary = None
    try:
        with tempfile.NamedTemporaryFile(
            dir=target.parent, prefix=f".{target.name}.", delete=False
        ) as f:
            temporary = f.name
            write(f)
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(temporary, 0o666 & ~mask)  # as if opened plainly; temporary files are private
        os.replace(temporary, target)
    except OSError as e:
        raise MapError(f"{out}: can't be written: {e.strerror or e}") from None
    finally:
        if temporary is not None:
            pathlib.Path(temporary).unlink(missing_ok=True)


def _draw(command: Draw) -> None:
    from carljax import map_drawing  # matplotlib is slow to import, and only needed here

    stem = pathlib.Path(command.file).stem
    out = command.out or f"{stem}.png"
    suffix = pathlib.Path(out).suffix.lower()
    if suffix not in PICTURE_SUFFIXES:
        raise MapError(f"{out}: is no picture's name; it must end in {', '.join(PICTURE_SUFFIXES)}")
    if not 100 <= command.pixels <= 20000:
        raise MapError(f"--pixels {command.pixels}: must be from 100 to 20000")
    network = read(command.file)
    write_whole(
        out, command.file, lambda f: map_drawing.save(network, f, suffix[1:], command.pixels)
    )
    print(out)


def main(args: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    command = tyro.cli(
        Info | Draw | Lanes,
        prog="python -m carljax.maps",
        description=__doc__.splitlines()[0],
        args=args,
    )
    try:
        if isinstance(command, Info):
            values = counts(read(command.file))
            print(json.dumps(values) if command.json else table(values))
        elif isinstance(command, Draw):
            _draw(command)
        else:
            arrays = lane_arrays(read(command.file))
            write_whole(
                command.out,
                command.file,
                lambda f: np.savez_compressed(f, **arrays),  # type: ignore[arg-type]
            )
            print(command.out)
    except MapError as e:
        print(e, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
