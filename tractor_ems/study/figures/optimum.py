"""Ours, beside the paper: the true optimum of each reward, and what greed on it gets."""

from collections.abc import Callable, Sequence
from itertools import product
from typing import Literal

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from tractor_ems.learning.rewards import RewardKind
from tractor_ems.study.figures.style import (
    BLACK,
    BLUE,
    GREY,
    SKY,
    VERMILION,
    look,
    new_figure,
    percent,
    say_not_run,
)
from tractor_ems.study.paper_values import SUMMARY, MethodValue
from tractor_ems.study.results import Outcome, StudyResults
from tractor_ems.study.tables.measures import SOC_MINS, find_baseline, fuel_gal

_REWARDS: Sequence[tuple[RewardKind, str]] = (
    ("fuel", "fuel reward"),
    ("piecewise", "shaped, as printed"),
    ("piecewise_corrected", "shaped, corrected"),
)
_KINDS = (("optimum", "exact optimum", BLUE, -0.18), ("myopic", "myopic greedy", SKY, 0.18))

_PAPER: Sequence[tuple[str, str, Literal[":", "--", "-."], Sequence[RewardKind]]] = (
    ("ddqn", "DDQN", ":", ("fuel",)),
    ("ddqn_shaped", "shaped DDQN", "--", ("piecewise",)),
    ("dp", "DP", "-.", ("fuel", "piecewise_corrected")),
)
"""Row, name, line, and the rewards that it is drawn beside. DP is that of least fuel; the
corrected reward is not the paper's, but its aim is."""


def build_optimum(results: StudyResults) -> Figure:
    """Fuel and final SOC of exact DP on each reward and of greed on it, by SOC_min."""
    settings = list(product(_REWARDS, SOC_MINS))
    with look():
        figure = new_figure(6.4)
        fuel_axes, soc_axes = figure.subplots(1, 2, sharey=True)
        fuel_axes.set(xlabel="fuel [gal]", ylabel="reward, SOC_min [%]")
        fuel_axes.set_yticks(
            range(len(settings)),
            [f"{name}\n{percent(soc_min)}" for (_, name), soc_min in settings],
        )
        fuel_axes.set_ylim(len(settings) - 0.5, -0.5)
        soc_axes.set_xlabel("final SOC [%]")
        for axes in (fuel_axes, soc_axes):
            axes.grid(axis="x")
            axes.tick_params(axis="y", length=0)
            for place in range(len(SOC_MINS), len(settings), len(SOC_MINS)):
                axes.axhline(place - 0.5, color=GREY, linewidth=0.8)
        found: list[Outcome] = []
        for place, ((reward, _), soc_min) in enumerate(settings):
            for kind, _, colour, shift in _KINDS:
                item = find_baseline(results, kind, reward, soc_min)
                if item is not None:
                    found.append(item.outcome)
                    _draw(fuel_axes, soc_axes, place + shift, item.outcome, colour)
        if not found:
            for axes in (fuel_axes, soc_axes):
                say_not_run(axes, "exact optimum")
            return figure
        _scale_soc(soc_axes, found)
        fuel_axes.set_xlim(0.0, max(2.0, 1.05 * max(fuel_gal(outcome) for outcome in found)))
        _mark_paper(fuel_axes, lambda row: row.fuel_gal)
        _mark_paper(soc_axes, lambda row: None if row.soc_final is None else 100 * row.soc_final)
        figure.legend(handles=_legend(), loc="outside upper center", ncols=3, columnspacing=1.4)
    return figure


def _draw(fuel_axes: Axes, soc_axes: Axes, y: float, outcome: Outcome, colour: str) -> None:
    """One bar and one dot; values stand in a column of their own, where no line crosses them."""
    fuel, soc = fuel_gal(outcome), 100 * outcome.soc_final
    fuel_axes.barh([y], [fuel], height=0.3, color=colour)
    soc_axes.plot([100 * outcome.soc_initial, soc], [y, y], color=colour, linewidth=2.5,
                  solid_capstyle="butt")  # fmt: skip
    soc_axes.plot([soc], [y], "o", color=colour, markersize=8)
    for axes, text in ((fuel_axes, f"{fuel:.2f}"), (soc_axes, f"{soc:.1f}")):
        axes.text(1.02, y, text, transform=axes.get_yaxis_transform(), va="center", fontsize=9.5)


def _scale_soc(axes: Axes, found: Sequence[Outcome]) -> None:
    """Around what occurs; dots and not bars, since the axis does not begin at 0."""
    start = 100 * found[0].soc_initial
    lowest = min(70.0, *(100 * outcome.soc_final for outcome in found))
    highest = max(start, *(100 * outcome.soc_final for outcome in found))
    axes.set_xlim(lowest - 1.5, highest + 1.5)
    axes.axvline(start, color=BLACK, linewidth=1)
    axes.annotate(
        f"start {start:.0f} %", (start, 1.0), xycoords=("data", "axes fraction"),
        xytext=(0, 3), textcoords="offset points", ha="center", fontsize=9.5,
    )  # fmt: skip


def _mark_paper(axes: Axes, get: Callable[[MethodValue], float | None]) -> None:
    printed = {row.id: row for row in SUMMARY}
    for name, _, style, rewards in _PAPER:
        value = get(printed[name])
        for place, (reward, _) in enumerate(_REWARDS):
            if value is not None and reward in rewards:
                top, bottom = (len(SOC_MINS) * side - 0.5 for side in (place, place + 1))
                axes.plot([value] * 2, [top, bottom], style, color=VERMILION, linewidth=1.6)


def _legend() -> list[Patch | Line2D]:
    """Two of ours, then what the paper prints."""
    printed = {row.id: row for row in SUMMARY}
    handles: list[Patch | Line2D] = [
        Patch(facecolor=colour, label=name) for _, name, colour, _ in _KINDS
    ]
    for name, label, style, _ in _PAPER:
        row = printed[name]
        assert row.soc_final is not None  # the paper prints it for these three
        text = f"paper, {label}: {row.fuel_gal:.2f} gal, {percent(row.soc_final)}"
        handles.append(Line2D([], [], linestyle=style, color=VERMILION, label=text))
    return handles
