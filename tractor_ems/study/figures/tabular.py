"""The tables after training: progress, share of pairs never visited, and whether Q follows the
reward (the paper's Pearson correlation, on its scale of strength)."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tractor_ems.study.figures.curves import draw_evaluations, reference_lines, return_label
from tractor_ems.study.figures.style import (
    BLACK,
    BLUE,
    GREY,
    VERMILION,
    count_episodes,
    look,
    new_figure,
    say_not_run,
)
from tractor_ems.study.figures.traces import median_run
from tractor_ems.study.paper_values import PEARSON, PEARSON_SCALE
from tractor_ems.study.results import Run, StudyResults, TableStudy
from tractor_ems.study.statistics import strength_of

_AGENTS = (
    ("q@0.7", "Q-learning", BLACK),
    ("double_q@0.7", "double Q", BLUE),
    ("double_q_interpolated@0.7", "double Q,\ninterpolated", VERMILION),
)


def build_pearson(results: StudyResults) -> Figure:
    """Q against reward over visited pairs, and r of every seed on the paper's scale."""
    runs = [run for run in results.of("double_q@0.7") if run.table is not None]
    with look():
        figure = new_figure(6.4)
        axes, scale = figure.subplots(2, 1, height_ratios=(3.2, 1))
        axes.set(xlabel="reward of the pair [10 g of fuel]", ylabel="Q [10 g of fuel]")
        axes.grid()
        if runs:
            run = median_run(runs)
            table = _table(run)
            axes.scatter(
                table.sample_reward,
                table.sample_q,
                s=4,
                color=BLUE,
                alpha=0.35,
                linewidths=0,
                rasterized=True,
            )
            r = "undefined" if table.pearson is None else f"{table.pearson:+.3f}"
            axes.set_title(
                f"{run.row.label}, seed {run.seed}: r = {r}, {strength_of(table.pearson)}\n"
                f"{len(table.sample_q):,} of {table.pairs_visited:,} visited pairs shown"
            )
        else:
            say_not_run(axes, "double Q-learning")
        _strength_scale(scale, runs)
    return figure


def _strength_scale(axes: Axes, runs: Sequence[Run]) -> None:
    """The axis from -1 to 1 with the paper's words, its value and one dot per seed."""
    edges = [1.0, *(least for least, _ in PEARSON_SCALE)]
    for (_, word), outer, inner in zip(PEARSON_SCALE, edges, edges[1:], strict=False):
        for sign in (-1, 1):
            low, high = sorted((sign * inner, sign * outer))
            shade = {"strong": 0.30, "moderate": 0.18, "weak": 0.07}[word]
            axes.axvspan(low, high, color=GREY, alpha=shade, linewidth=0)
            axes.text((low + high) / 2, 0.93, word, ha="center", va="top", fontsize=9.5)
    axes.axvline(0.0, color=BLACK, linewidth=0.8)
    found = [table.pearson for run in runs if (table := _table(run)).pearson is not None]
    axes.plot(
        found,
        np.full(len(found), 0.5),
        "o",
        color=BLUE,
        label="here, one dot a seed",
        markersize=8,
        alpha=0.75,
        clip_on=False,
    )
    axes.plot(
        [PEARSON],
        [0.22],
        "D",
        color=VERMILION,
        label=f"paper {PEARSON:+.3f}".replace("-", "−"),
        markersize=8,
    )
    axes.set(
        xlim=(-1, 1), ylim=(0, 1), yticks=[], xlabel="Pearson correlation r of Q and reward [-]"
    )
    axes.spines["left"].set_visible(False)
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.1)


def build_tabular(results: StudyResults) -> Figure:
    """Greedy return over the tabular budget, pairs never visited, and Pearson per agent."""
    agents = [(name, colour, runs) for key, name, colour in _AGENTS if (runs := results.of(key))]
    with look():
        figure = new_figure(7.2)
        grid = figure.add_gridspec(2, 2, height_ratios=(1.5, 1))
        curve = figure.add_subplot(grid[0, :])
        never, pearson = figure.add_subplot(grid[1, 0]), figure.add_subplot(grid[1, 1])
        curve.set(xlabel="training episodes [-]", ylabel=return_label("fuel", "greedy return"))
        never.set(xlabel="pairs never visited [% of all entries]", xlim=(0, 100))
        pearson.set(xlabel="Pearson r of Q and reward [-]", xlim=(-1, 1))
        for axes in (curve, never, pearson):
            axes.grid()
        if not agents:
            for axes in (curve, never, pearson):
                say_not_run(axes, "tabular agents")
            return figure
        for name, colour, runs in agents:
            draw_evaluations(curve, runs, colour, name.replace("\n", " "))
        reference_lines(curve, results, "fuel", 0.70)
        count_episodes(curve.xaxis)
        figure.suptitle(
            f"Greedy drive during {results.episodes_tabular:,} tabular episodes, IQM over seeds",
            x=0.01, ha="left", fontsize=11,
        )  # fmt: skip
        curve.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, columnspacing=1.2)
        curve.set_xlim(0, max(run.episodes for _, _, runs in agents for run in runs))
        for place, (_, colour, runs) in enumerate(agents):
            _dots(never, place, [_never(run) for run in runs], colour, "%")
            found = [table.pearson for run in runs if (table := _table(run)).pearson is not None]
            _dots(pearson, place, found, colour, "")
        pearson.axvline(PEARSON, color=VERMILION, linestyle="--", linewidth=1)
        pearson.text(
            PEARSON - 0.04,
            -0.62,
            f"paper {PEARSON}".replace("-", "−"),
            color="#a34700",
            ha="right",
            va="center",
            fontsize=9.5,
        )
        for axes in (never, pearson):
            axes.set_ylim(len(agents) - 0.4, -0.95)
            axes.set_yticks(range(len(agents)), [name for name, _, _ in agents])
        pearson.tick_params(labelleft=False)
    return figure


def _dots(axes: Axes, place: int, values: Sequence[float], colour: str, unit: str) -> None:
    if not values:
        axes.text(0.5, place, "undefined", transform=axes.get_yaxis_transform(), va="center")
        return
    axes.plot(
        values,
        np.full(len(values), place),
        "o",
        color=colour,
        alpha=0.7,
        markersize=7,
        clip_on=False,
    )
    middle = float(np.median(values))
    text = f"{middle:.2f} {unit}".strip().replace("-", "−")
    low, high = axes.get_xlim()
    right = middle > (low + high) / 2
    gap = (high - low) * 0.05
    axes.text(
        min(values) - gap if right else max(values) + gap,
        place,
        text,
        ha="right" if right else "left",
        va="center",
        fontsize=10,
    )


def _never(run: Run) -> float:
    table = _table(run)
    return 100.0 * (1.0 - table.pairs_visited / table.pairs)


def _table(run: Run) -> TableStudy:
    assert run.table is not None  # rows named in this file are tabular
    return run.table
