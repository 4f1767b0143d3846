"""Ours, beside the paper: what each reward's true optimum is, when each agent converged, and what
each single change does."""

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from tractor_ems.learning.rewards import RewardKind
from tractor_ems.study.figures.style import (
    BLUE,
    GREY,
    ORANGE,
    VERMILION,
    look,
    new_figure,
    percent,
    say_not_run,
    thousands,
)
from tractor_ems.study.paper_values import CONVERGENCE, SUMMARY, episodes_of
from tractor_ems.study.results import Outcome, StudyResults
from tractor_ems.study.tables.measures import (
    ABLATIONS,
    NOT_RUN,
    SOC_MINS,
    episodes_to_convergence,
    find_baseline,
    fuel_gal,
    measure,
    row_name,
    soc_min_of,
)

_REWARDS: Sequence[tuple[RewardKind, str]] = (
    ("fuel", "fuel reward"),
    ("piecewise", "shaped reward,\nas printed"),
    ("piecewise_corrected", "shaped reward,\ncorrected"),
)


def build_optimum(results: StudyResults) -> Figure:
    """Fuel and final SOC of each reward's exact optimum, by SOC_min, with the paper's rows."""
    found = {
        (reward, soc_min): item.outcome
        for reward, _ in _REWARDS
        for soc_min in SOC_MINS
        if (item := find_baseline(results, "optimum", reward, soc_min)) is not None
    }
    with look():
        figure = new_figure(6.6)
        fuel_axes, soc_axes = figure.subplots(2, 1, sharex=True)
        fuel_axes.set(ylabel="fuel [gal]", title="Exact DP on each reward: its true optimum")
        soc_axes.set(ylabel="SOC [%], start to end")
        soc_axes.set_xticks(range(len(_REWARDS)), [name for _, name in _REWARDS])
        soc_axes.set_xlim(-0.5, len(_REWARDS) - 0.5)
        for axes in (fuel_axes, soc_axes):
            axes.grid(axis="y")
        if not found:
            for axes in (fuel_axes, soc_axes):
                say_not_run(axes, "exact optimum")
            return figure
        for side, (soc_min, colour) in enumerate(zip(SOC_MINS, (BLUE, ORANGE), strict=True)):
            for place, (reward, _) in enumerate(_REWARDS):
                outcome = found.get((reward, soc_min))
                if outcome is not None:
                    _optimum_bars(
                        fuel_axes, soc_axes, place + (side - 0.5) * 0.36, outcome, colour
                    )
            fuel_axes.bar([0], [0], color=colour, label=f"SOC_min {percent(soc_min)}")
        styles = {"ddqn": ":", "ddqn_shaped": "--", "dp": "-."}
        for row in SUMMARY:
            if row.id in styles:
                fuel_axes.axhline(
                    row.fuel_gal, color=VERMILION, linestyle=styles[row.id], linewidth=1.4,
                    label=f"paper, {_PAPER_NAMES[row.id]}: {row.fuel_gal:.2f} gal",
                )  # fmt: skip
        for row in SUMMARY:
            if row.id in ("ddqn", "ddqn_shaped") and row.soc_final is not None:
                soc_axes.axhline(
                    row.soc_final * 100, color=VERMILION, linestyle=styles[row.id], linewidth=1.4,
                    label=f"paper, {_PAPER_NAMES[row.id]}: {percent(row.soc_final)}",
                )  # fmt: skip
        fuel_axes.margins(y=0.14)
        lowest = min(100 * outcome.soc_final for outcome in found.values())
        start = max(100 * outcome.soc_initial for outcome in found.values())
        soc_axes.set_ylim(min(lowest, 70.0) - 2.5, start + 1.0)
        for axes in (fuel_axes, soc_axes):
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.3)
    return figure


_LABEL_BOX = {"boxstyle": "round,pad=0.1", "facecolor": "white", "linewidth": 0, "alpha": 0.85}
_PAPER_NAMES = {"ddqn": "DDQN", "ddqn_shaped": "shaped DDQN", "dp": "DP"}


def _optimum_bars(
    fuel_axes: Axes, soc_axes: Axes, place: float, outcome: Outcome, colour: str
) -> None:
    fuel = fuel_gal(outcome)
    fuel_axes.bar([place], [fuel], width=0.32, color=colour, alpha=0.85)
    fuel_axes.annotate(
        f"{fuel:.2f}", (place, fuel), xytext=(0, 4), textcoords="offset points", ha="center",
        bbox=_LABEL_BOX,
    )  # fmt: skip
    start, end = 100 * outcome.soc_initial, 100 * outcome.soc_final
    soc_axes.bar([place], [start - end], bottom=end, width=0.32, color=colour, alpha=0.85)
    soc_axes.annotate(
        f"{end:.1f}", (place, min(start, end)), xytext=(0, -3), textcoords="offset points",
        ha="center", va="top", bbox=_LABEL_BOX,
    )  # fmt: skip


def build_convergence(results: StudyResults) -> Figure:
    """Episodes until convergence: seeds, interquartile mean with interval, the paper's value."""
    keys = [
        f"{item.id}@{soc_min:g}"
        for item in CONVERGENCE
        for soc_min in (SOC_MINS if item.id.startswith("ddqn_shaped") else SOC_MINS[:1])
    ]
    with look():
        figure = new_figure(0.42 * len(keys) + 1.7)
        axes = figure.add_subplot()
        axes.set(xscale="log", xlabel="training episodes until convergence [-], logarithmic")
        axes.grid(axis="x", which="both")
        axes.set_yticks(
            range(len(keys)),
            [_tick(key) for key in keys],
        )
        axes.set_ylabel("row, SOC_min [%]")
        axes.set_ylim(len(keys) - 0.5, -0.5)
        for place, key in enumerate(keys):
            paper = episodes_of(key.split("@")[0])
            assert paper is not None  # the keys are those of CONVERGENCE
            axes.plot([paper], [place - 0.27], "D", color=VERMILION, markersize=7, zorder=4)
            row = episodes_to_convergence(results.of(key))
            text = NOT_RUN if row is None else row.text.replace(" (", "\n(", 1)
            axes.text(
                1.02, place, text, transform=axes.get_yaxis_transform(), va="center", fontsize=9.5
            )
            if row is None:
                continue
            for run in row.runs:
                axes.plot(
                    [max(run.at_least, 1)], [place + 0.25],
                    ">" if run.episodes is None else "o", color=BLUE, alpha=0.5, markersize=4.5,
                )  # fmt: skip
            interval = row.episodes
            axes.plot(
                [max(interval.low, 1), max(interval.high, 1)], [place] * 2, color=BLUE, linewidth=3
            )
            axes.plot(
                [max(interval.value, 1)], [place], ">" if row.lower_bound else "o", color=BLUE,
                markersize=8,
            )  # fmt: skip
        for marker, size, colour, alpha, label in (
            ("D", 7, VERMILION, 1.0, "paper"),
            ("o", 8, BLUE, 1.0, "here, IQM, 95 %"),
            (">", 8, BLUE, 1.0, "more than (budget)"),
            ("o", 4.5, BLUE, 0.5, "one seed"),
        ):
            axes.plot([], [], marker, color=colour, markersize=size, alpha=alpha, label=label)
        low, high = axes.get_xlim()
        axes.set_xlim(max(low, 0.7), max(high, 60_000))
        left, right = axes.get_xlim()
        # Labels at every 1 and 3 run into each other over more than some two decades.
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0) if right < 400 * left else (1.0,)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: thousands(value)))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.legend(
            loc="lower center", bbox_to_anchor=(0.4, 1.0), ncols=4, columnspacing=1.0,
            handletextpad=0.2,
        )  # fmt: skip
    return figure


def build_ablations(results: StudyResults) -> Figure:
    """Matched-SOC dp_ratio, final SOC and fuel of the rows that change one thing."""
    lines = [
        (key, place == 0)
        for base, changed in ABLATIONS
        for place, key in enumerate((base, *changed))
    ]
    starts = np.cumsum([1 + len(changed) for _, changed in ABLATIONS])[:-1]
    panels: Sequence[tuple[str, Callable[[Outcome], float | None]]] = (
        ("dp_ratio [-]", lambda outcome: outcome.dp_ratio),
        ("final SOC [%]", lambda outcome: 100.0 * outcome.soc_final),
        ("fuel [gal]", fuel_gal),
    )
    with look():
        figure = new_figure(0.36 * len(lines) + 1.5)
        axes_row = figure.subplots(1, 3, sharey=True)
        for axes, (label, get) in zip(axes_row, panels, strict=True):
            axes.set_xlabel(label)
            axes.grid(axis="x")
            for place in starts:
                axes.axhline(place - 0.5, color=GREY, linewidth=0.8)
            for place, (key, base) in enumerate(lines):
                found = measure(results.of(key), get)
                colour = GREY if base else BLUE
                if found is None:
                    text = NOT_RUN if not results.of(key) else "none"
                    axes.text(0.5, place, text, transform=axes.get_yaxis_transform(),
                              ha="center", va="center", fontsize=9.5, color=GREY,
                              bbox=_LABEL_BOX)  # fmt: skip
                    continue
                axes.plot(found.values, [place] * len(found.values), "o", color=colour,
                          alpha=0.4, markersize=4)  # fmt: skip
                interval = found.interval
                axes.plot([interval.low, interval.high], [place] * 2, color=colour, linewidth=2.5)
                axes.plot([interval.value], [place], "s" if base else "o", color=colour,
                          markersize=7)  # fmt: skip
        first = axes_row[0]
        first.set_yticks(
            range(len(lines)),
            [_tick(key) for key, _ in lines],
        )
        first.set_ylabel("row, SOC_min [%]")
        first.set_ylim(len(lines) - 0.5, -0.5)
        for row in SUMMARY:
            if row.id in ("ddqn", "ddqn_shaped") and row.soc_final is not None:
                axes_row[1].axvline(
                    100 * row.soc_final, color=VERMILION, linestyle="--", linewidth=1
                )
                axes_row[2].axvline(row.fuel_gal, color=VERMILION, linestyle="--", linewidth=1)
        first.plot([], [], "s", color=GREY, label="row of the paper")
        first.plot([], [], "o", color=BLUE, label="one change")
        first.plot(
            [], [], "--", color=VERMILION, label="printed by the paper, without and with shaping"
        )
        handles, labels = first.get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=3)
        first.set_xlim(right=max(first.get_xlim()[1], 1.0))
    return figure


def _tick(key: str) -> str:
    return f"{row_name(key)}  {100 * soc_min_of(key):.1f}"
