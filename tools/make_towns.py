"""Writes the bundled towns: `python tools/make_towns.py [DIRECTORY]`.

The same files come out of every run, byte for byte. Needs `scenariogeneration` (extra `dev`).
"""

from __future__ import annotations

import pathlib
import sys

from towns import grid, highway, suburb, village, writer

BUILDERS = {
    "grid": grid.build,
    "village": village.build,
    "highway": highway.build,
    "suburb": suburb.build,
}
TARGET = pathlib.Path(__file__).resolve().parent.parent / "carljax" / "sim" / "towns"


def main(arguments: list[str]) -> int:
    """Writes every town into the given directory, by default into the package."""
    target = pathlib.Path(arguments[0]) if arguments else TARGET
    for name, build in BUILDERS.items():
        town = build()
        text = writer.to_text(town)
        path = target / f"{name}.xodr"
        path.write_bytes(text.encode())
        print(f"{path}: {len(text) / 1000:.0f} kB, {writer.length_km(town):.2f} lane km")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
