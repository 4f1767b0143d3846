"""Fuel while on is convex over bus power, and as near to the data as that allows."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tractor_sim.config import load_powertrain, read_powertrain
from tractor_sim.engine import best_power_w, efficiency, fuel_rate_kg_per_s
from tractor_sim.fuel_curve import convex_fuel_curve
from tractor_sim.generator import GeneratorParams, to_bus_w, to_crank_w

VEHICLES = ("field", "field:engine.curve=fixed_1800_rpm", "utility_150kw", "wheel_loader")
IDEAL = GeneratorParams()


def raw_curve(name):
    engine = read_powertrain(name)[1]["engine"]
    curve = engine["curves"][engine["curve"]]
    power_w, fuel = np.array(curve["power_w"], float), np.array(curve["fuel_kg_per_s"], float)
    if power_w[0] > 0.0:
        power_w = np.concatenate(([0.0], power_w))
        fuel = np.concatenate(([engine["idle_fuel_kg_per_s"]], fuel))
    return power_w, fuel


def fuel_at_crank(params, crank_w):
    return fuel_rate_kg_per_s(params.engine, crank_w, np.ones(np.shape(crank_w), bool))


@pytest.mark.parametrize("name", VEHICLES)
def test_fuel_is_convex_over_bus_power_idle_included(name):
    params = load_powertrain(name)
    peak_w = params.engine.power_max_w
    bus_w = np.linspace(0.0, to_bus_w(params.generator, np.array(peak_w), peak_w), 40_001)
    fuel = fuel_at_crank(params, to_crank_w(params.generator, bus_w, peak_w))
    marginal = np.diff(fuel) / np.diff(bus_w)
    # Slopes of differences carry the rounding of fuel (1e-18 kg/s) over a cell of some watts.
    assert np.all(np.diff(marginal) > -1e-6 * marginal.max())
    assert np.all(marginal > 0.0)
    assert fuel[0] == fuel_at_crank(params, np.zeros(1))[0] > 0.0, "idling burns fuel"


@pytest.mark.parametrize("name", VEHICLES)
def test_fuel_is_never_above_the_data_and_keeps_both_ends(name):
    params, (power_w, raw) = load_powertrain(name), raw_curve(name)
    knots_w = np.union1d(power_w, np.linspace(0.0, params.engine.power_max_w, 5_000))
    hull = fuel_at_crank(params, knots_w)
    data = np.interp(knots_w, power_w, raw)
    assert np.all(hull <= data * (1 + 1e-12))
    assert hull[0] == data[0] and hull[-1] == data[-1]


@pytest.mark.parametrize("name", VEHICLES)
def test_fuel_is_the_lowest_chord_of_the_data_and_the_data_where_none_is_lower(name):
    """Every chord by brute force, which shares nothing with the hull's algorithm."""
    params, (power_w, raw) = load_powertrain(name), raw_curve(name)
    knots_w = np.array(params.engine.curve_power_w)
    bus_w = to_bus_w(params.generator, knots_w, params.engine.power_max_w)
    data = np.interp(knots_w, power_w, raw)
    lowest = data.copy()
    for i in range(1, len(bus_w) - 1):
        left, right = slice(None, i), slice(i + 1, None)
        run_w = bus_w[right] - bus_w[left, None]
        rise = data[right] - data[left, None]
        chords = data[left, None] + rise * (bus_w[i] - bus_w[left, None]) / run_w
        lowest[i] = min(data[i], chords.min())
    np.testing.assert_allclose(fuel_at_crank(params, knots_w), lowest, rtol=1e-12)
    assert np.isclose(lowest, data, rtol=1e-12).sum() >= 3, "it touches the data between its ends"


def test_convex_data_stay_as_they_are():
    power_w, fuel = np.array([0.0, 50e3, 100e3]), np.array([0.3e-3, 3e-3, 6e-3])
    knots_w, hull = convex_fuel_curve(IDEAL, power_w, fuel, 0.0)
    np.testing.assert_array_equal(knots_w, power_w)
    np.testing.assert_array_equal(hull, fuel)


def test_a_bump_in_the_data_is_cut_by_the_chord_below_it():
    power_w, fuel = np.array([0.0, 50e3, 100e3]), np.array([1e-3, 5e-3, 7e-3])
    _, hull = convex_fuel_curve(IDEAL, power_w, fuel, 0.0)
    np.testing.assert_allclose(hull, [1e-3, 4e-3, 7e-3])


def test_data_that_begin_above_zero_are_joined_to_idling_by_a_line():
    knots_w, hull = convex_fuel_curve(IDEAL, np.array([40e3, 80e3]), np.array([3e-3, 6e-3]), 2e-4)
    np.testing.assert_array_equal(knots_w, [0.0, 40e3, 80e3])
    np.testing.assert_allclose(hull, [2e-4, 3e-3, 6e-3])


@settings(max_examples=20, deadline=None)
@given(
    steps=st.lists(st.floats(1e-5, 4e-3), min_size=2, max_size=12),
    idle=st.floats(0.0, 1e-3),
    losses=st.tuples(st.floats(0.7, 0.95), st.floats(0.7, 0.97), st.floats(0.7, 0.97)),
)
def test_the_hull_of_any_curve_is_convex_and_touches_it(steps, idle, losses):
    power_w = np.linspace(0.0, 100e3, len(steps) + 1)[1:]
    raw = idle + np.cumsum(steps)
    generator = GeneratorParams((0.0, 0.3, 1.0), losses)
    knots_w, hull = convex_fuel_curve(generator, power_w, raw, idle)
    bus_w = to_bus_w(generator, knots_w, 100e3)
    data = np.interp(knots_w, np.append(0.0, power_w), np.append(idle, raw))
    slopes = np.diff(hull) / np.diff(bus_w)
    assert np.all(np.diff(slopes) >= -1e-9 * np.abs(slopes).max())
    assert np.all(hull <= data + 1e-15)
    assert np.isclose(hull, data, rtol=0, atol=1e-15).sum() >= 2


def test_efficiency_is_power_over_fuel_power_and_below_one():
    """275 kW at 1.4870e-2 kg/s and 42.7 MJ/kg are 43.31 %."""
    engine = load_powertrain("field").engine
    assert efficiency(engine, np.array([275e3]))[0] == pytest.approx(275e3 / (1.4870e-2 * 42.7e6))
    power_w = np.linspace(0.0, 275e3, 500)
    assert np.all((efficiency(engine, power_w) >= 0.0) & (efficiency(engine, power_w) < 0.5))
    at_best = efficiency(engine, np.array([best_power_w(engine)]))[0]
    assert at_best >= efficiency(engine, power_w).max()


def test_the_engine_on_its_optimal_line_is_42_to_44_percent_efficient_where_it_works():
    """The paper's "42-44 %", over 110-190 kW of the map."""
    engine = load_powertrain("field").engine
    eta = efficiency(engine, np.linspace(110e3, 190e3, 50))
    assert eta.min() > 0.42 and eta.max() < 0.446


def test_a_fixed_speed_costs_fuel_at_low_power_and_never_much_less():
    line, fixed = load_powertrain(VEHICLES[0]).engine, load_powertrain(VEHICLES[1]).engine
    power_w = np.linspace(0.0, 265e3, 200)
    on = np.ones(200, bool)
    extra = fuel_rate_kg_per_s(fixed, power_w, on) / fuel_rate_kg_per_s(line, power_w, on)
    assert np.all(extra[power_w < 60e3] > 1.02) and extra[0] > 3.0
    assert extra.min() > 0.995, "the optimal line is the least fuel over speeds, 1800 rpm included"
