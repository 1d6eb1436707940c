"""The scores as a table, with the columns of the paper's and all that the leaderboard counts."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.table import Table

from carljax.scores import EvalResult

# Short heads as in the paper, and which infractions they count; all per km.
RATES = {
    "Ped": ("pedestrian_collision",),
    "Veh": ("vehicle_collision",),
    "Stat": ("static_collision",),
    "Red": ("red_light",),
    "Stop": ("stop_sign",),
    "Dev": ("route_deviation", "off_road"),
    "Block": ("blocked",),
    "MS": ("min_speed",),
    "TO": ("timeout",),
    "STO": ("scenario_timeout",),
    "Yield": ("failed_to_yield",),
}
LEGEND = (
    "DS Driving Score, RC route completion, clean: RC before the first hard infraction, done:"
    " routes finished, Out: of the route outside lanes, all in %. Per km: collisions with"
    " pedestrians, vehicles, static things, red lights, stop signs, routes left (Dev), blocked,"
    " stages below the traffic's speed (MS), route timeouts (TO), scenario timeouts (STO), not"
    " yielded to an emergency vehicle. ± over drives."
)


def show(result: EvalResult, console: Console, title: str = "") -> None:
    """Prints the scores, overall and by town, and what they were lost by.

    Args:
      result: the scores.
      console: where.
      title: what was driven by whom.
    """
    towns = result.by_town()
    parts = {"all": result, **(towns if len(towns) > 1 else {})}
    means = _table(title, ("drives", "DS", "RC", "clean", "done", "Out"))
    rates = _table(f"per km, on {result.completed_km:.1f} km", tuple(RATES))
    for town, part in parts.items():
        score, completion = part.driving_score, part.completion
        means.add_row(
            town,
            str(len(part.routes)),
            f"{score[0]:.1f} ± {score[1]:.1f}",
            f"{completion[0]:.1f} ± {completion[1]:.1f}",
            f"{part.clean_completion[0]:.1f}",
            f"{100 * part.finished_frac:.0f}",
            f"{100 * part.outside_frac:.1f}",
        )
        per_km = part.infractions_per_km
        sums = (sum(per_km[name] for name in names) for names in RATES.values())
        rates.add_row(town, *(f"{value:.2f}" for value in sums))
    console.print(means, rates, LEGEND, highlight=False)
    if result.num_repetitions > 1:
        score = result.spread_of_repetitions(lambda route: route.driving_score)
        completion = result.spread_of_repetitions(lambda route: route.completion)
        console.print(
            f"over {result.num_repetitions} repetitions: DS {score[0]:.1f} ± {score[1]:.1f},"
            f" RC {completion[0]:.1f} ± {completion[1]:.1f}",
            highlight=False,
        )


def _table(title: str, columns: tuple[str, ...]) -> Table:
    """An empty table that leaves room for all columns in a terminal of 80."""
    table = Table(title=title or None, title_justify="left", box=box.SIMPLE, padding=(0, 1, 0, 0))
    for name in ("town", *columns):
        table.add_column(name, justify="left" if name == "town" else "right", no_wrap=True)
    return table
