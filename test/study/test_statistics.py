"""The statistics agree with sets whose answers are known, and say when they have none."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tractor_ems.study.statistics import (
    difference_interval,
    interquartile_mean,
    iqm_band,
    iqm_interval,
    pearson,
    probability_of_improvement,
    ratio_interval,
    strength_of,
)
from tractor_msgs_py.errors import ConfigError

SETS = st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=40)


def rng(seed=0):
    return np.random.default_rng(seed)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([7.0], 7.0),
        ([1.0, 2.0, 3.0, 100.0], 2.5),
        ([1.0, 2.0, 3.0, 4.0, 5.0], 3.0),
        ([0.0, 0.0, 1.0, 4.0, 90.0], (0.75 * 0.0 + 1.0 + 0.75 * 4.0) / 2.5),
        ([-50.0, 1.0, 1.0, 2.0, 2.0, 3.0, 3.0, 900.0], 2.0),
    ],
)
def test_the_interquartile_mean_of_known_sets(values, expected):
    assert interquartile_mean(np.array(values)) == pytest.approx(expected, abs=1e-12)


def test_one_wild_seed_of_five_does_not_move_the_interquartile_mean():
    assert interquartile_mean(np.array([1.0, 2.0, 3.0, 4.0, 1e9])) == pytest.approx(3.0)


@given(SETS)
def test_the_interquartile_mean_lies_between_the_quartiles(values):
    low, high = np.percentile(values, [25, 75])
    slack = 1e-9 * (1.0 + max(map(abs, values)))
    assert low - slack <= interquartile_mean(np.array(values)) <= high + slack


@given(SETS, st.randoms(use_true_random=False))
def test_the_interquartile_mean_does_not_depend_on_the_order(values, random):
    shuffled = list(values)
    random.shuffle(shuffled)
    assert interquartile_mean(np.array(shuffled)) == interquartile_mean(np.array(values))


def test_the_interquartile_mean_takes_any_axis():
    data = rng().random((6, 9))
    assert interquartile_mean(data, axis=0) == pytest.approx(interquartile_mean(data.T))


def test_intervals_cover_the_truth_about_as_often_as_they_say():
    rng_data = rng(3)
    covered = []
    for _ in range(400):
        interval = iqm_interval(5.0 + rng_data.standard_normal(10), rng_data, 400)
        covered.append(interval.low <= 5.0 <= interval.high)
    assert 0.90 <= np.mean(covered) <= 0.98


def test_an_interval_is_repeatable_and_widens_with_the_spread():
    values = rng(1).standard_normal(10)
    assert iqm_interval(values, rng(2)) == iqm_interval(values, rng(2))
    narrow, wide = iqm_interval(values, rng(2)), iqm_interval(3.0 * values, rng(2))
    assert wide.high - wide.low == pytest.approx(3.0 * (narrow.high - narrow.low))


def test_strata_are_resampled_on_their_own():
    constant = ratio_interval([6.0] * 5, [3.0] * 7, rng())
    assert (constant.value, constant.low, constant.high, constant.runs) == (2.0, 2.0, 2.0, 5)
    shifted = difference_interval([6.0] * 5, [1.0] * 5, rng())
    assert (shifted.low, shifted.high) == (5.0, 5.0)


def test_one_run_has_no_interval_in_print():
    assert iqm_interval([0.97], rng()).text() == "0.970 (1 run)"
    assert iqm_interval([-1e-9] * 5, rng()).text(2) == "0.00 [0.00, 0.00]"


def test_probability_of_improvement_counts_pairs_and_halves_ties():
    assert probability_of_improvement([2.0, 3.0], [1.0, 1.0], rng()).value == 1.0
    assert probability_of_improvement([1.0, 3.0], [2.0, 3.0], rng()).value == 0.375
    same = probability_of_improvement([1.0] * 5, [1.0] * 5, rng())
    assert (same.value, same.low, same.high) == (0.5, 0.5, 0.5)


def test_probability_of_improvement_is_uncertain_for_rows_that_are_alike():
    data = rng(5).standard_normal((2, 10))
    interval = probability_of_improvement(data[0], data[1], rng())
    assert interval.low < 0.5 < interval.high


def test_a_band_is_pointwise_and_of_any_length():
    curves = rng().standard_normal((5, 600)) + np.arange(600)
    band = iqm_band(curves, rng(), 200)
    assert band.value == pytest.approx(interquartile_mean(curves, axis=0))
    assert np.all(band.low <= band.value)
    assert np.all(band.value <= band.high)
    assert band.low.shape == (600,)


def test_pearson_agrees_with_numpy():
    x = 1e6 + rng(1).standard_normal(300)
    y = -0.3 * x + rng(2).standard_normal(300)
    assert pearson(x, y) == pytest.approx(np.corrcoef(x, y)[0, 1], abs=1e-9)


@pytest.mark.parametrize(
    ("x", "y"), [([], []), ([1.0], [2.0]), ([0.1, 0.1, 0.1], [1.0, 2.0, 3.0])]
)
def test_pearson_is_undefined_without_variance(x, y):
    assert pearson(np.array(x), np.array(y)) is None


@given(st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)), min_size=2, max_size=20))
def test_pearson_is_symmetric_and_within_its_range(pairs):
    x, y = np.array(pairs).T
    r = pearson(x, y)
    assert r == pearson(y, x)
    assert r is None or -1.0 <= r <= 1.0


@pytest.mark.parametrize(
    ("r", "words"),
    [
        (1.0, "perfect positive correlation"),
        (0.5, "strong positive correlation"),
        (0.49, "moderate positive correlation"),
        (0.3, "moderate positive correlation"),
        (0.29, "weak positive correlation"),
        (0.0, "no correlation"),
        (-0.213, "weak negative correlation"),
        (-0.3, "moderate negative correlation"),
        (-0.5, "strong negative correlation"),
        (-1.0, "perfect negative correlation"),
        (None, "undefined"),
    ],
)
def test_the_scale_of_strength_is_the_papers(r, words):
    assert strength_of(r) == words


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda: interquartile_mean(np.array([])), "values"),
        (lambda: interquartile_mean(np.array([1.0, np.nan])), "values"),
        (lambda: iqm_interval([1.0, np.inf], rng()), "strata"),
        (lambda: iqm_interval([1.0], rng(), 0), "resamples"),
        (lambda: ratio_interval([1.0], [0.0], rng()), "lower"),
        (lambda: iqm_band(np.ones(3), rng()), "curves"),
        (lambda: pearson(np.ones(2), np.ones(3)), "x, y"),
        (lambda: strength_of(1.1), "r"),
        (lambda: strength_of(float("nan")), "r"),
    ],
)
def test_bad_input_is_named(call, field):
    with pytest.raises(ConfigError, match=field):
        call()
