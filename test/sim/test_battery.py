"""The battery with OCV and resistance against closed forms of P = (OCV - R I) I."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tractor_msgs_py.errors import ConfigError
from tractor_sim.battery import (
    BatteryParams,
    current_a,
    discharge_current_a,
    open_circuit_v,
    power_limits_w,
    soc_after,
    terminal_v,
)
from tractor_sim.config import load_powertrain
from tractor_sim.powertrain import initial_state
from tractor_sim.readings import battery_reading

FIELD = load_powertrain("field").battery
FLAT = BatteryParams(  # 400 V, 50 Ah, 0.1 ohm: round numbers
    energy_j=400.0 * 50.0 * 3600.0,
    voltage_v=400.0,
    power_max_w=300e3,
    soc_min=0.2,
    soc_max=0.9,
    resistance_ohm=0.1,
)
LOSSLESS = load_powertrain("paper").battery


def one(value: float) -> np.ndarray:
    return np.array([value])


def test_a_current_gives_the_power_that_ohms_law_says():
    """100 A from 400 V over 0.1 ohm: 390 V at the terminals, 39 kW."""
    soc = one(0.5)
    assert discharge_current_a(FLAT, soc, one(39e3))[0] == pytest.approx(100.0, rel=1e-12)
    assert terminal_v(FLAT, soc, one(39e3))[0] == pytest.approx(390.0, rel=1e-12)
    assert discharge_current_a(FLAT, soc, one(-41e3))[0] == pytest.approx(-100.0, rel=1e-12)
    assert terminal_v(FLAT, soc, one(-41e3))[0] == pytest.approx(410.0, rel=1e-12)


def test_soc_counts_coulombs_not_joules():
    """100 A for 36 s are 1 Ah of 50 Ah, whatever the voltage under load."""
    soc = one(0.5)
    assert soc_after(FLAT, soc, one(39e3), 36.0)[0] == pytest.approx(0.48, abs=1e-12)
    assert soc_after(FLAT, soc, one(-41e3), 36.0)[0] == pytest.approx(0.52, abs=1e-12)


@settings(max_examples=25, deadline=None)
@given(soc=st.floats(0.30, 0.80), power_w=st.floats(-150e3, 150e3))
def test_cell_power_is_terminal_power_plus_ohmic_loss(soc, power_w):
    soc, power = one(soc), one(power_w)
    i = discharge_current_a(FIELD, soc, power)
    cell_w = open_circuit_v(FIELD, soc) * i
    np.testing.assert_allclose(cell_w, power + FIELD.resistance_ohm * i**2, rtol=0, atol=1e-6)
    np.testing.assert_allclose(terminal_v(FIELD, soc, power) * i, power, rtol=0, atol=1e-6)


def test_charging_and_discharging_by_the_same_current_loses_two_r_i_squared():
    """Into the terminals (OCV + R I) I, out of them (OCV - R I) I, and the SOC is back."""
    soc, i, ohm = one(0.5), 120.0, FLAT.resistance_ohm
    into_w, out_w = (400.0 + ohm * i) * i, (400.0 - ohm * i) * i
    full = soc_after(FLAT, soc, one(-into_w), 10.0)
    np.testing.assert_allclose(soc_after(FLAT, full, one(out_w), 10.0), soc, rtol=0, atol=1e-14)
    assert into_w - out_w == pytest.approx(2 * ohm * i**2, rel=1e-12)


def test_the_tighter_of_power_and_current_limit_holds():
    """At 250 A and 659.06 V of SOC 0.55 the field battery gives 159.8 kW, so 150 kW is tighter."""
    soc = one(0.55)
    charge_w, discharge_w = power_limits_w(FIELD, soc, 1.0)
    assert charge_w[0] == discharge_w[0] == 150e3
    limited = dataclasses.replace(FIELD, current_max_charge_a=100.0, current_max_discharge_a=200.0)
    charge_w, discharge_w = power_limits_w(limited, soc, 1.0)
    assert charge_w[0] == pytest.approx((659.06 + 0.08 * 100.0) * 100.0, rel=1e-12)
    assert discharge_w[0] == pytest.approx((659.06 - 0.08 * 200.0) * 200.0, rel=1e-12)


def test_no_more_power_than_matched_load_leaves_a_battery_of_high_resistance():
    weak = dataclasses.replace(FLAT, resistance_ohm=1.0)
    _, discharge_w = power_limits_w(weak, one(0.5), 1.0)
    assert discharge_w[0] == pytest.approx(400.0**2 / 4.0, rel=1e-12)
    asked_w = np.array([40e3, 41e3, 1e9])
    np.testing.assert_allclose(discharge_current_a(weak, np.full(3, 0.5), asked_w), 200.0)


@settings(max_examples=25, deadline=None)
@given(gap=st.floats(0.0, 5e-4), dt_s=st.sampled_from([0.1, 1.0, 10.0]))
def test_limits_lead_exactly_to_the_ends_of_the_soc_window(gap, dt_s):
    near_empty, near_full = one(FIELD.soc_min + gap), one(FIELD.soc_max - gap)
    discharge_w = power_limits_w(FIELD, near_empty, dt_s)[1]
    charge_w = power_limits_w(FIELD, near_full, dt_s)[0]
    low = soc_after(FIELD, near_empty, discharge_w, dt_s)
    high = soc_after(FIELD, near_full, -charge_w, dt_s)
    assert FIELD.soc_min <= low[0] and high[0] <= FIELD.soc_max
    if discharge_w[0] < FIELD.power_max_w and charge_w[0] < FIELD.power_max_w:
        reach = dt_s * FIELD.current_max_charge_a / FIELD.charge_c
        assert low[0] == pytest.approx(max(FIELD.soc_min, near_empty[0] - reach), abs=1e-12)
        assert high[0] == pytest.approx(min(FIELD.soc_max, near_full[0] + reach), abs=1e-12)
    assert power_limits_w(FIELD, one(FIELD.soc_min), dt_s)[1][0] == 0.0
    assert power_limits_w(FIELD, one(FIELD.soc_max), dt_s)[0][0] == 0.0


def test_no_resistance_and_one_voltage_are_the_papers_battery_to_the_bit():
    assert LOSSLESS.lossless and not FLAT.lossless and not FIELD.lossless
    soc, power = np.linspace(0.7, 0.9, 9), np.linspace(-200e3, 200e3, 9)
    expected = np.clip(soc - power / LOSSLESS.energy_j, 0.7, 0.9)
    np.testing.assert_array_equal(soc_after(LOSSLESS, soc, power, 1.0), expected)
    np.testing.assert_array_equal(terminal_v(LOSSLESS, soc, power), np.full(9, 650.0))
    np.testing.assert_array_equal(current_a(LOSSLESS, soc, power), -power / 650.0)


def test_the_general_law_tends_to_the_lossless_one():
    """With a current limit that never binds the other branch is taken, and must agree."""
    other = dataclasses.replace(LOSSLESS, current_max_charge_a=1e9)
    assert not other.lossless
    soc, power = np.linspace(0.701, 0.899, 9), np.linspace(-200e3, 200e3, 9)
    for function in (soc_after, power_limits_w):
        args = (soc, power, 1.0) if function is soc_after else (soc, 1.0)
        np.testing.assert_allclose(function(other, *args), function(LOSSLESS, *args), rtol=1e-12)


def test_a_reading_is_the_voltage_under_load_and_the_current_into_the_battery():
    params = load_powertrain("field")
    reading = battery_reading(params, initial_state(params, 0.55), None, 1)
    assert reading.voltage_v == pytest.approx(659.06) and reading.current_a == 0.0


WRONG = {
    "resistance_ohm": -0.1,
    "current_max_charge_a": 0.0,
    "current_max_discharge_a": float("nan"),
    "ocv_v": (640.0, 630.0),
    "ocv_soc": (0.35, 0.85),
    "power_max_w": float("inf"),
}


@pytest.mark.parametrize("field", WRONG)
def test_an_impossible_battery_is_refused_by_field(field):
    good = dataclasses.replace(FIELD, ocv_soc=(0.25, 0.85), ocv_v=(630.0, 640.0))
    with pytest.raises(ConfigError, match=f"battery.{field}"):
        dataclasses.replace(good, **{field: WRONG[field]})
