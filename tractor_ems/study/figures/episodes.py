"""Ours, beside the paper: after how many episodes each agent converged."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from tractor_ems.study.convergence import RowConvergence
from tractor_ems.study.figures.style import BLUE, VERMILION, look, new_figure, thousands
from tractor_ems.study.paper_values import CONVERGENCE, episodes_of
from tractor_ems.study.results import StudyResults
from tractor_ems.study.tables.measures import (
    NOT_RUN,
    SOC_MINS,
    episodes_to_convergence,
    row_name,
    soc_min_of,
)

_IDS = ("q", "double_q", *(item.id for item in CONVERGENCE))
_PAPER_Y, _SEEDS_Y, _SEED_STEP = -0.3, 0.13, 0.075
"""Beside the line of a row: the paper above it, one lane for each of up to five seeds below."""


def build_convergence(results: StudyResults) -> Figure:
    """Episodes until convergence: seeds, interquartile mean with interval, the paper's value."""
    keys = [
        f"{row_id}@{soc_min:g}"
        for row_id in _IDS
        for soc_min in (SOC_MINS if row_id.startswith("ddqn_shaped") else SOC_MINS[:1])
    ]
    with look():
        figure = new_figure(0.5 * len(keys) + 1.7)
        axes = figure.add_subplot()
        axes.set(xscale="log", xlabel="training episodes until convergence [-], logarithmic")
        axes.grid(axis="x", which="major")
        axes.tick_params(axis="y", length=0)
        axes.set_yticks(range(len(keys)), [_tick(key) for key in keys])
        axes.set_ylabel("row, SOC_min [%]")
        axes.set_ylim(len(keys) - 0.4, -0.6)
        for place, key in enumerate(keys):
            if place:
                axes.axhline(place - 0.5, color="#d0d0d0", linewidth=0.6)
            paper = episodes_of(key.split("@")[0])
            if paper is not None:
                axes.plot([paper], [place + _PAPER_Y], "D", color=VERMILION, markersize=6)
            row = episodes_to_convergence(results.of(key))
            text = NOT_RUN if row is None else _text(row)
            axes.text(
                1.02, place, text, transform=axes.get_yaxis_transform(), va="center", fontsize=9.5
            )
            if row is not None:
                _draw(axes, place, row)
        _scale(axes)
        figure.legend(handles=_legend(), loc="outside upper center", ncols=3)
    return figure


def _draw(axes: Axes, y: float, row: RowConvergence) -> None:
    """Interval and its value, or a triangle where that value is a lower bound; seeds below."""
    interval = row.episodes
    if not row.lower_bound:
        axes.plot(
            [max(interval.low, 1), max(interval.high, 1)], [y] * 2, color=BLUE, linewidth=6,
            alpha=0.4, solid_capstyle="butt",
        )  # fmt: skip
    axes.plot([max(interval.value, 1)], [y], ">" if row.lower_bound else "o", color=BLUE,
              markersize=7)  # fmt: skip
    for seed, run in enumerate(row.runs):
        censored = run.episodes is None
        axes.plot(
            [max(run.at_least, 1)], [y + _SEEDS_Y + _SEED_STEP * (seed % 5)],
            ">" if censored else "o", markeredgecolor=BLUE, markeredgewidth=0.8,
            markerfacecolor="white" if censored else BLUE, markersize=3.4,
        )  # fmt: skip


def _text(row: RowConvergence) -> str:
    """As in the tables, broken before what stands in brackets."""
    return row.text.replace(" (", "\n(", 1)


def _scale(axes: Axes) -> None:
    low, high = axes.get_xlim()
    axes.set_xlim(max(low, 0.7), max(high, 60_000))
    left, right = axes.get_xlim()
    # Labels at every 1 and 3 run into each other over more than some two decades.
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0) if right < 400 * left else (1.0,)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: thousands(value)))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _legend() -> list[Line2D]:
    def item(marker: str, size: float, label: str, edge: str, face: str = "") -> Line2D:
        return Line2D(
            [], [], marker=marker, linestyle="", markersize=size, label=label,
            markeredgecolor=edge, markerfacecolor=face or edge,
        )  # fmt: skip

    return [
        item("D", 6, "paper", VERMILION),
        item("o", 7, "here, interquartile mean", BLUE),
        item(">", 7, "here, more than this", BLUE),
        Line2D([], [], color=BLUE, linewidth=6, alpha=0.4, label="95 % interval",
               solid_capstyle="butt"),
        item("o", 3.4, "one seed", BLUE),
        item(">", 3.4, "one seed, not converged", BLUE, "white"),
    ]  # fmt: skip


def _tick(key: str) -> str:
    return f"{row_name(key)}  {100 * soc_min_of(key):.1f}"
