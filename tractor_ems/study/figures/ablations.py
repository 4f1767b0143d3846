"""Ours, beside the paper: rows that vary another row, beside that row."""

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from tractor_ems.study.figures.style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    VERMILION,
    look,
    new_figure,
)
from tractor_ems.study.paper_values import SUMMARY, MethodValue
from tractor_ems.study.results import Outcome, Run, StudyResults
from tractor_ems.study.tables.measures import (
    ABLATIONS,
    NOT_RUN,
    find_baseline,
    fuel_gal,
    measure,
    row_name,
    soc_min_of,
)

_PANELS: Sequence[
    tuple[str, Callable[[Outcome], float | None], Callable[[MethodValue], float | None]]
] = (
    ("dp_ratio [-]", lambda outcome: outcome.dp_ratio, lambda row: None),
    (
        "final SOC [%]",
        lambda outcome: 100.0 * outcome.soc_final,
        lambda row: None if row.soc_final is None else 100.0 * row.soc_final,
    ),
    ("fuel [gal]", fuel_gal, lambda row: row.fuel_gal),
)
"""Label, quantity of a drive, and the same as the paper prints it."""

_REFERENCES = (("myopic", "v", ORANGE, "myopic greedy"), ("best_point", "^", GREEN, "best point"))
_ABOVE, _BELOW = -0.27, 0.25
"""References and paper, and seeds, beside the line of a row: what is equal must not hide."""


def build_ablations(results: StudyResults) -> Figure:
    """Matched-SOC dp_ratio, final SOC and fuel of rows that vary another, beside that one."""
    lines = [
        (key, place == 0)
        for base, changed in ABLATIONS
        for place, key in enumerate((base, *changed))
    ]
    starts = np.cumsum([1 + len(changed) for _, changed in ABLATIONS])[:-1]
    with look():
        figure = new_figure(0.44 * len(lines) + 1.5)
        axes_row = figure.subplots(1, len(_PANELS), sharey=True)
        for axes, (label, get, printed), ticks in zip(axes_row, _PANELS, (4, 5, 6), strict=True):
            axes.set_xlabel(label)
            axes.grid(axis="x")
            axes.tick_params(axis="y", length=0)
            axes.xaxis.set_major_locator(MaxNLocator(ticks, steps=[1, 2, 5, 10]))
            for place in starts:
                axes.axhline(place - 0.5, color=GREY, linewidth=0.8)
            for place, (key, base) in enumerate(lines):
                runs = results.of(key)
                if runs:
                    _mark_references(axes, place, results, runs[0], get)
                    _mark_paper(axes, place, key, printed)
                    _draw(axes, place, runs, get, GREY if base else BLUE)
            axes.margins(x=0.08)
        _label_rows(axes_row[0], results, [key for key, _ in lines])
        figure.legend(handles=_legend(), loc="outside upper center", ncols=4, columnspacing=1.2)
    return figure


def _label_rows(axes: Axes, results: StudyResults, keys: Sequence[str]) -> None:
    """Names at the left; a row that was not run says so once, under its name."""
    axes.set_yticks(range(len(keys)), [_tick(key, bool(results.of(key))) for key in keys])
    for label, key in zip(axes.get_yticklabels(), keys, strict=True):
        label.set_color("black" if results.of(key) else GREY)
    axes.set_ylabel("row, SOC_min [%]")
    axes.set_ylim(len(keys) - 0.5, -0.5)


def _draw(
    axes: Axes, y: float, runs: Sequence[Run], get: Callable[[Outcome], float | None], colour: str
) -> None:
    """Interval as a pale bar, its value as a stroke across, seeds as dots below."""
    found = measure(runs, get)
    if found is None:
        axes.text(0.5, y, "undefined", transform=axes.get_yaxis_transform(), ha="center",
                  va="center", fontsize=9.5, color=GREY)  # fmt: skip
        return
    interval = found.interval
    axes.plot(
        [interval.low, interval.high], [y] * 2, color=colour, linewidth=7, alpha=0.4,
        solid_capstyle="butt",
    )  # fmt: skip
    axes.plot([interval.value], [y], "|", color=colour, markersize=11, markeredgewidth=2.2)
    axes.plot(
        found.values, [y + _BELOW] * len(found.values), "o", color=colour, alpha=0.6, markersize=4,
        markeredgewidth=0,
    )  # fmt: skip


def _mark_references(
    axes: Axes, y: float, results: StudyResults, run: Run, get: Callable[[Outcome], float | None]
) -> None:
    """Myopic greedy and best point under the reward and SOC_min of this row."""
    for name, marker, colour, _ in _REFERENCES:
        item = find_baseline(results, name, run.row.reward, run.row.soc_min)
        value = None if item is None else get(item.outcome)
        if value is not None:
            axes.plot(
                [value], [y + _ABOVE], marker, markersize=6.5, markeredgecolor=colour,
                markerfacecolor="white", markeredgewidth=1.4,
            )  # fmt: skip


def _mark_paper(
    axes: Axes, y: float, key: str, printed: Callable[[MethodValue], float | None]
) -> None:
    """What the paper prints for this row itself, not for one like it."""
    for row in SUMMARY:
        value = printed(row)
        if row.id == key.split("@")[0] and value is not None:
            axes.plot([value], [y + _ABOVE], "D", color=VERMILION, markersize=4, zorder=4)


def _legend() -> list[Line2D]:
    def item(marker: str, colour: str, label: str, size: float, face: str | None = None) -> Line2D:
        return Line2D(
            [], [], marker=marker, linestyle="", markersize=size, label=label, color=colour,
            markerfacecolor=face or colour, markeredgewidth=1.4,
        )  # fmt: skip

    bars = [
        Line2D([], [], color=colour, linewidth=7, alpha=0.4, label=label, solid_capstyle="butt")
        for colour, label in (
            (GREY, "row varied, 95 % interval"),
            (BLUE, "variation, 95 % interval"),
        )
    ]
    return [
        *bars,
        item("|", BLUE, "interquartile mean", 11),
        item("o", BLUE, "one seed", 4),
        *(item(marker, colour, name, 6.5, "white") for _, marker, colour, name in _REFERENCES),
        item("D", VERMILION, "paper", 4),
    ]


def _tick(key: str, run: bool) -> str:
    name = f"{row_name(key)}  {100 * soc_min_of(key):.1f}"
    return name if run else f"{name}\n{NOT_RUN}"
