"""Figures are functions of the results: axes carry units, the paper's values are marked, missing
rows leave an empty panel that says so, and equal results give equal bytes."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from study.synthetic import DEFAULT_PLANS, Plan, build_results

from tractor_ems.study.figures import FIGURES, FigureSpec
from tractor_ems.study.figures.style import write_png_and_svg
from tractor_ems.study.results import StudyResults

CURVES = [
    "reward_double_q", "reward_dqn", "reward_ddqn", "reward_ddqn_shaped",
    "reward_ddqn_shaped_dp", "reward_ddqn_shaped_mixed",
]  # fmt: skip
BY_NAME = {spec.name: spec for spec in FIGURES}
DPI = 30


@lru_cache(maxsize=1)
def full() -> StudyResults:
    return build_results()


@lru_cache(maxsize=1)
def single_seed() -> StudyResults:
    return build_results(seeds=1)


@lru_cache(maxsize=1)
def with_gaps() -> StudyResults:
    gone = {"ddqn_shaped_dp@0.7", "dqn@0.7", "ddqn_shaped_rule@0.7", "ddqn_fuel_knots@0.7"}
    results = full()
    return replace(results, runs=tuple(run for run in results.runs if run.row.key not in gone))


def nothing() -> StudyResults:
    return replace(full(), runs=(), baselines=())


def texts(figure: Figure) -> str:
    """Everything that is written in a figure."""
    found = [text.get_text() for axes in figure.axes for text in axes.texts]
    for axes in figure.axes:
        found += [axes.get_title(loc="left"), axes.get_xlabel(), axes.get_ylabel()]
        legend = axes.get_legend()
        if legend is not None:
            found += [text.get_text() for text in legend.get_texts()]
            found.append(legend.get_title().get_text())
    for legend in figure.legends:
        found += [text.get_text() for text in legend.get_texts()]
    return "\n".join(found)


def numeric_labels(axes: Axes) -> list[str]:
    """Labels of the axes that count something: categories and hidden axes need no unit."""
    if not axes.axison:
        return []
    found = []
    for axis, label in ((axes.xaxis, axes.get_xlabel()), (axes.yaxis, axes.get_ylabel())):
        named = any(any(c.isalpha() for c in t.get_text()) for t in axis.get_majorticklabels())
        if label or not (named or axis.get_tick_params().get("labelleft") is False):
            found.append(label)
    return [label for label in found if label]


def test_names_are_unique_and_every_reward_curve_is_a_figure_of_its_own():
    assert len(BY_NAME) == len(FIGURES)
    assert set(CURVES) <= set(BY_NAME)


@pytest.mark.parametrize("spec", FIGURES, ids=lambda spec: spec.name)
@pytest.mark.parametrize("make", [full, single_seed, with_gaps, nothing])
def test_every_figure_is_built_and_its_axes_carry_units(spec: FigureSpec, make):
    figure = spec.build(make())
    labels = [label for axes in figure.axes for label in numeric_labels(axes)]
    assert all("[" in label and "]" in label for label in labels), labels
    if spec.name != "powertrain":
        assert len(labels) >= 2
    assert "nan" not in texts(figure).lower()


@pytest.mark.parametrize("name", ["powertrain", "state_visits", "pearson", "reward_ddqn"])
def test_equal_results_give_equal_bytes(tmp_path: Path, name: str):
    for turn in ("a", "b"):
        figure = BY_NAME[name].build(full())
        write_png_and_svg(figure, tmp_path / f"{turn}.png", tmp_path / f"{turn}.svg", DPI)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()


def test_a_convergence_of_the_paper_beyond_the_axis_is_pointed_at():
    assert "37,000 →" in texts(BY_NAME["reward_ddqn_shaped"].build(full()))


def test_a_convergence_of_the_paper_within_the_axis_is_a_line_there():
    figure = BY_NAME["reward_ddqn"].build(build_results(seeds=1, episodes=12_000))
    lines = [line for axes in figure.axes for line in axes.lines]
    assert any(np.allclose(line.get_xdata(), 9_000) for line in lines)
    assert "→" not in texts(figure)


def test_shaped_curves_have_a_panel_for_each_soc_min():
    for name in CURVES:
        titles = [axes.get_title(loc="left") for axes in BY_NAME[name].build(full()).axes]
        if "shaped" in name:
            assert len(titles) == 2 and "70.0 %" in titles[0] and "83.6 %" in titles[1]
        else:
            assert len(titles) == 1


def test_a_curve_shows_the_optimum_and_random_of_its_own_reward():
    figure = BY_NAME["reward_ddqn_shaped"].build(full())
    for axes, soc_min in zip(figure.axes, (0.70, 0.836), strict=True):
        levels = {float(np.ravel(line.get_ydata())[0]) for line in axes.lines
                  if len(np.ravel(line.get_ydata())) == 2}  # fmt: skip
        for name in ("optimum", "random_feasible"):
            wanted = full().baseline(name, "piecewise", soc_min).outcome.reward_sum
            assert any(np.isclose(level, wanted) for level in levels)


def test_the_greedy_line_is_the_curve_that_was_measured():
    figure = BY_NAME["reward_ddqn"].build(single_seed())
    curve = single_seed().of("ddqn@0.7")[0].curve
    lines = {line.get_label(): line for line in figure.axes[0].lines}
    assert np.array_equal(lines["greedy"].get_xdata(), curve.episode)
    assert np.allclose(lines["greedy"].get_ydata(), curve.eval_return)


def test_a_row_that_was_not_run_leaves_a_panel_that_says_so():
    assert "not run" in texts(BY_NAME["reward_ddqn_shaped_dp"].build(with_gaps()))
    assert "not run" in texts(BY_NAME["convergence"].build(with_gaps()))
    assert "not run" in texts(BY_NAME["ablations"].build(with_gaps()))


def test_never_visited_states_are_masked_not_dark():
    figure = BY_NAME["state_visits"].build(full())
    drawn = figure.axes[0].images[0].get_array()
    table = full().of("double_q@0.7")[2].table
    assert drawn is not None and table is not None
    assert np.ma.is_masked(drawn)
    # The synthetic agent never left the SOC bins 20 to 37.
    assert np.ma.getmaskarray(drawn)[:20].all() and np.ma.getmaskarray(drawn)[38:].all()


def test_the_papers_correlation_is_marked_on_its_scale_and_every_seed_is_a_dot():
    figure = BY_NAME["pearson"].build(full())
    scale = figure.axes[1]
    points = {line.get_label(): np.ravel(line.get_xdata()) for line in scale.lines}
    assert list(points["paper −0.213"]) == [-0.213]
    found = [run.table.pearson for run in full().of("double_q@0.7") if run.table is not None]
    assert list(points["here, one dot a seed"]) == found
    words = [text.get_text() for text in scale.texts]
    assert sorted(words) == sorted(["strong", "moderate", "weak"] * 2)


def test_an_undefined_correlation_is_said():
    plans = {**DEFAULT_PLANS, "double_q": Plan(0.5, "poor", pearson=None)}
    results = build_results(plans=plans)
    assert "undefined" in texts(BY_NAME["pearson"].build(results))
    assert "undefined" in texts(BY_NAME["tabular"].build(results))


def test_marker_areas_are_shares_of_running_time():
    figure = BY_NAME["points_conventional"].build(full())
    points = next(c for c in figure.axes[0].collections if len(c.get_offsets()) > 1)
    assert np.isclose(points.get_sizes().sum(), 1500.0)  # the area of all running time


def test_traces_show_what_was_driven():
    figure = BY_NAME["traces"].build(single_seed())
    labels = [axes.get_ylabel() for axes in figure.axes if axes.get_ylabel()]
    assert labels == ["SOC [%]", "battery power [kW]", "engine power [kW]", "total power [kW]"]
    for axes, key in zip(figure.axes, ("dqn@0.7", "ddqn@0.7"), strict=False):
        drive = single_seed().of(key)[0].outcome.trajectory
        soc = np.ravel(axes.lines[0].get_ydata())
        assert np.allclose(soc, 100 * np.append(drive.soc, drive.soc_final))


def test_the_optimum_bars_are_the_baselines():
    figure = BY_NAME["optimum"].build(full())
    found = {text.get_text() for text in figure.axes[1].texts}
    for soc_min in (0.70, 0.836):
        outcome = full().baseline("optimum", "piecewise", soc_min).outcome
        assert f"{100 * outcome.soc_final:.1f}" in found
