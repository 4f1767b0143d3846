"""The tables after training: progress, share of pairs never visited, and whether Q follows the
reward (the paper's Pearson correlation, on its scale of strength)."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from tractor_ems.learning.tabular import TableStudy
from tractor_ems.study.figures.curves import (
    draw_evaluations,
    reference_lines,
    return_label,
    return_scale,
    return_text,
)
from tractor_ems.study.figures.style import (
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    SKY,
    VERMILION,
    look,
    new_figure,
    say_not_run,
    use_thousands,
)
from tractor_ems.study.figures.traces import median_run
from tractor_ems.study.paper_values import PEARSON, PEARSON_SCALE
from tractor_ems.study.results import Run, StudyResults
from tractor_ems.study.statistics import strength_of

_AGENTS = (
    ("q@0.7", "Q-learning", ORANGE),
    ("double_q@0.7", "double Q", BLUE),
    ("double_q_interpolated@0.7", "double Q,\ninterpolated", SKY),
)

_TO_G = 1e3 * return_scale("fuel")


def build_pearson(results: StudyResults) -> Figure:
    """Q against reward over visited pairs, and r of every seed on the paper's scale."""
    runs = [run for run in results.of("double_q@0.7") if run.table is not None]
    with look():
        figure = new_figure(6.4)
        axes, scale = figure.subplots(2, 1, height_ratios=(3.2, 1))
        axes.set(xlabel="reward of the pair: −fuel of the step [g]", ylabel="Q [g of fuel]")
        axes.grid()
        if runs:
            run = median_run(runs)
            table = _table(run)
            axes.scatter(
                table.sample_reward * _TO_G,
                table.sample_q * _TO_G,
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
    """Greedy return over the tabular budget, what of the table was visited, and Pearson."""
    agents = [(name, colour, runs) for key, name, colour in _AGENTS if (runs := results.of(key))]
    with look():
        figure = new_figure(7.0)
        grid = figure.add_gridspec(2, 2, height_ratios=(1.7, 1), width_ratios=(1.25, 1))
        curve = figure.add_subplot(grid[0, :])
        visited, pearson = figure.add_subplot(grid[1, 0]), figure.add_subplot(grid[1, 1])
        curve.set(xlabel="training episodes [-]", ylabel=return_label("fuel"))
        visited.set(xlabel="pairs [% of all entries of the table]", xlim=(0, 100))
        pearson.set(xlabel="Pearson r of Q and reward [-]", xlim=(-1, 1))
        curve.grid()
        pearson.grid(axis="x")
        if not agents:
            for axes in (curve, visited, pearson):
                say_not_run(axes, "tabular agents")
            return figure
        for name, colour, runs in agents:
            last = return_text("fuel", draw_evaluations(curve, runs, colour, name))
            curve.lines[-1].set_label(f"{name}, last {last}".replace("\n", " "))
        reference_lines(curve, results, "fuel", 0.70)
        use_thousands(curve.xaxis)
        curve.set_title(
            f"Greedy drive during {results.episodes_tabular:,} episodes, IQM over seeds, 95 % band"
        )
        figure.legend(*curve.get_legend_handles_labels(), loc="outside upper left", ncols=2)
        curve.set_xlim(0, max(run.episodes for _, _, runs in agents for run in runs))
        for place, (_, colour, runs) in enumerate(agents):
            _shares(visited, place, runs, colour)
            _correlations(pearson, place, runs, colour)
            if runs[0].row.id == "double_q":  # the paper prints it for this agent alone
                label = f"paper {PEARSON}".replace("-", "−")
                pearson.plot([PEARSON], [place + 0.3], "D", color=VERMILION, markersize=6)
                pearson.text(PEARSON + 0.07, place + 0.3, label, color="#a34700", ha="left",
                             va="center", fontsize=9.5)  # fmt: skip
        for axes in (visited, pearson):
            axes.set_ylim(len(agents) - 0.45, -0.55)
            axes.set_yticks(range(len(agents)), [name for name, _, _ in agents])
            axes.tick_params(axis="y", length=0)
        _legend_of_shares(visited)
        pearson.set_title("one dot a seed, median")
    return figure


_SHADES = (("never visited, feasible", "#9a9a9a"), ("not feasible", "#e4e4e4"))


def _shares(axes: Axes, y: float, runs: Sequence[Run], colour: str) -> None:
    """The median seed's table in three parts: visited, feasible but never visited, the rest."""
    table = sorted((_table(run) for run in runs), key=lambda table: table.pairs_visited)[
        (len(runs) - 1) // 2
    ]
    visited, feasible = table.pairs_visited, max(table.pairs_feasible, table.pairs_visited)
    parts = 100.0 * np.diff([0, visited, feasible, table.pairs]) / table.pairs
    left = 0.0
    for part, shade in zip(parts, (colour, *(shade for _, shade in _SHADES)), strict=True):
        axes.barh([y], [part], left=left, height=0.42, color=shade)
        at, where = (0.0, "left") if left == 0.0 else (left + part / 2, "center")
        axes.text(at, y - 0.24, f"{part:.1f} %", ha=where, va="bottom", fontsize=9.5)
        left += part


def _legend_of_shares(axes: Axes) -> None:
    handles = [Patch(facecolor=BLUE, edgecolor=ORANGE, linewidth=1.5, label="visited")]
    handles += [Patch(facecolor=shade, label=name) for name, shade in _SHADES]
    axes.legend(
        handles=handles, loc="lower left", bbox_to_anchor=(-0.02, 1.0), ncols=3, borderaxespad=0.1,
        columnspacing=0.8, handlelength=1.0, handletextpad=0.4,
    )  # fmt: skip


def _correlations(axes: Axes, y: float, runs: Sequence[Run], colour: str) -> None:
    """One dot a seed; the median stands above, where no mark of the paper lies."""
    values = [table.pearson for run in runs if (table := _table(run)).pearson is not None]
    if not values:
        axes.text(0.0, y, "undefined", ha="center", va="center")
        return
    axes.plot(values, np.full(len(values), y), "o", color=colour, alpha=0.7, markersize=7,
              clip_on=False)  # fmt: skip
    middle = float(np.median(values))
    text = f"{middle:+.2f}".replace("-", "−")
    axes.text(min(max(middle, -0.85), 0.85), y - 0.16, text, ha="center", va="bottom", fontsize=10)


def _table(run: Run) -> TableStudy:
    assert run.table is not None  # rows named in this file are tabular
    return run.table
