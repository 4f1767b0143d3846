"""Pictures of runs: SOC, powers and engine operating points. Files only, no screen needed."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tractor_msgs_py.atomic import write_bytes_with
from tractor_msgs_py.trajectory import Trajectory
from tractor_sim.engine import efficiency
from tractor_sim.generator import to_crank_w
from tractor_sim.powertrain import PowertrainParams

# Okabe-Ito: told apart by colour-blind readers and in print.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")


def plot_runs(
    path: Path,
    title: str,
    runs: Mapping[str, Trajectory],
    params: PowertrainParams,
    soc_target: float,
) -> None:
    """Traces of several policies on one cycle: demand, SOC, engine power, operating points.

    Args:
        path: PNG to write.
        title: first line of the picture.
        runs: policy name to its run, all of one cycle.
        params: for limits and the efficiency curve.
        soc_target: drawn into the SOC panel.
    """
    figure = Figure(figsize=(11, 10), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    grid = figure.add_gridspec(4, 1, height_ratios=(1, 1, 1.4, 1.6))
    demand_axes = figure.add_subplot(grid[0])
    soc_axes = figure.add_subplot(grid[1], sharex=demand_axes)
    power_axes = figure.add_subplot(grid[2], sharex=demand_axes)
    curve_axes = figure.add_subplot(grid[3])

    first = next(iter(runs.values()))
    time_s = (first.stamp_ns - first.stamp_ns[0]) * 1e-9
    _step(demand_axes, time_s, first.power_demand_w / 1e3, "black")
    demand_axes.set_ylabel("demand [kW]")
    for (name, run), colour in zip(runs.items(), COLOURS, strict=False):
        soc = np.append(run.soc, run.soc_final)
        soc_axes.plot(np.append(time_s, time_s[-1] + params.dt_s), soc * 100, colour, label=name)
        _step(power_axes, time_s, run.engine_power_w / 1e3, colour)
    soc_axes.axhline(soc_target * 100, color="grey", linestyle=":", label="target")
    soc_axes.set_ylabel("SOC [%]")
    soc_axes.legend(ncols=4, fontsize="small")
    power_axes.set_ylabel("engine power [kW]")
    power_axes.set_xlabel("time [s]")
    _operating_points(curve_axes, runs, params)
    for axes in figure.axes:
        axes.grid(alpha=0.3)
    write_bytes_with(path, lambda file: figure.savefig(file, format="png", dpi=110))


def _step(axes: Axes, time_s: np.ndarray, values: np.ndarray, colour: str) -> None:
    axes.step(time_s, values, where="post", color=colour, linewidth=0.9, alpha=0.85)


def _operating_points(
    axes: Axes, runs: Mapping[str, Trajectory], params: PowertrainParams
) -> None:
    engine = params.engine
    power_w = np.linspace(0.0, engine.power_max_w, 500)
    axes.plot(power_w / 1e3, efficiency(engine, power_w) * 100, "grey", linewidth=1)
    for row, ((name, run), colour) in enumerate(zip(runs.items(), COLOURS, strict=False)):
        bus_w = run.engine_power_w[run.engine_power_w > 0]
        on_w = to_crank_w(params.generator, bus_w, engine.power_max_w)
        share = len(on_w) / len(run)
        # Marker areas are proportional to the time spent there; rows are offset to stay visible.
        counts, edges = np.histogram(on_w, bins=70, range=(0.0, engine.power_max_w))
        centres_w = (edges[:-1] + edges[1:]) / 2
        used = counts > 0
        axes.scatter(
            centres_w[used] / 1e3,
            efficiency(engine, centres_w[used]) * 100 + 0.9 * row,
            s=700 * counts[used] / len(run),
            color=colour,
            alpha=0.6,
            edgecolors="none",
            label=f"{name} (on {share:.0%})",
        )
    axes.set_xlabel("crankshaft power [kW]; area: share of time; rows offset by 0.9 points")
    axes.set_ylabel("efficiency [%]")
    axes.set_ylim(0, float(efficiency(engine, power_w).max()) * 100 + 9)
    legend = axes.legend(fontsize="small", loc="lower right")
    for handle in legend.legend_handles:
        if handle is not None and hasattr(handle, "set_sizes"):
            handle.set_sizes([40])
