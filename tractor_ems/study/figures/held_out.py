"""Figures of the held-out study, from its results alone: scores, profiles, pairs, disturbances."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tractor_ems.study.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PINK,
    SKY,
    VERMILION,
    look,
    new_figure,
    say_not_run,
)
from tractor_ems.study.held_out_policies import DP
from tractor_msgs_py.atomic import write_bytes_with

DPI = 100
COLOURS = (BLUE, VERMILION, GREEN, ORANGE, SKY, PINK, BLACK, GREY)

Results = Mapping[str, Any]


def write_figures(results: Results, folder: Path) -> dict[str, str]:
    """Draw every figure into ``folder``; returns file name to caption.

    Raises:
        ConfigError: the folder cannot be written to.
    """
    made = {}
    for name, (draw, caption) in FIGURES.items():
        with look():
            figure = draw(results)
            write_bytes_with(
                folder / f"{name}.png",
                lambda file, figure=figure: figure.savefig(  # type: ignore[misc]
                    file, format="png", dpi=DPI, metadata={"Software": None}
                ),
            )
        made[f"{name}.png"] = caption
    return made


def causal(results: Results) -> list[str]:
    """Policies that know no future, best median first."""
    figures = results["policies"]
    names = [name for name in figures if name != DP]
    return sorted(names, key=lambda name: (-figures[name]["median"], name))


def shown(results: Results) -> list[str]:
    """The subject and its opponents, then learned policies and tables: what lines are drawn of."""
    settings = results["settings"]
    more = [item["name"] for item in (*settings["learners"], *settings["tables"])]
    return list(dict.fromkeys([settings["subject"], *settings["opponents"], *more]))


def colours(results: Results) -> dict[str, str]:
    """One colour per policy in all figures."""
    return {name: COLOURS[n % len(COLOURS)] for n, name in enumerate(shown(results))}


def _scores(results: Results, policy: str) -> np.ndarray[Any, Any]:
    return np.array([r["dp_ratio"] or 0.0 for r in results["rows"] if r["policy"] == policy])


def _floor(results: Results) -> float:
    """Where score axes begin: failed runs and the far tail are counted in tables, not drawn."""
    all_scores = np.concatenate([_scores(results, name) for name in causal(results)])
    done = all_scores[all_scores > 0.0]
    low = float(np.quantile(done, 0.02)) if done.size else 0.0
    return max(min(low, 0.985) - 0.01, 0.0)


def _ratios(results: Results) -> Figure:
    names = causal(results)[::-1]
    figure = new_figure(0.9 + 0.34 * len(names))
    axes = figure.subplots()
    rng = np.random.Generator(np.random.PCG64(0))
    for place, name in enumerate(names):
        scores = _scores(results, name)
        own = name == results["settings"]["subject"]
        axes.scatter(
            scores,
            place + rng.uniform(-0.28, 0.28, len(scores)),
            s=5,
            alpha=0.45,
            color=VERMILION if own else GREY,
            linewidths=0,
        )
        low, middle, high = np.quantile(scores, (0.25, 0.5, 0.75))
        axes.hlines(place, low, high, color=BLACK, linewidth=1.2)
        axes.plot(middle, place, "|", color=BLUE, markersize=14, markeredgewidth=2.2)
    bars = results["settings"]["bars"]
    axes.axvline(bars["median"], color=BLUE, linestyle="--", linewidth=1)
    axes.axvline(bars["worst"], color=VERMILION, linestyle=":", linewidth=1)
    axes.set_yticks(range(len(names)), names)
    axes.set_xlim(_floor(results), 1.001)
    axes.set_xlabel("dp_ratio")
    axes.grid(axis="x")
    return figure


def _profile(results: Results) -> Figure:
    figure = new_figure(3.6)
    axes = figure.subplots()
    at = np.linspace(_floor(results), 1.0, 400)
    for name, colour in colours(results).items():
        scores = _scores(results, name)
        own = name == results["settings"]["subject"]
        share = (scores[:, None] >= at).mean(axis=0)
        axes.plot(at, share, color=colour, label=name, linewidth=2.2 if own else 1.3)
    axes.set_xlabel("dp_ratio of at least")
    axes.set_ylabel("share of runs")
    axes.set_ylim(0.0, 1.02)
    axes.grid()
    axes.legend(loc="lower left")
    return figure


def _operations(results: Results) -> Figure:
    tint = colours(results)
    operations = list(next(iter(results["per_operation"].values())))
    figure = new_figure(3.8)
    axes = figure.subplots()
    width = 0.8 / len(tint)
    for n, (name, colour) in enumerate(tint.items()):
        found = results["per_operation"][name]
        x = np.arange(len(operations)) + (n - 0.5 * (len(tint) - 1)) * width
        middle = np.array([found[o]["median"] for o in operations])
        worst = np.array([found[o]["worst"] for o in operations])
        axes.vlines(x, worst, middle, color=colour, linewidth=1.2)
        axes.scatter(x, middle, color=colour, s=26, label=name, zorder=3)
        axes.scatter(x, worst, color=colour, s=12, marker="v", zorder=3)
    axes.axhline(results["settings"]["bars"]["median"], color=GREY, linestyle="--", linewidth=1)
    axes.set_xticks(range(len(operations)), operations)
    axes.set_ylim(_floor(results), 1.001)
    axes.set_ylabel("dp_ratio: median, worst")
    axes.grid(axis="y")
    axes.legend(loc="lower center", ncols=4, bbox_to_anchor=(0.5, 1.0))
    return figure


def _improvement(results: Results) -> Figure:
    settings = results["settings"]
    found = results["pairwise"][settings["subject"]]
    others = [name for name in settings["opponents"] if name in found]
    figure = new_figure(1.0 + 0.26 * len(others) * len(found[others[0]]))
    axes = figure.subplots()
    labels, place = [], 0.0
    for n, other in enumerate(others):
        for where, interval in found[other].items():
            colour = COLOURS[(n + 1) % len(COLOURS)]
            axes.plot([interval["low"], interval["high"]], [place, place], color=colour)
            axes.plot(interval["value"], place, "o", color=colour, markersize=5)
            labels.append((place, f"{other}: {where}"))
            place -= 1.0
        place -= 0.6
    axes.axvline(0.5, color=GREY, linestyle="--", linewidth=1)
    axes.set_yticks([at for at, _ in labels], [text for _, text in labels])
    axes.set_xlim(-0.02, 1.02)
    axes.set_xlabel(f"probability that {settings['subject']} scores higher")
    axes.grid(axis="x")
    return figure


def _curve(results: Results) -> Figure:
    figure = new_figure(3.2)
    panels = figure.subplots(1, 3, sharey=True)
    points = results["curve"]
    bars = results["settings"]["bars"]
    for axes, key in zip(panels, ("episodes", "transitions", "seconds"), strict=True):
        assert isinstance(axes, Axes)
        if not points:
            say_not_run(axes, "learning curve")
            continue
        if key != "seconds":
            axes.set_xscale("log")
        for what, colour, mark in (("median", BLUE, "o"), ("worst", VERMILION, "v")):
            x = [item[key] for item in points]
            y = [_of(item["dp_ratio"], what) for item in points]
            axes.plot(x, y, mark, color=colour, alpha=0.6, label=f"{what} of a run")
        axes.set_xlabel(key)
        axes.grid()
    if points:
        panels[0].axvline(bars["paper_episodes"], color=GREY, linestyle="--")
        panels[0].text(
            bars["paper_episodes"], 0.02, " the paper's", rotation=90, color=GREY, fontsize=9,
            transform=panels[0].get_xaxis_transform(), ha="right",
        )  # fmt: skip
        panels[0].set_ylabel("dp_ratio on dev cycles")
        panels[0].legend(loc="lower right")
        done = [_of(item["dp_ratio"], what) for item in points for what in ("median", "worst")]
        panels[0].set_ylim(max(min(x for x in done if x > 0.0) - 0.01, 0.0), 1.001)
    return figure


def _of(scores: list[float | None], what: str) -> float:
    values = [score or 0.0 for score in scores]
    return float(np.median(values)) if what == "median" else float(min(values))


def _robustness(results: Results) -> Figure:
    table = results["robustness"]
    if not table:
        figure = new_figure(2.0)
        say_not_run(figure.subplots(), "disturbances")
        return figure
    names = [name for name in causal(results) if name in table]
    listed = list(table[names[0]])
    loss = np.array(
        [
            [np.nan if table[n][d]["loss"] is None else 100 * table[n][d]["loss"] for d in listed]
            for n in names
        ]
    )
    figure = new_figure(1.4 + 0.32 * len(names))
    axes = figure.subplots()
    image = axes.imshow(loss, aspect="auto", cmap="RdBu_r", vmin=-2.0, vmax=2.0)
    for row, name in enumerate(names):
        for column, disturbance in enumerate(listed):
            cell = table[name][disturbance]
            text = "-" if cell["loss"] is None else f"{100 * cell['loss']:.2f}"
            mark = f"\n{cell['failed']} failed" if cell["failed"] else ""
            dark = cell["loss"] is not None and abs(cell["loss"]) > 0.015
            axes.text(
                column, row, text + mark, ha="center", va="center", fontsize=7,
                color="white" if dark else BLACK,
            )  # fmt: skip
    axes.set_xticks(range(len(listed)), listed, rotation=40, ha="right")
    axes.set_yticks(range(len(names)), names)
    figure.colorbar(image, ax=axes, label="loss, points of dp_ratio", shrink=0.8)
    return figure


def _traces(results: Results) -> Figure:
    traces = {cycle: found for cycle, found in results["traces"].items() if found}
    if not traces:
        figure = new_figure(2.0)
        say_not_run(figure.subplots(), "traces")
        return figure
    figure = new_figure(4.6)
    panels = figure.subplots(2, len(traces), sharex="col", squeeze=False)
    tint = {**colours(results), DP: BLACK}
    for column, (cycle, found) in enumerate(traces.items()):
        power, soc = panels[0][column], panels[1][column]
        for name, trace in found.items():
            minutes = np.array(trace["time_s"]) / 60.0
            own = name == results["settings"]["subject"]
            if name == next(iter(found)):
                power.fill_between(minutes, trace["demand_kw"], color=GREY, alpha=0.25, lw=0)
            power.plot(minutes, trace["engine_kw"], color=tint[name], lw=1.4 if own else 0.9)
            soc.plot(minutes, trace["soc"], color=tint[name], label=name)
        power.set_title(cycle)
        soc.set_xlabel("min")
        soc.grid()
    panels[0][0].set_ylabel("demand (grey), engine, kW")
    panels[1][0].set_ylabel("SOC")
    panels[1][0].legend()
    return figure


FIGURES = {
    "ratios": (
        _ratios,
        "Score of every run by policy, best median first, with quartiles; dashed: the bar of the "
        "median, dotted: of the worst. Failed runs lie left of the axis.",
    ),
    "profile": (_profile, "Share of runs that score at least so much."),
    "operations": (_operations, "Median (dot) and worst (triangle) by operation."),
    "improvement": (
        _improvement,
        "Paired probability of improvement with its 95 % interval, overall and by operation.",
    ),
    "learning_curve": (
        _curve,
        "Learning curve on dev cycles: each point a training from so many recorded runs.",
    ),
    "robustness": (
        _robustness,
        "Loss in points of dp_ratio under each disturbance, and failed runs.",
    ),
    "traces": (_traces, "Engine power and SOC of two cycles beside the optimum's plan."),
}
