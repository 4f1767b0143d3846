"""What the trained DQN and DDQN do over the cycle: SOC, battery, engine and total power."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tractor_ems.study.figures.style import (
    BLACK,
    BLUE,
    GREY,
    VERMILION,
    look,
    new_figure,
    say_not_run,
)
from tractor_ems.study.results import Run, StudyResults
from tractor_msgs_py.trajectory import FloatArray, Trajectory

LOW_POWER_KW = 60.0
"""Below it, the paper says, the unshaped agents run the engine."""

PAPER_SOC_FINAL = 0.70


def median_run(runs: Sequence[Run]) -> Run:
    """The run whose final return is the median (the lower one of an even number)."""
    return sorted(runs, key=lambda run: (run.outcome.reward_sum, run.seed))[(len(runs) - 1) // 2]


def build_traces(results: StudyResults) -> Figure:
    """DQN and DDQN of the median seed over one cycle, one column each, four panels as in the
    paper. Side by side, because a policy that switches every second hides what lies below it."""
    columns = (("DQN", "dqn@0.7", BLUE), ("DDQN", "ddqn@0.7", VERMILION))
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
            column[0].set_title(f"{name}, seed {run.seed}")
            _draw(column, run.outcome.trajectory, colour)
        for axes, quantity in zip(panels[:, 0], _QUANTITIES, strict=True):
            axes.set_ylabel(quantity)
        figure.align_ylabels(panels[:, 0])
    return figure


_QUANTITIES = ("SOC [%]", "battery power [kW]", "engine power [kW]", "total power [kW]")


def _draw(column: Sequence[Axes], drive: Trajectory, colour: str) -> None:
    soc_axes, battery_axes, engine_axes, total_axes = column
    time_s = _time_s(drive)
    soc_axes.plot(time_s, np.append(drive.soc, drive.soc_final) * 100, colour, linewidth=1.8)
    _steps(battery_axes, time_s, drive.battery_power_w, colour)
    _steps(engine_axes, time_s, drive.engine_power_w, colour)
    _steps(total_axes, time_s, drive.battery_power_w + drive.engine_power_w, colour)
    _steps(total_axes, time_s, drive.power_demand_w, BLACK, linestyle=":", label="demand")
    soc_axes.set_xlim(0.0, time_s[-1])
    soc_axes.axhline(
        PAPER_SOC_FINAL * 100,
        color=GREY,
        linestyle="--",
        label=f"paper, final SOC {PAPER_SOC_FINAL * 100:.0f} %",
    )
    battery_axes.axhline(0.0, color=GREY, linewidth=0.8)
    engine_axes.axhline(
        LOW_POWER_KW, color=GREY, linestyle="--", label=f"paper: mostly below {LOW_POWER_KW:g} kW"
    )
    for axes in (soc_axes, engine_axes, total_axes):
        axes.legend(loc="lower right", bbox_to_anchor=(1, 0.97), borderaxespad=0)
    soc_axes.set_title(soc_axes.get_title(loc="left"), pad=20)


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
) -> None:
    axes.stairs(
        power_w / 1e3,
        edges_s,
        baseline=None,
        color=colour,
        linewidth=0.9,
        linestyle=linestyle,
        label=label,
    )
