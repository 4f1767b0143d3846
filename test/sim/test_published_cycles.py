"""Published cycles keep what was published: lengths, zeros, weights; nothing is filled in."""

import csv

import numpy as np
import pytest

from tractor_msgs_py.errors import CycleError
from tractor_sim.duty_cycle.library import load_cycle
from tractor_sim.duty_cycle.published import full_load, published_cycle, whtc_speed_rpm
from tractor_sim.resources import resource_path

NAMES = ("whtc", "nrtc_1_256", "nrtc_716_736", "iso8178_c1")


def rows(file):
    with resource_path("data", "cycle", file).open(newline="") as opened:
        return list(csv.DictReader(opened))


def test_the_engine_behind_them_has_the_rated_power():
    curve = full_load()
    assert curve.power_w(curve.speed_rpm).max() == pytest.approx(275e3)
    assert 0.60 * curve.rated_rpm <= curve.intermediate_rpm <= 0.75 * curve.rated_rpm


@pytest.mark.parametrize(
    ("name", "length"), [("whtc", 1800), ("nrtc_1_256", 256), ("nrtc_716_736", 21)]
)
def test_a_transient_has_exactly_the_published_seconds(name, length):
    cycle = load_cycle(name)
    assert len(cycle) == length
    assert (cycle.dt_s, cycle.split, cycle.seed) == (1.0, "validation", None)
    assert 0 <= cycle.power_demand_w.min() <= cycle.power_demand_w.max() <= 275e3


def test_demand_is_zero_where_the_whtc_idles_or_motors_and_only_there():
    published = np.array([float(row["torque_norm_pct"] or 0) for row in rows(
        "whtc_normalized_1hz.csv")])  # fmt: skip
    np.testing.assert_array_equal(load_cycle("whtc").power_demand_w > 0, published > 0)


def test_whtc_speed_is_idle_at_zero_and_the_formula_of_the_regulation_at_one():
    curve = full_load()
    at_zero, at_one = whtc_speed_rpm(curve, np.array([0.0, 1.0]))
    assert at_zero == curve.idle_rpm
    # n_lo and n_pref cannot leave the curve, so the span cannot either.
    assert 0 < at_one - curve.idle_rpm < 2.0327 * (curve.speed_rpm[-1] - curve.idle_rpm)
    share = (at_one - curve.idle_rpm) / 2.0327
    low = np.flatnonzero(curve.power_w(np.arange(700.0, 2400.0)) >= 0.55 * 275e3)[0] + 700.0
    assert share > 0.9 * low + 0.1 * curve.rated_rpm - curve.idle_rpm


def test_the_first_part_of_nrtc_and_its_middle_are_separate_cycles_and_nothing_joins_them():
    seconds = [int(row["time_s"]) for row in rows("epa_nrtc_partial_1hz.csv")]
    assert seconds == [*range(1, 257), *range(716, 737)]
    with pytest.raises(CycleError, match="nrtc_1_256"):
        published_cycle("nrtc")


def test_c1_has_the_weighted_mean_power_of_its_modes():
    curve = full_load()
    speed = {"rated": curve.rated_rpm, "intermediate": curve.intermediate_rpm, "idle": 700.0}
    modes = rows("iso8178_c1_modes.csv")
    expected = sum(
        float(row["weight"])
        * float(row["torque_pct_of_max_at_speed"])
        / 100
        * curve.power_w(np.array(speed[row["engine_speed"]]))
        for row in modes
    )
    cycle = load_cycle("iso8178_c1")
    assert sum(float(row["weight"]) for row in modes) == pytest.approx(1.0)
    assert cycle.power_demand_w.mean() == pytest.approx(expected, rel=1e-5)
    assert cycle.power_demand_w.max() == pytest.approx(275e3, abs=1)
    assert cycle.power_demand_w[0] == cycle.power_demand_w[-1] == 0
    held = np.sum(np.abs(cycle.power_demand_w - 275e3) < 1)
    assert held == 0.15 * 1800 - 20  # the rest of its time is in the two ramps


@pytest.mark.parametrize("name", NAMES)
def test_published_demand_is_in_whole_watts_so_that_every_machine_has_the_same_bytes(name):
    demand_w = load_cycle(name).power_demand_w
    np.testing.assert_array_equal(demand_w, np.rint(demand_w))
