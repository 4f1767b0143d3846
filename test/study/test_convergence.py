"""The convergence rule finds a known episode, and refuses every curve that only looks settled."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tractor_ems.study.convergence import (
    Convergence,
    compare_speed,
    converged,
    convergence_over_seeds,
    reached_optimum,
    running_median,
)
from tractor_ems.study.paper_values import episodes_of, episodes_text
from tractor_msgs_py.errors import ConfigError


def rng(seed=0):
    return np.random.default_rng(seed)


def episodes(count):
    return np.arange(count, dtype=np.int64) * 100


def step_curve(at, count=100, low=-500.0, high=-100.0):
    return np.where(np.arange(count) >= at, high, low)


def done(*values):
    return [Convergence(value, 1000, "") for value in values]


def cut(count, budget=1000):
    return [Convergence(None, budget, "too late")] * count


@pytest.mark.parametrize("at", [3, 20, 79])
def test_a_step_converges_where_it_is(at):
    assert converged(episodes(100), step_curve(at)).episodes == 100 * at


def test_the_level_is_95_percent_of_the_way_though_returns_are_negative():
    # 95 % of a final value of -100 would be -95, which the curve never reaches.
    climb = np.minimum(np.arange(100) / 40.0, 1.0)
    assert converged(episodes(100), -500.0 + 400.0 * climb).episodes == 3800


@given(st.integers(20, 300), st.floats(-1e3, 1e3), st.floats(1e-2, 1e4), st.floats(0.05, 0.6))
def test_scale_and_offset_of_the_return_do_not_matter(count, offset, scale, share):
    climb = np.minimum(np.arange(count) / (share * count), 1.0) ** 2
    plain, moved = (converged(episodes(count), curve) for curve in (climb, offset + scale * climb))
    # Rounding may move an evaluation that lies on the level exactly.
    assert (plain.episodes is None) == (moved.episodes is None)
    assert abs((plain.episodes or 0) - (moved.episodes or 0)) <= 100


@pytest.mark.parametrize("count", [20, 60, 101, 1000])
def test_a_curve_that_still_climbs_evenly_has_not_converged(count):
    result = converged(episodes(count), np.linspace(-500.0, -100.0, count))
    assert result.episodes is None
    assert result.censored_at == 100 * (count - 1)
    assert "too late" in result.reason


def test_a_curve_that_falls_back_counts_from_its_return():
    curve = step_curve(20)
    curve[50:60] = -400.0
    assert converged(episodes(100), curve).episodes == 6000


def test_two_bad_evaluations_in_a_row_are_noise():
    curve = step_curve(20)
    curve[50:52] = -400.0
    assert converged(episodes(100), curve).episodes == 2000


@pytest.mark.parametrize("curve", [step_curve(30)[::-1], np.full(100, -3.0)])
def test_a_curve_that_does_not_improve_is_censored_with_the_reason(curve):
    result = converged(episodes(100), curve)
    assert result.episodes is None
    assert "no better than its first" in result.reason


def test_an_oscillating_curve_is_censored():
    curve = np.where(np.arange(100) // 5 % 2 == 0, -100.0, -300.0)
    curve[0] = -500.0
    assert converged(episodes(100), curve).episodes is None


def test_too_few_evaluations_are_censored_not_guessed():
    assert "10 evaluations" in converged(episodes(10), step_curve(1, 10)).reason
    assert converged(episodes(20), step_curve(1, 20)).episodes == 100
    assert "4 evaluations" in reached_optimum(episodes(4), np.zeros(4), -1.0, 0.0).reason


def test_a_settled_curve_need_not_be_optimal():
    curve = step_curve(20, high=-100.0)
    assert converged(episodes(100), curve).episodes == 2000
    assert reached_optimum(episodes(100), curve, -500.0, -100.0).episodes == 2000
    assert reached_optimum(episodes(100), curve, -500.0, -90.0).episodes == 2000
    assert reached_optimum(episodes(100), curve, -500.0, -70.0).episodes is None


def test_a_running_median_keeps_steps_and_drops_spikes():
    assert running_median(np.array([0.0, 0, 0, 1, 1, 1])).tolist() == [0, 0, 0, 1, 1, 1]
    assert running_median(np.array([0.0, 0, 0, 9, 9, 0, 0, 0])).max() == 0.0


@pytest.mark.parametrize(
    ("at", "returns", "field"),
    [
        ([0, 1], [1.0], "eval_return"),
        ([], [], "eval_return"),
        ([0, 0], [1.0, 2.0], "episode"),
        ([0, 1], [1.0, np.nan], "eval_return"),
    ],
)
def test_malformed_curves_are_refused(at, returns, field):
    with pytest.raises(ConfigError, match=field):
        converged(np.array(at, dtype=np.int64), np.array(returns))


def test_an_optimum_that_random_beats_is_refused():
    with pytest.raises(ConfigError, match="optimum_return"):
        reached_optimum(episodes(20), step_curve(3, 20), -1.0, -2.0)


def test_a_row_reports_its_interquartile_mean():
    row = convergence_over_seeds(done(300, 100, 200, 500, 400), rng())
    assert row.episodes.value == 300.0
    assert row.episodes.low < 300.0 < row.episodes.high
    assert (row.censored, row.lower_bound, row.note) == (0, False, "")


def test_one_censored_seed_of_five_is_outside_the_middle_half():
    row = convergence_over_seeds(done(100, 200, 300, 400) + cut(1), rng())
    assert row.episodes.value == 300.0
    assert not row.lower_bound
    assert row.text.endswith("1 of 5 seeds censored")
    assert "counted at it" in row.note


def test_a_row_of_censored_seeds_is_a_lower_bound():
    row = convergence_over_seeds(cut(5, 40_000), rng())
    assert row.text == "> 40,000 (5 of 5 seeds censored)"
    some = convergence_over_seeds(done(100, 200) + cut(3), rng())
    assert some.lower_bound
    assert some.text.startswith("> ")


def test_a_seed_cut_off_earlier_than_another_converged_makes_a_lower_bound():
    assert convergence_over_seeds(done(100, 200, 300, 400) + cut(1, 50), rng()).lower_bound


def test_speed_is_decided_and_swapping_the_rows_turns_it_round():
    fast, slow = done(90, 100, 110, 95, 105), done(390, 400, 410, 395, 405)
    forth, back = compare_speed(fast, slow, rng()), compare_speed(slow, fast, rng())
    assert (forth.verdict, back.verdict) == ("yes", "no")
    assert forth.saving.value == pytest.approx(0.75)
    assert (forth.sooner.value, back.sooner.value) == (1.0, 0.0)


def test_rows_that_overlap_are_not_resolved():
    result = compare_speed(done(90, 300, 200, 500, 105), done(100, 310, 190, 480, 115), rng())
    assert result.verdict == "not resolved"
    assert "includes equality" in result.reason


def test_equal_rows_are_not_resolved():
    result = compare_speed(done(*[200] * 5), done(*[200] * 5), rng())
    assert (result.verdict, result.sooner.value) == ("not resolved", 0.5)


def test_four_seeds_decide_nothing():
    result = compare_speed(done(90, 100, 110, 95), done(390, 400, 410, 395), rng())
    assert result.verdict == "not resolved"
    assert "5 are needed" in result.reason


def test_a_row_that_never_converged_can_be_slower_but_never_faster():
    early = done(90, 100, 110, 95, 105)
    assert compare_speed(early, cut(5), rng()).verdict == "yes"
    assert compare_speed(cut(5), early, rng()).verdict == "no"
    # Cut off at 50 episodes it looks faster than 100: nobody knows.
    unknown = compare_speed(cut(5, 50), early, rng())
    assert (unknown.verdict, unknown.sooner.value) == ("not resolved", 0.5)
    assert "censored" in unknown.reason
    assert compare_speed(cut(5), cut(5), rng()).sooner.value == 0.5


def test_episodes_are_written_as_in_the_paper():
    assert episodes_text(37000) == "37,000"
    assert episodes_text(episodes_of("ddqn")) == "9,000"
    assert Convergence(None, 40_000, "x").text == "> 40,000"
    assert episodes_of("double_q") is None
