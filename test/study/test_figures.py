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
from tractor_ems.study.paper_values import SUMMARY, episodes_of
from tractor_ems.study.results import Run, StudyResults
from tractor_ems.study.tables.measures import ABLATIONS

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
        found += [label.get_text() for label in axes.get_yticklabels()]
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
@pytest.mark.parametrize(
    "make", [full, pytest.param(single_seed, marks=pytest.mark.slow), with_gaps, nothing]
)
def test_every_figure_is_built_and_its_axes_carry_units(spec: FigureSpec, make):
    figure = spec.build(make())
    labels = [label for axes in figure.axes for label in numeric_labels(axes)]
    assert all("[" in label and "]" in label for label in labels), labels
    if spec.name != "powertrain":
        assert len(labels) >= 2
    assert "nan" not in texts(figure).lower()


@pytest.mark.parametrize(
    "name",
    [
        "reward_ddqn",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("powertrain", "state_visits", "pearson")
        ),
    ],
)
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


def test_the_legend_tells_optimum_and_myopic_greedy_apart_in_kg():
    found = texts(BY_NAME["reward_ddqn"].build(full()))
    for name, label in (("optimum", "exact optimum"), ("myopic", "myopic greedy")):
        fuel_kg = full().baseline(name, "fuel", 0.70).outcome.fuel_kg
        assert f"{label} −{fuel_kg:.2f} kg" in found


def test_the_greedy_line_is_the_curve_that_was_measured():
    for name, key, kg in (
        ("reward_ddqn", "ddqn@0.7", 0.01), ("reward_ddqn_shaped", "ddqn_shaped@0.7", 1.0)
    ):  # fmt: skip
        figure = BY_NAME[name].build(single_seed())
        curve = single_seed().of(key)[0].curve
        (greedy,) = (x for x in figure.axes[0].lines if str(x.get_label()).startswith("greedy"))
        assert np.array_equal(greedy.get_xdata(), curve.episode)
        assert np.allclose(greedy.get_ydata(), curve.eval_return * kg)


def test_a_row_that_converged_in_part_has_no_line_at_its_lower_bound():
    def with_climbing(count: int) -> StudyResults:
        """The first seeds of DDQN climb to their last evaluation."""

        def climb(run: Run) -> Run:
            if run.row.key != "ddqn@0.7" or run.seed >= count:
                return run
            curve = run.curve
            return replace(run, curve=replace(curve, eval_return=1.0 * curve.episode))

        return replace(full(), runs=tuple(climb(run) for run in full().runs))

    assert "here, converged" in texts(BY_NAME["reward_ddqn"].build(full()))
    # One seed of five lies outside the middle half, three do not.
    mixed = [with_climbing(1), with_climbing(3)]
    assert "(1 of 5 seeds did not)" in texts(BY_NAME["reward_ddqn"].build(mixed[0]))
    assert "not converged:\n3 of 5 seeds" in texts(BY_NAME["reward_ddqn"].build(mixed[1]))
    assert "here, converged" not in texts(BY_NAME["reward_ddqn"].build(mixed[1]))
    assert "> " in texts(BY_NAME["convergence"].build(mixed[1]))


def test_no_caption_promises_an_episode_that_the_paper_does_not_print():
    for spec in FIGURES:
        if spec.name.startswith("reward_"):
            promised = "and in the paper" in spec.caption
            assert promised == (episodes_of(spec.name.removeprefix("reward_")) is not None)


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


def test_states_are_drawn_in_kw_and_percent():
    axes = BY_NAME["state_visits"].build(full()).axes[0]
    demand_w = full().of("double_q@0.7")[0].outcome.trajectory.power_demand_w
    left, right, bottom, top = axes.images[0].get_extent()
    assert np.allclose([left, right], [demand_w.min() / 1e3, demand_w.max() / 1e3])
    assert np.allclose([bottom, top], [70.0, 90.0])


def test_the_table_falls_into_visited_feasible_and_the_rest():
    figure = BY_NAME["tabular"].build(full())
    # Synthetic: 3 % visited, 80 % feasible.
    found = {text.get_text() for text in figure.axes[1].texts}
    assert {"3.0 %", "77.0 %", "20.0 %"} <= found


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
    assert np.isclose(points.get_sizes().sum(), 2500.0)  # the area of all running time


def test_both_files_of_operating_points_print_the_same_two_shares():
    for name, outcomes in (
        ("points_conventional", [full().baseline("conventional").outcome]),
        ("points_ddqn_shaped", [full().of(f"ddqn_shaped@{x}")[2].outcome for x in (0.7, 0.836)]),
    ):
        figure = BY_NAME[name].build(full())
        for axes, outcome in zip(figure.axes, outcomes, strict=True):
            drive = outcome.trajectory
            on_w = drive.engine_power_w[drive.engine_on]
            good = 100 * np.mean((on_w >= 110e3) & (on_w <= 190e3))
            found = texts(figure)
            assert f"{100 * outcome.below_60kw_share:.1f} % of\nrunning time\nbelow 60 kW" in found
            assert f"{good:.1f} % of\nrunning time\nbetween 110 and 190 kW" in found
            assert axes.get_xlim() == (0.0, 275.0) and axes.get_ylim() == (0.0, 52.0)


def test_traces_show_what_was_driven():
    figure = BY_NAME["traces"].build(single_seed())
    labels = [axes.get_ylabel() for axes in figure.axes if axes.get_ylabel()]
    quantities = ["SOC [%]", "battery power [kW]", "engine power [kW]", "total power [kW]"]
    assert sorted(labels) == sorted(2 * quantities)
    for axes, key in zip(figure.axes, ("dqn@0.7", "ddqn@0.7"), strict=False):
        drive = single_seed().of(key)[0].outcome.trajectory
        soc = np.ravel(axes.lines[0].get_ydata())
        assert np.allclose(soc, 100 * np.append(drive.soc, drive.soc_final))
        assert "fuel reward, SOC_min 70.0 %" in axes.get_title(loc="left")


def test_the_papers_final_soc_is_marked_on_ddqn_alone():
    dqn, ddqn = BY_NAME["traces"].build(single_seed()).axes[:2]
    assert dqn.get_legend() is None and len(dqn.lines) == 1
    assert [t.get_text() for t in ddqn.get_legend().get_texts()] == ["paper, final SOC 70 %"]


def test_the_optimum_bars_are_the_baselines():
    figure = BY_NAME["optimum"].build(full())
    found = {text.get_text() for text in figure.axes[1].texts}
    for soc_min in (0.70, 0.836):
        outcome = full().baseline("optimum", "piecewise", soc_min).outcome
        assert f"{100 * outcome.soc_final:.1f}" in found


def test_ablations_show_the_paper_beside_its_own_rows_alone():
    figure = BY_NAME["ablations"].build(full())
    keys = [key for base, changed in ABLATIONS for key in (base, *changed)]
    printed = {row.id: row.fuel_gal for row in SUMMARY}
    drawn = {
        round(float(line.get_ydata()[0])): float(line.get_xdata()[0])
        for line in figure.axes[2].lines
        if line.get_marker() == "D"
    }
    wanted = {
        place: printed[key.split("@")[0]]
        for place, key in enumerate(keys)
        if key.split("@")[0] in printed
    }
    assert drawn == wanted
    assert not any(line.get_marker() == "D" for line in figure.axes[0].lines)


def test_convergence_has_a_lane_for_every_seed():
    axes = BY_NAME["convergence"].build(full()).axes[0]
    small = [line for line in axes.lines if line.get_markersize() < 4]
    assert len({float(line.get_ydata()[0]) for line in small}) == len(small)
    names = [label.get_text() for label in axes.get_yticklabels()]
    assert any(name.startswith("double Q-learning") for name in names)
