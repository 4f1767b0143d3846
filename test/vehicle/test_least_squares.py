"""Bounded least squares against every active set by brute force."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tractor_ems.vehicle.least_squares import (
    hinges,
    knots_where_sampled,
    lag_one,
    misfit_at,
    solve,
)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), columns=st.integers(1, 5))
def test_no_other_choice_of_zeros_fits_better(seed, columns):
    rng = np.random.Generator(np.random.PCG64(seed))
    design, target = rng.standard_normal((12, columns)), rng.standard_normal(12)
    best = float(np.linalg.norm(target))
    for chosen in itertools.product([False, True], repeat=columns):
        used = np.array(chosen)
        if used.any():
            x = np.linalg.lstsq(design[:, used], target, rcond=None)[0]
            if np.all(x >= 0.0):
                best = min(best, float(np.linalg.norm(design[:, used] @ x - target)))
    solution = solve(design, target)
    assert np.all(solution.coefficients >= 0.0)
    assert np.linalg.norm(solution.residual) == pytest.approx(best, rel=1e-9)


def test_free_columns_are_ordinary_least_squares():
    rng = np.random.Generator(np.random.PCG64(1))
    design, target = rng.standard_normal((50, 3)), rng.standard_normal(50)
    solution = solve(design, target, np.ones(3, bool))
    expected = np.linalg.lstsq(design, target, rcond=None)[0]
    np.testing.assert_allclose(solution.coefficients, expected)


def test_standard_errors_are_the_spread_over_repeated_noise():
    rng = np.random.Generator(np.random.PCG64(2))
    design = np.column_stack((np.ones(200), np.linspace(0.0, 1.0, 200)))
    truth = np.array([2.0, 3.0])
    drawn = [solve(design, design @ truth + 0.1 * rng.standard_normal(200)) for _ in range(200)]
    spread = np.std([s.coefficients for s in drawn], axis=0)
    stated = np.mean([s.error for s in drawn], axis=0)
    np.testing.assert_allclose(stated, spread, rtol=0.2)


def test_errors_are_never_below_what_the_recording_resolves():
    design = np.ones((100, 1))
    error = solve(design, np.full(100, 5.0), resolution=0.1).error[0]
    assert error == pytest.approx(0.1 / np.sqrt(12) / 10.0)


def test_residuals_that_hang_together_count_as_fewer():
    wave = np.sin(np.linspace(0.0, 6.0, 300))
    assert lag_one(wave) > 0.95
    rng = np.random.Generator(np.random.PCG64(3))
    assert lag_one(rng.standard_normal(3000)) < 0.1
    slow = solve(np.ones((300, 1)), 5.0 + wave).error[0]
    white = solve(np.ones((300, 1)), 5.0 + rng.permutation(wave)).error[0]
    assert slow > 4.0 * white


def test_hinges_with_positive_coefficients_are_convex():
    x, knots = np.linspace(0.0, 1.0, 50), np.array([0.2, 0.5])
    curve = hinges(x, knots) @ np.array([1.0, 2.0])
    assert np.all(np.diff(curve, 2) >= -1e-12)
    assert curve[-1] == pytest.approx(0.8 + 1.0)


def test_knots_stand_only_where_samples_are():
    x = np.concatenate((np.linspace(0.0, 0.3, 100), np.linspace(0.7, 1.0, 100)))
    knots = knots_where_sampled(x, 0.1)
    assert knots[0] == 0.0 and knots[-1] == 1.0
    assert not np.any((knots > 0.41) & (knots < 0.69))
    held = np.repeat([0.05, 0.15, 0.95], 100)
    np.testing.assert_array_equal(knots_where_sampled(held, 0.1), [0.05, 0.95])
    np.testing.assert_array_equal(knots_where_sampled(np.full(9, 2.0), 0.1), [2.0])


def test_misfit_is_that_of_the_cells_around_a_knot():
    knots, x = np.array([0.0, 1.0, 2.0]), np.array([0.5, 1.5])
    misfit = misfit_at(knots, x, np.array([3.0, 4.0]))
    np.testing.assert_allclose(misfit, [3.0, np.sqrt(12.5), 4.0])
