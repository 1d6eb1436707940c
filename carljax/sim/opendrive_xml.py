"""Reading OpenDRIVE's XML safely: numbers and their places, errors of one line, warnings."""

from __future__ import annotations

import dataclasses
import math
import pathlib
import xml.etree.ElementTree as ET
from xml.parsers import expat

from carljax.sim.road_network import MapError

# Larger numbers are no road: the earth's girth is 4e7 m, projected coordinates stay below 1e8.
NUMBER_MAX = 1e9
_SHOWN = 60


def shown(text: str) -> str:
    """A piece of the file fit for a one-line message: quoted, control characters escaped, cut."""
    return repr(text if len(text) <= _SHOWN else text[:_SHOWN] + "...")


def plain(text: str) -> str:
    """An id as it stands in messages, without line breaks."""
    return text if text.isprintable() and len(text) <= _SHOWN else shown(text)


@dataclasses.dataclass(frozen=True)
class Place:
    """Where in which file: "Town01.xodr: road 5, section 0, lane -1"."""

    file: str
    parts: tuple[str, ...] = ()

    def at(self, kind: str, name: object = "") -> Place:
        """The place one step further in."""
        part = f"{kind} {plain(str(name))}" if name != "" else kind
        return dataclasses.replace(self, parts=(*self.parts, part))

    def __str__(self) -> str:
        file = self.file if self.file.isprintable() else repr(self.file)
        return f"{file}: {', '.join(self.parts)}" if self.parts else file

    def error(self, reason: str) -> MapError:
        """A MapError that names this place."""
        return MapError(f"{self}: {reason}")


class Warnings:
    """Collects what was not read or looks wrong: a line per kind, with count and first place."""

    def __init__(self) -> None:
        """Starts empty."""
        self._seen: dict[str, tuple[int, Place]] = {}

    def add(self, kind: str, place: Place) -> None:
        """Counts one more of this kind."""
        count, first = self._seen.get(kind, (0, place))
        self._seen[kind] = (count + 1, first)

    def lines(self) -> tuple[str, ...]:
        """The warnings, in order of first sight."""
        out = []
        for kind, (count, place) in self._seen.items():
            where = ", ".join(place.parts)
            times = f" ({count} times; first: {where})" if count > 1 else f" ({where})"
            out.append(kind + (times if where else ""))
        return tuple(out)


def _read(path: pathlib.Path, place: Place) -> bytes:
    """The bytes of a regular file."""
    if path.exists() and not path.is_file():
        raise place.error("is a directory" if path.is_dir() else "is not a regular file")
    try:
        data = path.read_bytes()
    except (OSError, ValueError) as e:
        raise place.error(f"can't be read: {getattr(e, 'strerror', None) or e}") from None
    if not data.strip():
        raise place.error("is empty")
    return data


def parse(path: pathlib.Path, place: Place, root_tag: str = "OpenDRIVE") -> ET.Element:
    """The root element of an XML file.

    Raises:
      MapError: unreadable, not XML, another root element, or with XML entities of its own (which
        can blow a small file up to gigabytes; the files read here have no use for them).
    """
    data = _read(path, place)

    def refuse(name: str, *_: object) -> None:
        raise place.error(f"declares the XML entity {shown(name)}; {root_tag} files have none")

    scan = expat.ParserCreate()
    scan.EntityDeclHandler = refuse
    try:
        scan.Parse(data, True)
        root = ET.fromstring(data)
    except MapError:
        raise
    except (expat.ExpatError, ET.ParseError) as e:
        raise place.error(f"is not well-formed XML: {e}") from None
    except (ValueError, LookupError) as e:  # unknown encodings
        raise place.error(f"is not readable XML: {e}") from None
    for element in root.iter():  # drop the namespaces that some exporters declare
        if isinstance(element.tag, str) and element.tag.startswith("{"):
            element.tag = element.tag.partition("}")[2]
    if root.tag != root_tag:
        raise place.error(f"is not {root_tag}: the root element is {shown(str(root.tag))}")
    return root


def text(element: ET.Element, name: str, place: Place, default: str | None = None) -> str:
    """An attribute; without a default it must be there."""
    value = element.get(name, default)
    if value is None:
        raise place.error(f"<{element.tag}> has no attribute {name!r}")
    return value.strip()


def number(element: ET.Element, name: str, place: Place, default: float | None = None) -> float:
    """A finite number in an attribute; without a default it must be there."""
    raw = element.get(name)
    if raw is None or (default is not None and not raw.strip()):
        if default is None:
            raise place.error(f"<{element.tag}> has no attribute {name!r}")
        return default
    try:
        value = float(raw)
    except ValueError:
        value = math.nan
    if not abs(value) <= NUMBER_MAX:
        raise place.error(
            f"<{element.tag} {name}={shown(raw)}> is not a number to build a road with"
        )
    return value


def length(element: ET.Element, name: str, place: Place, default: float | None = None) -> float:
    """A number that must not be negative."""
    value = number(element, name, place, default)
    if value < 0.0:
        raise place.error(f"<{element.tag} {name}={shown(element.get(name, ''))}> is negative")
    return value


def lane_number(element: ET.Element, name: str, place: Place) -> int:
    """A lane id."""
    raw = text(element, name, place)
    try:
        value = int(raw)
    except ValueError:
        value = 1 << 20
    if abs(value) > 10_000:
        raise place.error(f"<{element.tag} {name}={shown(raw)}> is not a lane number")
    return value


# source: OpenDRIVE 1.8, e_unitSpeed
_SPEED_UNITS = {"m/s": 1.0, "km/h": 1.0 / 3.6, "kmh": 1.0 / 3.6, "kph": 1.0 / 3.6, "mph": 0.44704}


def speed(raw: str | None, unit: str, place: Place, warnings: Warnings) -> float | None:
    """A speed in m/s; None where there is none ("no limit", "undefined", missing, not positive)."""
    if raw is None or raw.strip() in ("", "no limit", "undefined", "none"):
        return None
    try:
        value = float(raw)
    except ValueError:
        value = math.nan
    if not abs(value) <= NUMBER_MAX:
        raise place.error(f"speed {shown(raw)} is not a number")
    if unit not in _SPEED_UNITS:
        warnings.add(f"speed unit {shown(unit)} is unknown: taken as m/s", place)
    return value * _SPEED_UNITS.get(unit, 1.0) if value > 0.0 else None
