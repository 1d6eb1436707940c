"""Draws a town as people know maps: surfaces, paint, lights and signs, seen from above."""

from __future__ import annotations

import collections
import dataclasses
from typing import IO, Any

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from carljax.sim.opendrive_signals import lane_distance
from carljax.sim.road_network import MARK_BROKEN, Governed, Lane, RoadNetwork

BACKGROUND = "#e9ede2"
# Lane types from bottom to top, with their colour and name in the legend. Other types aren't drawn.
SURFACES = {
    "sidewalk": ("#cdc8bd", "sidewalk"),
    "median": ("#c4d3b0", "median"),
    "border": ("#a3a6a3", "shoulder"),
    "shoulder": ("#a3a6a3", "shoulder"),
    "biking": ("#b98277", "bicycle lane"),
    "parking": ("#7d8ca3", "parking"),
    "bidirectional": ("#6d7178", "other lanes"),
    "restricted": ("#8d8f92", "other lanes"),
    "driving": ("#585c63", "road"),
}
JUNCTION = "#63676e"
PAINT = {
    "white": "#f6f6f3",
    "yellow": "#f3c540",
    "blue": "#6fa0e0",
    "red": "#d95b4b",
    "orange": "#ef9a3c",
}
ARROW = "#8b9098"
# metres: paint, stop line, dash and gap of broken lines, level of overpasses, way between arrows
MARK_WIDTH, STOP_WIDTH, DASH, GAP, LEVEL, ARROW_STEP = 0.18, 0.55, 3.0, 4.5, 4.0, 45.0
DPI = 100
MARGIN = 0.03


@dataclasses.dataclass(frozen=True)
class Sheet:
    """An axes in metres with its scale.

    Attributes:
      ax: matplotlib's axes.
      points_per_metre: for line widths.
    """

    ax: Axes
    points_per_metre: float

    def width(self, metres: float, least: float = 0.35) -> float:
        """A line width in points, thick enough to see."""
        return max(metres * self.points_per_metre, least)


def outline(lane: Lane) -> np.ndarray:
    """(2 P, 2) polygon of a lane's surface, m."""
    normal = np.stack([-np.sin(lane.yaw), np.cos(lane.yaw)], axis=-1)
    half = normal * (lane.width / 2)[:, None]
    centre = lane.xyz[:, :2]
    return np.concatenate([centre + half, (centre - half)[::-1]])


def _level(z: float) -> int:
    return int(np.floor(z / LEVEL))


def _surfaces(sheet: Sheet, lanes: list[Lane], z_order: float) -> None:
    order = list(SURFACES)
    shapes, colours = [], []
    for lane in sorted(lanes, key=lambda x: order.index(x.kind)):
        shapes.append(outline(lane))
        in_junction = lane.kind == "driving" and lane.junction is not None
        colours.append(JUNCTION if in_junction else SURFACES[lane.kind][0])
    # The edge in the same colour hides the seams between neighbours.
    sheet.ax.add_collection(
        PolyCollection(
            shapes, facecolors=colours, edgecolors=colours, linewidths=0.4, zorder=z_order
        )
    )


def _dashes(xy: np.ndarray) -> list[np.ndarray]:
    """A line cut into dashes."""
    step = np.hypot(*np.diff(xy, axis=0).T)
    s = np.concatenate([[0.0], np.cumsum(step)])
    out = []
    for start in np.arange(0.0, s[-1], DASH + GAP):
        end = min(start + DASH, s[-1])
        inside = s[(s > start) & (s < end)]
        at = np.concatenate([[start], inside, [end]])
        out.append(np.column_stack([np.interp(at, s, xy[:, i]) for i in (0, 1)]))
    return out


def _paint(sheet: Sheet, network: RoadNetwork, z_order: dict[int, float]) -> None:
    lines: dict[tuple[float, str], list[np.ndarray]] = collections.defaultdict(list)
    for mark in network.marks:
        z = _level(float(np.median(mark.z))) if len(mark.z) else 0
        shapes = _dashes(mark.xy) if mark.kind == MARK_BROKEN else [mark.xy]
        lines[z_order.get(z, 1.0), PAINT.get(mark.colour, PAINT["white"])] += shapes
    for (order, colour), shapes in lines.items():
        sheet.ax.add_collection(
            LineCollection(
                shapes, colors=colour, linewidths=sheet.width(MARK_WIDTH), zorder=order + 0.5,
                capstyle="butt",
            )
        )  # fmt: skip


def _arrows(sheet: Sheet, lanes: list[Lane]) -> None:
    """Chevrons along the lanes outside junctions."""
    shapes = []
    for lane in lanes:
        s = lane_distance(lane)
        if lane.junction is not None or s[-1] < 12.0:
            continue
        count = max(int(s[-1] // ARROW_STEP), 1)
        for at in (np.arange(count) + 0.5) * s[-1] / count:
            x, y = (np.interp(at, s, lane.xyz[:, i]) for i in (0, 1))
            yaw = np.interp(at, s, np.unwrap(lane.yaw))
            c, n = np.cos(yaw), np.sin(yaw)
            tip = np.array([[-1.2, 0.8], [0.8, 0.0], [-1.2, -0.8]])
            shapes.append(tip @ np.array([[c, n], [-n, c]]) + (x, y))
    sheet.ax.add_collection(
        LineCollection(shapes, colors=ARROW, linewidths=sheet.width(0.22), zorder=900.0)
    )


def _crosswalk_stripes(polygon: np.ndarray) -> list[np.ndarray]:
    """A zebra: stripes along the crossing's shorter side, within a box around it turned with it."""
    xy = polygon[:, :2]
    edges = np.roll(xy, -1, axis=0) - xy
    size = np.hypot(*edges.T)
    along = edges[size.argmax()] / size.max()
    across = np.array([-along[1], along[0]])
    u, v = xy @ along, xy @ across
    out = []
    for start in np.arange(u.min() + 0.25, u.max() - 0.5, 1.0):
        box = [(start, v.min()), (start + 0.5, v.min()), (start + 0.5, v.max()), (start, v.max())]
        out.append(np.array([a * along + b * across for a, b in box]))
    return out


def _crosswalks(sheet: Sheet, network: RoadNetwork) -> None:
    from matplotlib.path import Path

    for polygon in network.crosswalks:
        stripes = PolyCollection(
            _crosswalk_stripes(polygon), facecolors=PAINT["white"], edgecolors="none", zorder=901.0,
            alpha=0.9,
        )  # fmt: skip
        sheet.ax.add_collection(stripes)
        closed = np.concatenate([polygon[:, :2], polygon[:1, :2]])
        stripes.set_clip_path(Path(closed), sheet.ax.transData)


def _place(network: RoadNetwork, at: Governed) -> tuple[np.ndarray, float, float]:
    """Position (2,), heading and lane width at a governed place."""
    lane = network.lanes[at.lane]
    s = lane_distance(lane)
    xy = np.array([np.interp(at.distance, s, lane.xyz[:, i]) for i in (0, 1)])
    yaw = float(np.interp(at.distance, s, np.unwrap(lane.yaw)))
    return xy, yaw, float(np.interp(at.distance, s, lane.width))


SIGNS = {
    "light": ("o", "#e5322d", "traffic light"),
    "stop": ("8", "#c1121f", "stop"),
    "yield": ("v", "#ffffff", "yield"),
    "speed": ("o", "#ffffff", "speed limit"),
}


def _signals(sheet: Sheet, network: RoadNetwork) -> list[Line2D]:
    """Posts and the bars where they hold; returns what the legend needs."""
    bars = []
    for signal in network.signals:
        for at in signal.governed if signal.kind in ("light", "stop", "yield") else ():
            xy, yaw, width = _place(network, at)
            side = np.array([-np.sin(yaw), np.cos(yaw)]) * width * 0.42
            bars.append((signal.kind, np.stack([xy + side, xy - side])))
    for kind, colour in (("light", "#e5322d"), ("stop", "#c1121f"), ("yield", "#f0f0f0")):
        shapes = [bar for name, bar in bars if name == kind]
        sheet.ax.add_collection(
            LineCollection(
                shapes, colors=colour, linewidths=sheet.width(0.3, 0.8), zorder=902.0, alpha=0.9
            )
        )
    handles = []
    size = float(np.clip(sheet.points_per_metre * 2.6, 4.0, 11.0))
    for kind, (marker, face, name) in SIGNS.items():
        xy = np.array([s.xyz[:2] for s in network.signals if s.kind == kind]).reshape(-1, 2)
        if not len(xy):
            continue
        edge = "#20242a" if kind == "light" else "#c1121f" if kind != "stop" else "#ffffff"
        style: dict[str, Any] = {
            "marker": marker,
            "markerfacecolor": face,
            "markeredgecolor": edge,
            "linestyle": "",
        }
        sheet.ax.plot(
            xy[:, 0], xy[:, 1], markersize=size, markeredgewidth=0.16 * size, zorder=903.0, **style
        )
        handles.append(Line2D([], [], markersize=9, markeredgewidth=1.4, label=name, **style))
    for signal in network.signals:
        if signal.kind == "speed" and signal.value is not None:
            sheet.ax.text(
                signal.xyz[0], signal.xyz[1], f"{signal.value * 3.6:.0f}", fontsize=size * 0.42,
                zorder=904.0, ha="center", va="center_baseline", color="#20242a", clip_on=True,
            )  # fmt: skip
    return handles


def _scale_bar(ax: Axes, low: np.ndarray, size: np.ndarray) -> None:
    """A bar of a round length in the lower left."""
    goal = 0.15 * size.max()
    exponent = 10.0 ** np.floor(np.log10(goal))
    length = max(m * exponent for m in (1, 2, 5) if m * exponent <= goal)
    x, y = low + 0.015 * size.max()
    ax.plot([x, x, x + length, x + length], [y + 0.006 * size.max(), y, y, y + 0.006 * size.max()],
            color="#20242a", linewidth=1.6, zorder=950.0)  # fmt: skip
    ax.text(x + length / 2, y + 0.008 * size.max(), f"{length:g} m", ha="center", va="bottom",
            fontsize=11, color="#20242a", zorder=950.0)  # fmt: skip


def _legend(ax: Axes, network: RoadNetwork, signs: list[Line2D]) -> None:
    kinds = {lane.kind for lane in network.lanes}
    names = {SURFACES[k][1]: SURFACES[k][0] for k in reversed(SURFACES) if k in kinds}
    handles: list = [Patch(facecolor=colour, label=name) for name, colour in names.items()]
    ax.legend(
        handles=handles + signs, loc="upper left", bbox_to_anchor=(0.0, -0.005), fontsize=12,
        ncols=9, frameon=False, handlelength=1.3, columnspacing=1.4, borderaxespad=0.2,
    )  # fmt: skip


def figure(network: RoadNetwork, pixels: int = 2400) -> Figure:
    """The town as a matplotlib figure whose longer side is `pixels` long."""
    drawn = [lane for lane in network.lanes if lane.kind in SURFACES]
    points = np.concatenate([outline(lane) for lane in drawn])
    low, high = points.min(axis=0), points.max(axis=0)
    pad = max(8.0, MARGIN * float((high - low).max()))
    low, high = low - pad, high + pad
    size = high - low
    # Neither side below a third of the other, so that the texts fit.
    grow = np.maximum(size.max() / 3.0 - size, 0.0) / 2
    low, size = low - grow, size + 2 * grow
    head, foot = 0.45, 0.45  # inches for title and legend
    inches = size / size.max() * pixels / DPI
    fig = Figure(figsize=(inches[0], inches[1] + head + foot), dpi=DPI, facecolor="white")
    total = inches[1] + head + foot
    ax = fig.add_axes((0.0, foot / total, 1.0, inches[1] / total), facecolor=BACKGROUND)
    ax.set(xlim=(low[0], low[0] + size[0]), ylim=(low[1], low[1] + size[1]), xticks=[], yticks=[])
    for spine in ax.spines.values():
        spine.set_visible(False)
    sheet = Sheet(ax, float(inches[0] * 72.0 / size[0]))
    levels = collections.defaultdict(list)
    for lane in drawn:
        levels[_level(float(np.median(lane.xyz[:, 2])))].append(lane)
    z_order = {level: 1.0 + i for i, level in enumerate(sorted(levels))}
    for level, lanes in levels.items():
        _surfaces(sheet, lanes, z_order[level])
    _paint(sheet, network, z_order)
    _arrows(sheet, [lane for lane in drawn if lane.kind == "driving"])
    _crosswalks(sheet, network)
    ax.add_collection(
        LineCollection(
            [line[:, :2] for line in network.stop_lines], colors=PAINT["white"],
            linewidths=sheet.width(STOP_WIDTH, 0.8), zorder=901.5,
        )
    )  # fmt: skip
    _legend(ax, network, _signals(sheet, network))
    _scale_bar(ax, low, size)
    length = sum(float(lane_distance(x)[-1]) for x in drawn if x.kind == "driving") / 1000
    title = f"{network.name}   {length:.1f} km of lanes, {len(network.junctions)} junctions"
    fig.text(0.008, 1 - 0.5 * head / total, title, fontsize=15, va="center", color="#20242a")
    return fig


def save(network: RoadNetwork, file: IO[bytes], suffix: str, pixels: int = 2400) -> None:
    """Writes the picture of a town.

    Args:
      network: as read.
      file: open for writing.
      suffix: "png", "jpg", "pdf" or "svg".
      pixels: longer side.
    """
    figure(network, pixels).savefig(file, format=suffix, dpi=DPI)
