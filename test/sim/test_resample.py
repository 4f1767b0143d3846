"""A recording becomes a cycle with its energy kept and everything dropped or filled counted."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tractor_msgs_py.errors import CycleError
from tractor_sim.duty_cycle.resample import ImportSettings, Samples, resample


def samples(time_s, power_w):
    time_s = np.asarray(time_s, dtype=float)
    return Samples(
        "mine.csv", np.arange(2, len(time_s) + 2), time_s, np.asarray(power_w, dtype=float)
    )


def run(time_s, power_w, **changed):
    return resample(samples(time_s, power_w), ImportSettings(**changed))


def test_a_clean_recording_at_the_step_is_unchanged_to_the_bit():
    power_w = np.random.Generator(np.random.PCG64(1)).normal(1e5, 5e4, 200)
    (demand_w,), account = run(np.arange(200.0) + 1.7e9, power_w)
    np.testing.assert_array_equal(demand_w, power_w)
    assert account.rows_kept == account.rows_read == account.steps == 200
    assert account.gaps_filled == account.gaps_cut == 0
    assert account.first_dropped == ""
    assert account.energy_after_j == pytest.approx(account.energy_before_j)


def test_ten_hertz_becomes_the_mean_of_each_second():
    power_w = np.arange(40.0)
    (demand_w,), account = run(np.arange(40) / 10, power_w)
    np.testing.assert_allclose(demand_w, power_w.reshape(4, 10).mean(axis=1))
    assert account.usual_step_s == pytest.approx(0.1)


def test_a_tenth_of_a_hertz_is_held_for_ten_seconds():
    (demand_w,), account = run([0, 10, 20], [1e3, -2e3, 3e3])
    np.testing.assert_allclose(demand_w, np.repeat([1e3, -2e3, 3e3], 10))
    assert account.gaps_filled == 0


@settings(max_examples=30, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(2, 60),
    st.sampled_from([0.1, 0.5, 1.0, 3.0]),
    st.sampled_from([0.05, 1.0, 7.0]),
)
def test_energy_is_kept_up_to_the_last_part_of_a_step(seed, count, dt_s, usual_s):
    rng = np.random.Generator(np.random.PCG64(seed))
    time_s = np.cumsum(usual_s * rng.uniform(0.8, 1.2, count))
    power_w = rng.normal(0, 1e5, count)
    try:
        (demand_w,), account = run(time_s, power_w, dt_s=dt_s)
    except CycleError as error:
        assert "less than the two steps" in str(error)
        return
    assert 0 <= account.tail_dropped_s < dt_s * (1 + 1e-6)
    lost_j = np.abs(power_w).max() * account.tail_dropped_s
    expected_j = account.energy_before_j + account.energy_filled_j
    assert abs(account.energy_after_j - expected_j) <= lost_j + 1e-3 * (1 + account.duration_s)
    assert account.energy_after_j == pytest.approx(demand_w.sum() * dt_s)


def test_a_short_gap_is_bridged_by_a_straight_line_and_counted():
    (demand_w,), account = run([0, 1, 5, 6], [10e3, 10e3, 50e3, 50e3])
    np.testing.assert_allclose(demand_w, [10e3, 10e3, 20e3, 30e3, 40e3, 50e3, 50e3])
    assert (account.gaps_filled, account.gap_filled_s, account.longest_gap_s) == (1, 3.0, 4.0)
    assert account.energy_before_j == pytest.approx(120e3)
    assert account.energy_filled_j == pytest.approx(90e3)


def test_a_long_gap_is_refused_with_its_place_or_cut_on_request():
    time_s, power_w = [0, 1, 2, 60, 61], [1.0, 2.0, 3.0, 4.0, 5.0]
    with pytest.raises(CycleError, match=r"mine.csv: line 5: gap of 58 s at 2 s.*--split-gaps"):
        run(time_s, power_w)
    pieces, account = run(time_s, power_w, split=True)
    assert [piece.tolist() for piece in pieces] == [[1.0, 2.0, 3.0], [4.0, 5.0]]
    assert (account.gaps_cut, account.gaps_filled, account.duration_s) == (1, 0, 5.0)


def test_every_fault_is_counted_under_its_name():
    time_s = [0, 1, 2, 3, 3, 2.5, 4, np.nan, 5, 6, 7, 8]
    power_w = [1, 2, np.nan, 4, 5, 6, 9e9, 8, 9, 10, 11, 12]
    _, account = run(time_s, power_w, max_dropped=0.5)
    assert account.rows_read == 12 and account.rows_kept == 7
    assert account.dropped_not_a_number == 2
    assert account.dropped_absurd_power == 1
    assert account.dropped_duplicate_time == 1
    assert account.dropped_time_backwards == 1
    assert account.first_dropped.startswith("line 4: not a number, time_s 2")


def test_one_wild_stamp_costs_one_row_not_all_that_follow():
    time_s = np.arange(50.0)
    time_s[20] = 1e9
    (demand_w,), account = run(time_s, np.full(50, 7e3))
    assert account.dropped_time_backwards == 1
    assert len(demand_w) == 50


def test_a_row_said_twice_is_counted_but_takes_nothing_away():
    _, account = run(np.repeat(np.arange(10), 2), np.repeat(np.arange(10.0), 2))
    assert (account.rows_read, account.rows_kept, account.dropped_duplicate_time) == (20, 10, 10)
    with pytest.raises(CycleError, match="9 of 20 rows are unusable"):  # 0 W and -0 W are the same
        run(np.repeat(np.arange(10), 2), np.repeat(np.arange(10.0), 2) * ([1, -1] * 10))


def test_a_piece_of_one_step_makes_no_cycle():
    pieces, account = run([0, 1, 2, 60, 100, 101], [1, 2, 3, 4, 5, 6], split=True)
    assert [piece.tolist() for piece in pieces] == [[1, 2, 3], [5, 6]]
    assert account.tail_dropped_s == 1.0


def test_mostly_unusable_recordings_are_refused_with_the_first_fault():
    power_w = np.ones(20)
    power_w[5:10] = np.nan
    with pytest.raises(CycleError, match=r"5 of 20 rows are unusable, allowed 10%.*line 7"):
        run(np.arange(20.0), power_w)


@pytest.mark.parametrize(
    ("time_s", "power_w", "named"),
    [
        ([], [], "0 usable rows of 0"),
        ([3], [5e3], "line 2: 1 usable rows of 1"),
        ([0, np.nan], [1, 2], "line 3: not a number"),
        ([0, 0.1], [1, 2], "line 3: ends after 0.2 s, less than the two steps of 1 s"),
        ([0, 1e9], [1, 2], "lasts 1e+09 s"),
    ],
)
def test_too_little_or_too_much_is_refused_by_name(time_s, power_w, named):
    with pytest.raises(CycleError) as caught:
        run(time_s, power_w, max_dropped=1.0)
    assert named in str(caught.value) and "mine.csv" in str(caught.value)


@pytest.mark.parametrize(
    "wrong",
    [
        {"dt_s": 0},
        {"dt_s": float("nan")},
        {"max_gap_s": -1},
        {"max_power_w": 0},
        {"max_power_w": 3e6},  # would write what no reader takes
        {"aux_w": -1},
        {"aux_w": float("nan")},
        {"max_dropped": 2},
    ],
)
def test_wrong_settings_are_refused_by_name(wrong):
    with pytest.raises(CycleError, match=next(iter(wrong))):
        ImportSettings(**wrong)


def test_twelve_hours_at_ten_hertz_are_twelve_hours():
    time_s = np.arange(12 * 36_000) / 10
    (demand_w,), account = run(time_s, 1e5 + 5e4 * np.sin(time_s / 30))
    assert len(demand_w) == 43_200
    assert account.energy_after_j == pytest.approx(account.energy_before_j)
