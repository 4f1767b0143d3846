"""Reward curves: what training earned and what the greedy policy earned, over episodes, with the
episode at which the paper says that it converged."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tractor_ems.learning.rewards import RewardConfig, RewardKind
from tractor_ems.study.convergence import converged, convergence_over_seeds
from tractor_ems.study.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    PINK,
    VERMILION,
    look,
    new_figure,
    percent,
    say_not_run,
    thousands,
    use_thousands,
)
from tractor_ems.study.paper_values import episodes_of
from tractor_ems.study.results import Run, StudyResults
from tractor_ems.study.statistics import interquartile_mean, iqm_band
from tractor_msgs_py.trajectory import FloatArray

_POINTS = 300
"""Points of a drawn training curve: more are not visible, and a vector file holds each."""

_RESAMPLES = 400
"""For a band in a picture; tables use more."""

_LABELS: dict[RewardKind, str] = {
    "fuel": "return of an episode: −fuel [kg]",
    "piecewise": "return of an episode [-]",
    "piecewise_corrected": "return of an episode [-]",
    "equivalent_fuel": "return of an episode: −equivalent fuel [kg]",
}


def return_label(reward: RewardKind) -> str:
    """Axis label of a sum of rewards over one episode, with its unit."""
    return _LABELS[reward]


def return_scale(reward: RewardKind) -> float:
    """From what a learner sees, where 10 g of fuel count 1, to the unit of the label."""
    return RewardConfig(kind=reward).cost_unit


def return_text(reward: RewardKind, value: float) -> str:
    """A sum of rewards as a learner sees it, in the label's unit: ``−0.52 kg``."""
    shown = value * return_scale(reward)
    text = f"{shown:,.0f}" if reward.startswith("piecewise") else f"{shown:.2f} kg"
    return text.replace("-", "−")


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
            title = f"{name}, SOC_min {percent(soc_min)}"
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
    axes.set_title(f"{title}: {_budget(results, runs)}")
    seeds = f"IQM of {len(runs)} seeds,\n95 % band" if len(runs) > 1 else "1 seed"
    draw_training(axes, runs, GREY, "training")
    last = draw_evaluations(axes, runs, BLUE, "greedy")
    axes.lines[-1].set_label(f"greedy, last {return_text(row.reward, last)}")
    use_thousands(axes.xaxis)
    if row.reward.startswith("piecewise"):
        use_thousands(axes.yaxis)
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


def _budget(results: StudyResults, runs: Sequence[Run]) -> str:
    episodes = f"{thousands(max(run.episodes for run in runs))} episodes"
    if runs[0].row.tabular:
        return episodes
    return f"{episodes}, 1 update per {results.steps_per_update} steps"


def draw_training(axes: Axes, runs: Sequence[Run], colour: str, label: str) -> None:
    """IQM of the training return over seeds, averaged over blocks of episodes, with its band."""
    shared = min(len(run.curve.train_return) for run in runs)
    if shared == 0:
        return
    block = -(-shared // _POINTS)
    blocks = np.stack([_block_means(run.curve.train_return[:shared], block) for run in runs])
    ends = np.minimum(np.arange(1, blocks.shape[1] + 1) * block, shared)
    centre = ends - (np.diff(ends, prepend=0) - 1) / 2
    _draw_band(axes, centre, blocks * return_scale(runs[0].row.reward), colour, label, 1.0)


def draw_evaluations(axes: Axes, runs: Sequence[Run], colour: str, label: str) -> float:
    """IQM of the greedy return over seeds at the evaluations that all runs share; returns the
    last one, as a learner sees it."""
    shared = runs[0].curve.episode
    for run in runs[1:]:
        shared = np.intersect1d(shared, run.curve.episode)
    returns = np.stack([run.curve.eval_return[np.isin(run.curve.episode, shared)] for run in runs])
    scale = return_scale(runs[0].row.reward)
    _draw_band(axes, shared.astype(np.float64), returns * scale, colour, label, 1.8)
    return float(interquartile_mean(returns[:, -1]))


def reference_lines(axes: Axes, results: StudyResults, reward: RewardKind, soc_min: float) -> None:
    """Exact optimum, greedy on the reward, and random, where the study has them, with their
    values: optimum and myopic greedy can be closer than a line is wide."""
    for name, label, colour, style, width in (
        ("optimum", "exact optimum", GREEN, "-", 3.5),
        ("myopic", "myopic greedy", BLACK, "--", 1.2),
        ("random_feasible", "random", PINK, ":", 1.6),
    ):
        try:
            level = results.baseline(name, reward, soc_min).outcome.reward_sum
        except KeyError:
            continue
        axes.axhline(
            level * return_scale(reward), color=colour, linestyle=style, linewidth=width,
            alpha=0.55 if name == "optimum" else 1.0,
            label=f"{label} {return_text(reward, level)}",
        )  # fmt: skip
    # axhline makes room for itself where it lies outside the axes, and none for the margin.
    axes.margins(y=0.06)
    axes.autoscale_view(scalex=False)


def _mark_convergence(axes: Axes, runs: Sequence[Run]) -> None:
    found = [converged(run.curve.episode, run.curve.eval_return) for run in runs]
    row = convergence_over_seeds(found, np.random.default_rng(0), _RESAMPLES)
    if row.lower_bound:  # an episode at which nothing happened is no line
        axes.plot([], [], " ", label=f"not converged:\n{row.censored} of {len(found)} seeds")
        return
    label = f"here, converged: {thousands(row.episodes.value)}"
    if row.censored:
        label += f"\n({row.censored} of {len(found)} seeds did not)"
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
        bbox={"boxstyle": "square,pad=0.3", "facecolor": "white", "edgecolor": "#a34700"},
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
