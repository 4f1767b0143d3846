"""Pictures and table of docs/duty-cycles.md: measured jobs against their doubles, every operation.

Make them again with ``python -m tractor_ems.plots_cycles docs/duty_cycles``.
"""

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tractor_ems.plots import COLOURS
from tractor_msgs_py.atomic import write_bytes_with
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.duty_cycle.field_work.params import operations
from tractor_sim.duty_cycle.field_work.statistics import (
    aligned,
    measured_template,
    pass_bounds,
    variance_share,
)
from tractor_sim.duty_cycle.generate import MEASURED_JOBS, OPERATIONS, Work, generate, work_of

SEEDS = range(101, 113)
SESSION_S = 7520
"""As long as the recording."""

_PASS_BAND_S = (48.0, 134.0)
_BAND_EDGES_S = (2.0, 6.0, 16.0, 48.0, 134.0, 375.0, 7520.0)


def plot_measured_jobs(path: Path) -> None:
    """Pass template (mean, p10-p90) and variance by period, measured and generated.

    Args:
        path: PNG to write.
    """
    figure = Figure(figsize=(10, 6.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 2, width_ratios=(1.7, 1))
    for row, name in zip(axes, MEASURED_JOBS, strict=True):
        works = [work_of(name, seed, duration_s=SESSION_S) for seed in SEEDS]
        _template(row[0], name, works)
        _spectrum(row[1], works)
    write_bytes_with(path, lambda file: figure.savefig(file, format="png", dpi=80))


def _template(axes: Axes, name: str, works: list[Work]) -> None:
    job = f"job_{name[-1].upper()}"
    measured = measured_template(job)
    rated_w = operations().vehicle.rated_power_w
    windows = np.concatenate(
        [aligned(w.power_w / rated_w, pass_bounds(w.working), measured.time_s) for w in works]
    )
    low, high = np.quantile(windows, (0.1, 0.9), axis=0)
    time_s = measured.time_s
    axes.fill_between(time_s, low, high, color=COLOURS[0], alpha=0.2, lw=0)
    axes.plot(time_s, windows.mean(axis=0), COLOURS[0], label="generated")
    axes.plot(time_s, measured.mean, "black", label="measured")
    axes.plot(time_s, measured.p10, "black", lw=0.8, ls=":", label="p10, p90 (generated: band)")
    axes.plot(time_s, measured.p90, "black", lw=0.8, ls=":")
    counts = f"{measured.passes} measured, {len(windows)} generated passes"
    axes.set_title(f"{name}: {counts}", fontsize="medium")
    axes.set_ylabel("power / rated power")
    axes.set_xlabel("time from the start of the pass [s]")
    axes.set_ylim(0, 1.05)
    if name == MEASURED_JOBS[-1]:
        axes.legend(fontsize="small", loc="lower center")
    axes.grid(alpha=0.3)


def _spectrum(axes: Axes, works: list[Work]) -> None:
    edges = _BAND_EDGES_S
    bands = list(pairwise(edges))
    shares: FloatArray = np.array(
        [[variance_share(w.power_w, low, high) for low, high in bands] for w in works]
    )
    inside = [band == _PASS_BAND_S for band in bands]
    colours = [COLOURS[0] if here else "lightgrey" for here in inside]
    axes.bar(range(len(bands)), shares.mean(axis=0) * 100, color=colours)
    where = inside.index(True)
    axes.errorbar(where, 55, yerr=8, color="black", capsize=6, marker="_", ms=14)
    axes.text(where + 0.45, 57, "measured 55 %,\nallowed +-8", fontsize="small")
    axes.set_xticks(range(len(bands)), [f"{low:g}-{high:g}" for low, high in bands], fontsize=7)
    axes.set_xlabel("period [s]")
    axes.set_ylabel("share of variance [%]")
    axes.set_title(f"generated: {shares[:, where].mean():.0%} at 48-134 s", fontsize="medium")


def plot_operations(path: Path, seed: int = 2) -> None:
    """Demand of every operation, one seed each.

    Args:
        path: PNG to write.
        seed: of all of them.
    """
    figure = Figure(figsize=(11, 11), layout="constrained")
    FigureCanvasAgg(figure)
    names = (*OPERATIONS, *MEASURED_JOBS)
    for axes, name in zip(figure.subplots(7, 2, sharex=True).ravel(), names, strict=True):
        demand_kw = generate(name, seed).power_demand_w / 1e3
        axes.plot(np.arange(len(demand_kw)) / 60, demand_kw, COLOURS[0], lw=0.6, aa=False)
        axes.axhline(0, color="black", lw=0.5)
        axes.set_title(f"{name}_{seed}: mean {demand_kw.mean():.0f} kW", fontsize="small")
        axes.set_xlim(0, len(demand_kw) / 60)
        axes.grid(alpha=0.3)
    figure.supxlabel("time [min]", fontsize="small")
    figure.supylabel("demand at the bus [kW]", fontsize="small")
    write_bytes_with(path, lambda file: figure.savefig(file, format="png", dpi=70))


def operation_table(seeds: range = range(1, 31)) -> str:
    """Markdown table of mean, peak and area over seeds, one row per operation."""
    lines = ["| operation | mean [kW] | peak [kW] | lowest [kW] | ha/h |", "|---|---|---|---|---|"]
    for name in (*OPERATIONS, *MEASURED_JOBS):
        cycles = [generate(name, seed) for seed in seeds]
        means = [cycle.power_demand_w.mean() / 1e3 for cycle in cycles]
        peak = max(cycle.power_demand_w.max() for cycle in cycles) / 1e3
        lowest = min(cycle.power_demand_w.min() for cycle in cycles) / 1e3
        areas = [2.0 * cycle.area_ha for cycle in cycles if cycle.area_ha is not None]
        area = f"{np.mean(areas):.1f}" if areas else "-"
        lines.append(
            f"| `{name}` | {np.mean(means):.0f} ({min(means):.0f}-{max(means):.0f}) "
            f"| {peak:.0f} | {lowest:.0f} | {area} |"
        )
    return "\n".join(lines)


def main(folder: Path) -> None:
    """Write both pictures into a folder and print the table."""
    folder.mkdir(parents=True, exist_ok=True)
    plot_measured_jobs(folder / "measured_jobs.png")
    plot_operations(folder / "operations.png")
    print(operation_table())


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "docs/duty_cycles"))
