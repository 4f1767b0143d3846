"""Which states the tabular double Q-learning agent met, how often, and which never."""

import matplotlib
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from tractor_ems.study.figures.style import BLACK, look, new_figure, percent, say_not_run
from tractor_ems.study.figures.traces import median_run
from tractor_ems.study.results import StudyResults
from tractor_sim.config import load_powertrain

_NEVER = "#e4e4e4"
"""Lighter than any colour of cividis, darker than the page."""


def build_heatmap(results: StudyResults) -> Figure:
    """Visits of every (SOC bin, demand bin), log colour; never visited is outside the scale."""
    runs = [run for run in results.of("double_q@0.7") if run.table is not None]
    with look():
        figure = new_figure(4.6)
        axes = figure.add_subplot()
        axes.set(xlabel="power demand [kW]", ylabel="SOC [%]")
        if not runs:
            say_not_run(axes, "double Q-learning")
            return figure
        run = median_run(runs)
        assert run.table is not None
        visits = run.table.state_visits
        never = visits == 0
        # The tables' bins share the SOC window and the range of the cycle evenly.
        demand_kw = run.outcome.trajectory.power_demand_w / 1e3
        soc_max = load_powertrain("paper").battery.soc_max
        window = (100 * run.row.soc_min, 100 * soc_max)
        cmap = matplotlib.colormaps["cividis"].with_extremes(bad=_NEVER, under=_NEVER)
        image = axes.imshow(
            np.ma.masked_array(visits, never),
            origin="lower",
            aspect="auto",
            interpolation="nearest",
            norm=LogNorm(1, max(int(visits.max()), 10)),
            cmap=cmap,
            extent=(float(demand_kw.min()), float(demand_kw.max()), *window),
        )
        axes.xaxis.set_major_locator(MultipleLocator(25))
        axes.yaxis.set_major_locator(MultipleLocator(2 if window[1] - window[0] > 10 else 1))
        start = 100 * run.outcome.soc_initial
        axes.axhline(start, color=BLACK, linestyle=":", linewidth=1)
        axes.text(0.995, start, "start", transform=axes.get_yaxis_transform(), ha="right",
                  va="center", fontsize=9.5, bbox={"facecolor": "white", "pad": 1.5,
                  "linewidth": 0})  # fmt: skip
        bar = figure.colorbar(
            image, ax=axes, label="visits of the state [-]", pad=0.02, extend="min",
            extendfrac=0.1,
        )  # fmt: skip
        bar.ax.text(1.5, -0.07, "never", transform=bar.ax.transAxes, va="center")
        rows, columns = visits.shape
        axes.set_title(
            f"{run.row.label}, seed {run.seed}, after {run.episodes:,} episodes\n"
            f"{percent(never.mean())} of the {rows} x {columns} states never visited"
        )
    return figure
