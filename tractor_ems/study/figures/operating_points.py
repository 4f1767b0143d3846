"""Where on its efficiency curve the engine runs, for how long. The curve stands in for the paper's
normalised map, which it does not print."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tractor_ems.learning.rewards import GOOD_FROM_W, GOOD_TO_W
from tractor_ems.study.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    look,
    new_figure,
    percent,
    say_not_run,
)
from tractor_ems.study.figures.traces import LOW_POWER_KW, median_run
from tractor_ems.study.results import Outcome, StudyResults
from tractor_sim.config import load_powertrain
from tractor_sim.engine import efficiency

_BIN_KW = 5.0
_AREA_PT2 = 2500.0
"""Marker area of an engine that spends all its time in one bin."""


def build_conventional_points(results: StudyResults) -> Figure:
    """Operating points of the conventional tractor."""
    found = [item for item in results.baselines if item.id == "conventional"]
    with look():
        figure = new_figure(4.2)
        axes = figure.add_subplot()
        outcome = found[0].outcome if found else None
        _panel(axes, outcome, "Conventional", 0.41)
        axes.set_xlabel("engine power [kW]")
    return figure


def build_shaped_points(results: StudyResults) -> Figure:
    """Operating points of shaped DDQN, median seed, one panel per SOC_min."""
    with look():
        figure = new_figure(8.0)
        panels = figure.subplots(2, 1, sharex=True, sharey=True)
        for axes, soc_min in zip(panels, (0.70, 0.836), strict=True):
            runs = results.of(f"ddqn_shaped@{soc_min:g}")
            run = median_run(runs) if runs else None
            name = f"DDQN, shaped reward, SOC_min {percent(soc_min)}"
            if run is not None:
                name += f", seed {run.seed}"
            _panel(axes, run.outcome if run else None, name, 0.43)
        panels[-1].set_xlabel("engine power [kW]")
    return figure


def _panel(axes: Axes, outcome: Outcome | None, name: str, paper_efficiency: float) -> None:
    """Curve, the paper's good band, and circles whose area is the share of running time. One
    colour and one scale for every agent: the files are compared."""
    engine = load_powertrain("paper").engine
    power_w = np.linspace(0.0, engine.power_max_w, 500)
    axes.axvspan(GOOD_FROM_W / 1e3, GOOD_TO_W / 1e3, color=GREEN, alpha=0.13, linewidth=0)
    axes.text(
        (GOOD_FROM_W + GOOD_TO_W) / 2e3,
        2.0,
        f"paper's best region\n{GOOD_FROM_W / 1e3:g} to {GOOD_TO_W / 1e3:g} kW",
        ha="center",
        va="bottom",
        color="#00664a",
        fontsize=10,
    )
    axes.plot(power_w / 1e3, efficiency(engine, power_w) * 100, GREY, linewidth=1.2)
    axes.axvline(LOW_POWER_KW, color=GREY, linestyle=":", linewidth=1)
    axes.axhline(paper_efficiency * 100, color=GREY, linestyle="--", linewidth=1)
    axes.text(
        0.01,
        paper_efficiency * 100 + 0.7,
        f"paper, average {percent(paper_efficiency, 0)}",
        transform=axes.get_yaxis_transform(),
        color="#444444",
        fontsize=10,
        va="bottom",
    )
    axes.set(xlim=(0, engine.power_max_w / 1e3), ylim=(0, 52), ylabel="efficiency [%]", title=name)
    axes.set_xticks([*range(0, 251, 50), round(engine.power_max_w / 1e3)])
    axes.grid()
    if outcome is None:
        say_not_run(axes, name)
        return
    drive = outcome.trajectory
    on_w = drive.engine_power_w[drive.engine_on]
    edges_w = np.arange(0.0, engine.power_max_w + _BIN_KW * 1e3, _BIN_KW * 1e3)
    steps, _ = np.histogram(on_w, bins=edges_w)
    used = steps > 0
    centres_w = (edges_w[:-1] + edges_w[1:])[used] / 2
    if len(on_w):
        axes.scatter(
            centres_w / 1e3,
            efficiency(engine, centres_w) * 100,
            s=_AREA_PT2 * steps[used] / len(on_w),
            color=BLUE,
            alpha=0.6,
            linewidths=0,
        )
    # A reader cannot know what a circle's size means without one to compare.
    key = axes.scatter([], [], s=_AREA_PT2 * 0.1, color=BLUE, alpha=0.6, linewidths=0)
    axes.legend(
        [key],
        [f"10 % of the running time\nwithin {_BIN_KW:g} kW"],
        loc="lower right",
        handletextpad=0.8,
    )
    average = ""
    if outcome.efficiency is not None:
        average = f", average efficiency {percent(outcome.efficiency)}"
    axes.set_title(f"{name}\nengine on {percent(len(on_w) / len(drive), 0)} of the time{average}")
    if len(on_w):
        good = float(np.mean((on_w >= GOOD_FROM_W) & (on_w <= GOOD_TO_W)))
        low = float(np.mean(on_w < LOW_POWER_KW * 1e3))
        middle_kw = (GOOD_FROM_W + GOOD_TO_W) / 2e3
        region = f"between {GOOD_FROM_W / 1e3:g} and {GOOD_TO_W / 1e3:g} kW"
        _share(axes, middle_kw, good, region)
        _share(axes, LOW_POWER_KW / 2, low, f"below {LOW_POWER_KW:g} kW")


def _share(axes: Axes, power_kw: float, share: float, where: str) -> None:
    """How much of the engine's running time, between the curve and the label of the region."""
    text = f"{percent(share)} of\nrunning time\n{where}"
    axes.text(power_kw, 37.5, text, ha="center", va="top", fontsize=10, color=BLACK)
