"""Reward curves: what training earned and what the greedy policy earned, over episodes, with the
episode at which the paper says that it converged."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tractor_ems.learning.rewards import RewardKind
from tractor_ems.study.convergence import converged, convergence_over_seeds
from tractor_ems.study.figures.style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PINK,
    VERMILION,
    count_episodes,
    look,
    new_figure,
    percent,
    say_not_run,
    thousands,
)
from tractor_ems.study.paper_values import episodes_of
from tractor_ems.study.results import Run, StudyResults
from tractor_ems.study.statistics import iqm_band
from tractor_msgs_py.trajectory import FloatArray

_POINTS = 300
"""Points of a drawn training curve: more are not visible, and a vector file holds each."""

_RESAMPLES = 400
"""For a band in a picture; tables use more."""

_UNITS: dict[RewardKind, str] = {
    "fuel": "10 g of fuel",
    "piecewise": "-",
    "piecewise_corrected": "-",
    "equivalent_fuel": "10 g of fuel",
}


def return_label(reward: RewardKind, what: str = "return") -> str:
    """Axis label of a sum of rewards over one episode, with its unit."""
    return f"{what} of an episode [{_UNITS[reward]}]"


def build_curve(results: StudyResults, row_id: str, name: str) -> Figure:
    """Reward curve of one row; one panel for every SOC_min that it has or should have.

    Args:
        row_id: as in ``Row.id``.
        name: for the title, where the row was not run too.
    """
    shaped = row_id.startswith("ddqn_shaped")
    limits = (0.70, 0.836) if shaped else (0.70,)
    with look():
        figure = new_figure(3.9 * len(limits) + 0.3)
        panels = np.atleast_1d(figure.subplots(len(limits), 1))
        for axes, soc_min in zip(panels, limits, strict=True):
            title = f"{name}, SOC_min {percent(soc_min)}" if shaped else name
            _panel(axes, results, f"{row_id}@{soc_min:g}", title)
    return figure


def _panel(axes: Axes, results: StudyResults, key: str, title: str) -> None:
    runs = results.of(key)
    axes.set(title=title, xlabel="training episodes [-]")
    axes.grid()
    if not runs:
        axes.set_ylabel(return_label("piecewise" if "shaped" in key else "fuel"))
        say_not_run(axes, title)
        axes.set(xticks=[], yticks=[])
        return
    row = runs[0].row
    axes.set_ylabel(return_label(row.reward))
    seeds = f"IQM of {len(runs)} seeds,\n95 % band" if len(runs) > 1 else "1 seed"
    draw_training(axes, runs, GREY, "training")
    draw_evaluations(axes, runs, BLUE, "greedy")
    count_episodes(axes.xaxis)
    reference_lines(axes, results, row.reward, row.soc_min)
    axes.set_xlim(0, max(run.episodes for run in runs) * 1.005)
    _mark_convergence(axes, runs)
    _mark_paper(axes, episodes_of(row.id))
    axes.legend(
        title=seeds,
        alignment="left",
        loc="upper left",
        bbox_to_anchor=(1.0, 1.0),
        borderaxespad=0.3,
    )


def draw_training(axes: Axes, runs: Sequence[Run], colour: str, label: str) -> None:
    """IQM of the training return over seeds, averaged over blocks of episodes, with its band."""
    shared = min(len(run.curve.train_return) for run in runs)
    if shared == 0:
        return
    block = -(-shared // _POINTS)
    blocks = np.stack([_block_means(run.curve.train_return[:shared], block) for run in runs])
    ends = np.minimum(np.arange(1, blocks.shape[1] + 1) * block, shared)
    centre = ends - (np.diff(ends, prepend=0) - 1) / 2
    _draw_band(axes, centre, blocks, colour, label, 1.0)


def draw_evaluations(axes: Axes, runs: Sequence[Run], colour: str, label: str) -> None:
    """IQM of the greedy return over seeds at the evaluations that all runs share."""
    shared = runs[0].curve.episode
    for run in runs[1:]:
        shared = np.intersect1d(shared, run.curve.episode)
    returns = np.stack([run.curve.eval_return[np.isin(run.curve.episode, shared)] for run in runs])
    _draw_band(axes, shared.astype(np.float64), returns, colour, label, 1.8)


def reference_lines(axes: Axes, results: StudyResults, reward: RewardKind, soc_min: float) -> None:
    """Exact optimum, greedy on the reward, and random, where the study has them."""
    for name, label, colour, style in (
        ("optimum", "exact optimum", GREEN, "-"),
        ("myopic", "myopic greedy", ORANGE, "--"),
        ("random_feasible", "random", PINK, ":"),
    ):
        try:
            level = results.baseline(name, reward, soc_min).outcome.reward_sum
        except KeyError:
            continue
        axes.axhline(level, color=colour, linestyle=style, linewidth=1.6, label=label)


def _mark_convergence(axes: Axes, runs: Sequence[Run]) -> None:
    found = [converged(run.curve.episode, run.curve.eval_return) for run in runs]
    row = convergence_over_seeds(found, np.random.default_rng(0), _RESAMPLES)
    if row.censored == len(found):
        label = "here: not converged"
        axes.plot([], [], " ", label=label)
        return
    label = f"here, converged: {row.text.split(' [')[0].split(' (')[0]}"
    axes.axvline(row.episodes.value, color=BLUE, linestyle="-.", linewidth=1.3, label=label)


def _mark_paper(axes: Axes, episodes: int | None) -> None:
    """A line at the paper's episode, or an arrow at the edge where it lies beyond the axis."""
    if episodes is None:
        return
    if episodes <= axes.get_xlim()[1]:
        axes.axvline(
            episodes,
            color=VERMILION,
            linestyle="--",
            linewidth=1.6,
            label=f"paper: {thousands(episodes)}",
        )
        return
    axes.text(
        1.02,
        0.04,
        f"paper: converged\nat {thousands(episodes)} →",
        transform=axes.transAxes,
        color="#a34700",
        va="bottom",
    )


def _draw_band(
    axes: Axes, x: FloatArray, values: FloatArray, colour: str, label: str, width: float
) -> None:
    band = iqm_band(values, np.random.default_rng(0), _RESAMPLES)
    if band.runs > 1:
        axes.fill_between(x, band.low, band.high, color=colour, alpha=0.22, linewidth=0)
    axes.plot(x, band.value, color=colour, linewidth=width, label=label)


def _block_means(values: FloatArray, block: int) -> FloatArray:
    """Means of consecutive blocks; the last may be shorter."""
    starts = np.arange(0, len(values), block)
    sums = np.add.reduceat(values, starts)
    means: FloatArray = sums / np.diff(np.append(starts, len(values)))
    return means
