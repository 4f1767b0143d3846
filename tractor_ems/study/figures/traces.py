"""What the trained DQN and DDQN do over the cycle: SOC, battery, engine and total power."""

from collections.abc import Mapping, Sequence

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
    """DQN and DDQN of the median seed over one cycle, four panels as in the paper."""
    shown = {
        name: median_run(runs)
        for name, key in (("DQN", "dqn@0.7"), ("DDQN", "ddqn@0.7"))
        if (runs := results.of(key))
    }
    with look():
        figure = new_figure(8.4)
        axes = figure.subplots(4, 1, sharex=True)
        soc_axes, battery_axes, engine_axes, total_axes = axes
        soc_axes.set_ylabel("SOC [%]")
        battery_axes.set_ylabel("battery power [kW]")
        engine_axes.set_ylabel("engine power [kW]")
        total_axes.set_ylabel("total power [kW]")
        total_axes.set_xlabel("time [s]")
        for panel in axes:
            panel.grid()
        if shown:
            _draw(axes, shown)
        else:
            for panel in axes:
                say_not_run(panel, "DQN and DDQN")
        figure.align_ylabels(axes)
    return figure


def _draw(axes: Sequence[Axes], shown: Mapping[str, Run]) -> None:
    soc_axes, battery_axes, engine_axes, total_axes = axes
    # The second is thinner, so that the first shows where both do the same.
    looks = ((BLUE, 2.2), (VERMILION, 0.9))
    for (name, run), (colour, width) in zip(shown.items(), looks, strict=False):
        drive = run.outcome.trajectory
        time_s = _time_s(drive)
        label = f"{name}, seed {run.seed}"
        soc_axes.plot(
            time_s,
            np.append(drive.soc, drive.soc_final) * 100,
            colour,
            label=label,
            linewidth=width + 0.4,
        )
        _steps(battery_axes, time_s, drive.battery_power_w, colour, width)
        _steps(engine_axes, time_s, drive.engine_power_w, colour, width)
        _steps(total_axes, time_s, drive.battery_power_w + drive.engine_power_w, colour, width)
    demand_w = next(iter(shown.values())).outcome.trajectory.power_demand_w
    _steps(total_axes, time_s, demand_w, BLACK, 0.9, linestyle=":", label="demand")
    soc_axes.set_xlim(0.0, time_s[-1])
    total_axes.legend(loc="lower right", bbox_to_anchor=(1, 0.98), borderaxespad=0)
    soc_axes.axhline(
        PAPER_SOC_FINAL * 100,
        color=GREY,
        linestyle="--",
        label=f"paper, final SOC {PAPER_SOC_FINAL * 100:.0f} %",
    )
    battery_axes.axhline(0.0, color=GREY, linewidth=0.8)
    engine_axes.axhline(
        LOW_POWER_KW,
        color=GREY,
        linestyle="--",
        label=f"paper: mostly below {LOW_POWER_KW:g} kW",
    )
    engine_axes.legend(loc="lower right", bbox_to_anchor=(1, 0.98), borderaxespad=0)
    soc_axes.legend(ncols=3, loc="lower right", bbox_to_anchor=(1, 1.0), borderaxespad=0)


def _time_s(drive: Trajectory) -> FloatArray:
    """Edges of the steps, shape (T + 1,) [s]; the last step is as long as the one before."""
    start_s = (drive.stamp_ns - drive.stamp_ns[0]) * 1e-9
    return np.append(start_s, 2 * start_s[-1] - start_s[-2])


def _steps(
    axes: Axes,
    edges_s: FloatArray,
    power_w: FloatArray,
    colour: str,
    width: float,
    linestyle: str = "-",
    label: str | None = None,
) -> None:
    axes.stairs(
        power_w / 1e3,
        edges_s,
        baseline=None,
        color=colour,
        linewidth=width,
        alpha=0.85,
        linestyle=linestyle,
        label=label,
    )
