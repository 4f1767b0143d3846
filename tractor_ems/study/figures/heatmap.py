"""Which states the tabular double Q-learning agent met, how often, and which never."""

import matplotlib
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from tractor_ems.study.figures.style import GREY, look, new_figure, percent, say_not_run
from tractor_ems.study.figures.traces import median_run
from tractor_ems.study.results import StudyResults


def build_heatmap(results: StudyResults) -> Figure:
    """Visits of every (SOC bin, demand bin), log colour; never visited is outside the scale."""
    runs = [run for run in results.of("double_q@0.7") if run.table is not None]
    with look():
        figure = new_figure(4.6)
        axes = figure.add_subplot()
        axes.set(xlabel="demand bin [-], low to high power", ylabel="SOC bin [-], low to high")
        if not runs:
            say_not_run(axes, "double Q-learning")
            return figure
        run = median_run(runs)
        assert run.table is not None
        visits = run.table.state_visits
        never = visits == 0
        # Masked states show the white ground, which cividis (dark blue to yellow) does not hold.
        image = axes.imshow(
            np.ma.masked_array(visits, never),
            origin="lower",
            aspect="auto",
            interpolation="nearest",
            norm=LogNorm(1, max(int(visits.max()), 10)),
            cmap=matplotlib.colormaps["cividis"],
        )
        axes.grid(visible=False)
        figure.colorbar(image, ax=axes, label="visits of the state [-]", pad=0.02)
        rows, columns = visits.shape
        axes.set_title(
            f"{run.row.label}, seed {run.seed}, after {run.episodes:,} episodes\n"
            f"{percent(never.mean())} of the {rows} x {columns} states never visited"
        )
        axes.legend(
            handles=[Patch(facecolor="white", edgecolor=GREY, label="never visited")],
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            borderaxespad=0.2,
        )
    return figure
