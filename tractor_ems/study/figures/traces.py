"""What the trained DQN and DDQN do over the cycle: SOC, battery, engine and total power."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tractor_ems.study.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    VERMILION,
    look,
    new_figure,
    percent,
    say_not_run,
)
from tractor_ems.study.paper_values import TABLE_2
from tractor_ems.study.results import Run, StudyResults
from tractor_ems.study.tables.measures import REWARD_NAMES
from tractor_msgs_py.trajectory import FloatArray, Trajectory

LOW_POWER_KW = 60.0
"""Below it, the paper says, the unshaped agents run the engine."""

PAPER_SOC_FINAL = next(row for row in TABLE_2 if row.id == "ddqn")
"""The paper prints a final SOC for the unshaped DDQN, and none for DQN."""

_MEAN_S = 15.0
"""Window of the mean drawn over powers that switch every second."""


def median_run(runs: Sequence[Run]) -> Run:
    """The run whose final return is the median (the lower one of an even number)."""
    return sorted(runs, key=lambda run: (run.outcome.reward_sum, run.seed))[(len(runs) - 1) // 2]


def build_traces(results: StudyResults) -> Figure:
    """DQN and DDQN of the median seed over one cycle, one column each, four panels as in the
    paper. Side by side, because a policy that switches every second hides what lies below it."""
    columns = (("DQN", "dqn@0.7", BLUE), ("DDQN", "ddqn@0.7", GREEN))
    with look():
        figure = new_figure(8.4)
        panels = figure.subplots(4, 2, sharex=True, sharey="row")
        for column, (name, key, colour) in zip(panels.T, columns, strict=True):
            for axes in column:
                axes.grid()
            column[-1].set_xlabel("time [s]")
            runs = results.of(key)
            if not runs:
                for axes in column:
                    say_not_run(axes, name)
                continue
            run = median_run(runs)
            column[0].set_title(
                f"{name}, seed {run.seed}\n"
                f"{REWARD_NAMES[run.row.reward]} reward, SOC_min {percent(run.row.soc_min)}"
            )
            _draw(column, run.outcome.trajectory, colour)
            if run.row.id == PAPER_SOC_FINAL.id:
                _mark_paper_soc(column[0])
        for axes, quantity in zip(panels.T.flat, 2 * _QUANTITIES, strict=True):
            axes.set_ylabel(quantity)
            axes.tick_params(labelleft=True)
        for column in panels.T:
            figure.align_ylabels(column)
    return figure


_QUANTITIES = ("SOC [%]", "battery power [kW]", "engine power [kW]", "total power [kW]")


def _draw(column: Sequence[Axes], drive: Trajectory, colour: str) -> None:
    soc_axes, battery_axes, engine_axes, total_axes = column
    time_s = _time_s(drive)
    soc_axes.plot(time_s, np.append(drive.soc, drive.soc_final) * 100, colour, linewidth=1.8)
    for axes, power_w, label in (
        (battery_axes, drive.battery_power_w, f"mean over {_MEAN_S:g} s, here and below"),
        (engine_axes, drive.engine_power_w, None),
    ):
        _steps(axes, time_s, power_w, colour, alpha=0.4, width=0.6)
        mean_w = _running_mean(power_w, round(_MEAN_S / (time_s[1] - time_s[0])))
        _steps(axes, time_s, mean_w, colour, width=1.6, label=label)
    _steps(total_axes, time_s, drive.battery_power_w + drive.engine_power_w, colour, width=2.2,
           alpha=0.6)  # fmt: skip
    _steps(total_axes, time_s, drive.power_demand_w, BLACK, linestyle=":", label="demand")
    soc_axes.set_xlim(0.0, time_s[-1])
    battery_axes.axhline(0.0, color=GREY, linewidth=0.8)
    engine_axes.axhline(
        LOW_POWER_KW, color=GREY, linestyle="--", label=f"paper: mostly below {LOW_POWER_KW:g} kW"
    )
    for axes in (battery_axes, engine_axes, total_axes):
        axes.legend(
            loc="lower right", bbox_to_anchor=(1, 0.97), borderaxespad=0,
            handlelength=1.4,
        )  # fmt: skip


def _mark_paper_soc(axes: Axes) -> None:
    soc = PAPER_SOC_FINAL.soc_final
    assert soc is not None  # Table 2 prints it
    label = f"paper, final SOC {percent(soc, 0)}"
    axes.axhline(100 * soc, color=VERMILION, linestyle="--", label=label)
    axes.legend(loc="upper right", borderaxespad=0)


def _running_mean(values: FloatArray, width: int) -> FloatArray:
    """Centred, over what there is of the window at both ends, shape (T,)."""
    ones = np.ones(max(width, 1))
    total = np.convolve(values, ones, "same")
    mean: FloatArray = total / np.convolve(np.ones(len(values)), ones, "same")
    return mean


def _time_s(drive: Trajectory) -> FloatArray:
    """Edges of the steps, shape (T + 1,) [s]; the last step is as long as the one before."""
    start_s = (drive.stamp_ns - drive.stamp_ns[0]) * 1e-9
    return np.append(start_s, 2 * start_s[-1] - start_s[-2])


def _steps(
    axes: Axes,
    edges_s: FloatArray,
    power_w: FloatArray,
    colour: str,
    linestyle: str = "-",
    label: str | None = None,
    width: float = 0.9,
    alpha: float = 1.0,
) -> None:
    axes.stairs(
        power_w / 1e3,
        edges_s,
        baseline=None,
        color=colour,
        linewidth=width,
        alpha=alpha,
        linestyle=linestyle,
        label=label,
    )
