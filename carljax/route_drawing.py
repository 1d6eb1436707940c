"""Draws a route and its scenarios over the map of their town."""

from __future__ import annotations

from typing import IO

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from carljax import map_drawing
from carljax.sim.journey import Journey
from carljax.sim.scenarios import registry
from carljax.sim.scenarios.script import Scenario
from carljax.sim.town import Town
from carljax.sim.types import KIND_NONE

SUFFIXES = (".png", ".jpg", ".pdf", ".svg")
ROUTE = "#2f6fdf"
# One for each kind, in order of `registry.KINDS`, repeating.
KIND_COLOURS = ("#e07b00", "#c1121f", "#8a3fc0", "#0a7d5a", "#b5179e", "#007f9e", "#7a5c00")
ABOVE = 960.0  # zorder, over everything of the map


def save(
    town: Town, journey: Journey, title: str, file: IO[bytes], suffix: str, pixels: int = 2400
) -> None:
    """Writes the picture of a route.

    Args:
      town: where it is.
      journey: the route, and scenarios whose lanes are the town's own rows or shared ones.
      title: of the picture.
      file: open for writing.
      suffix: "png", "jpg", "pdf" or "svg".
      pixels: longer side.
    """
    figure = map_drawing.figure(town.network, pixels)
    axes = figure.axes[0]
    route = journey.route
    num = int(route.num_points)
    xy = np.asarray(route.xy[:num], float)
    axes.plot(xy[:, 0], xy[:, 1], color=ROUTE, linewidth=3.0, alpha=0.75, zorder=ABOVE)
    axes.plot(*xy[0], "o", color=ROUTE, markersize=11, zorder=ABOVE + 1)
    axes.plot(*xy[-1], "s", color=ROUTE, markersize=11, zorder=ABOVE + 1)
    for number, scenario in enumerate(journey.scenarios):
        _scenario(axes, journey, scenario, number)
    kinds = sorted({int(scenario.kind) for scenario in journey.scenarios})
    handles = [
        Line2D([], [], marker="D", linestyle="", color=_colour(kind), label=registry.KINDS[kind])
        for kind in kinds
    ]
    if handles:
        legend = axes.get_legend()
        axes.legend(handles=handles, loc="upper right", fontsize=12, framealpha=0.9).set_zorder(999)
        if legend is not None:
            axes.add_artist(legend)
    length = f"{float(route.length):.0f} m, {len(journey.scenarios)} scenarios"
    figure.text(0.992, 0.992, f"{title}   {length}", fontsize=15, ha="right", va="top")
    figure.savefig(file, format=suffix, dpi=map_drawing.DPI)


def _colour(kind: int) -> str:
    return KIND_COLOURS[kind % len(KIND_COLOURS)]


def _scenario(axes: Axes, journey: Journey, scenario: Scenario, number: int) -> None:
    """Its stretch of the route, its trigger and its actors off the lanes."""
    route = journey.route
    num = int(route.num_points)
    xy, s = np.asarray(route.xy[:num], float), np.asarray(route.s[:num], float)
    colour = _colour(int(scenario.kind))
    on = (s >= float(scenario.trigger_s)) & (s <= float(scenario.end_s))
    axes.plot(xy[on, 0], xy[on, 1], color=colour, linewidth=5.0, alpha=0.6, zorder=ABOVE + 2)
    at = xy[int(np.abs(s - float(scenario.trigger_s)).argmin())]
    axes.plot(*at, "D", color=colour, markersize=9, zorder=ABOVE + 3)
    axes.annotate(
        str(number), at, xytext=(7, 7), textcoords="offset points", fontsize=12, color=colour,
        zorder=ABOVE + 4,
    )  # fmt: skip
    others = np.asarray(scenario.others.kind) != KIND_NONE
    for place in np.asarray(scenario.others.xy, float)[others]:
        axes.plot(*place, "x", color=colour, markersize=7, zorder=ABOVE + 3)
