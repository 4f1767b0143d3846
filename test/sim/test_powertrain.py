"""The plant keeps its balances and limits whatever it is told."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tractor_sim.config import load_powertrain
from tractor_sim.engine import best_power_w, fuel_rate_kg_per_s
from tractor_sim.powertrain import (
    Command,
    PlantState,
    PowertrainParams,
    battery_power_grid_w,
    feasible_battery_power_w,
    initial_state,
    power_limits,
    project,
    step,
)

PAPER = load_powertrain("paper")
RESTRICTED = dataclasses.replace(
    PAPER,
    engine=dataclasses.replace(
        PAPER.engine,
        idle_fuel_kg_per_s=0.25e-3,
        start_fuel_kg=0.015,
        min_on_s=5.0,
        min_off_s=5.0,
        ramp_w_per_s=60e3,
    ),
    generator=dataclasses.replace(
        PAPER.generator,
        load_fraction=(0.0, 0.1, 0.4, 1.0),
        curve_efficiency=(0.83, 0.91, 0.94, 0.92),
    ),
)
POWERTRAINS = {"paper": PAPER, "with start, ramp and generator losses": RESTRICTED}

any_command = st.one_of(
    st.floats(-400e3, 400e3), st.sampled_from([np.nan, np.inf, -np.inf, 1e30, -1e30, 0.0])
)


def plant(soc: float, params: PowertrainParams = PAPER) -> PlantState:
    return initial_state(params, soc)


def command(battery_w: float, engine_w: float = np.nan) -> Command:
    return Command(np.array([battery_w]), np.array([engine_w]))


@pytest.mark.parametrize("params", POWERTRAINS.values(), ids=POWERTRAINS.keys())
@settings(max_examples=150, deadline=None)
@given(
    soc=st.floats(0.70, 0.90),
    demands_w=st.lists(st.floats(-400e3, 800e3), min_size=1, max_size=12),
    commands=st.lists(st.tuples(any_command, any_command), min_size=12, max_size=12),
)
def test_balances_and_limits_hold_under_any_command(params, soc, demands_w, commands):
    state = plant(soc, params)
    battery = params.battery
    for demand_w, (battery_w, engine_w) in zip(demands_w, commands, strict=False):
        limits = power_limits(params, state)
        after, result = step(params, state, np.array([demand_w]), command(battery_w, engine_w))
        supplied_w = result.battery_power_w + result.engine_power_w
        residual_j = (result.shortfall_j - result.dissipated_j) / params.dt_s
        np.testing.assert_allclose(supplied_w + residual_j, demand_w, rtol=0, atol=2e-6)
        np.testing.assert_allclose(
            (state.soc - after.soc) * battery.energy_j,
            result.battery_power_w * params.dt_s,
            rtol=0,
            atol=1e-3,
        )
        assert battery.soc_min <= after.soc[0] <= battery.soc_max
        assert abs(result.battery_power_w[0]) <= battery.power_max_w
        assert 0.0 <= result.engine_power_w[0] <= params.engine.power_max_w
        assert result.engine_power_w[0] <= limits.engine_w[0]
        assert result.fuel_kg[0] >= 0.0
        assert result.shortfall_j[0] == 0.0 or result.dissipated_j[0] == 0.0
        for array in (*vars(after).values(), *vars(result).values()):
            assert np.all(np.isfinite(array))
        state = after


def test_a_command_that_is_not_finite_becomes_the_fallback_law():
    for bad in (np.nan, np.inf, -np.inf):
        _, result = step(PAPER, plant(0.8), np.array([100e3]), command(bad))
        assert result.refused[0]
        assert result.battery_power_w[0] == 0.0
        assert result.engine_power_w[0] == 100e3


def test_feasible_power_follows_the_papers_bounds_with_the_sign_of_lb_corrected():
    params, demand_w = PAPER, np.array([300e3, 100e3, 20e3])
    state = initial_state(params, np.array([0.80, 0.8998, 0.7001]), 3)
    lb, ub = feasible_battery_power_w(power_limits(params, state), demand_w)
    energy_j = params.battery.energy_j
    np.testing.assert_allclose(
        lb, [300e3 - 275e3, max(-(0.90 - 0.8998) * energy_j, 100e3 - 275e3), 20e3 - 275e3 + 5e3]
    )
    np.testing.assert_allclose(ub, [250e3, 100e3, 20e3])
    printed_lb = params.engine.power_max_w - demand_w  # the paper's Delta P
    assert np.all(printed_lb[1:] > ub[1:]), "as printed, no battery power would be feasible"


def test_engine_off_is_reachable_from_a_fixed_grid():
    grid_w = battery_power_grid_w(PAPER)
    assert len(grid_w) == 1600
    for demand_w in (3.1, 45_123.4, 249_999.9):
        state, demand = plant(0.8), np.array([demand_w])
        lb, ub = feasible_battery_power_w(power_limits(PAPER, state), demand)
        chosen_w = project(grid_w, lb, ub)[-1]
        after, result = step(PAPER, state, demand, command(chosen_w))
        assert result.engine_power_w[0] == 0.0
        assert result.fuel_kg[0] == 0.0
        assert not after.engine_on[0]


def test_engine_off_is_said_not_inferred():
    _, result = step(PAPER, plant(0.8), np.array([90e3]), command(10e3, engine_w=0.0))
    assert result.engine_power_w[0] == 0.0
    assert result.battery_power_w[0] == 90e3


def test_demand_above_engine_and_battery_is_shortfall_at_full_power():
    _, result = step(PAPER, plant(0.8), np.array([600e3]), command(0.0))
    assert result.engine_power_w[0] == 275e3
    assert result.battery_power_w[0] == 250e3
    assert result.shortfall_j[0] == pytest.approx(75e3)


def test_braking_charges_the_battery_and_dissipates_what_it_cannot_take():
    _, result = step(PAPER, plant(0.8), np.array([-300e3]), command(0.0))
    assert result.battery_power_w[0] == -250e3
    assert result.dissipated_j[0] == pytest.approx(50e3)
    assert result.fuel_kg[0] == 0.0
    _, full = step(PAPER, plant(0.9), np.array([-10e3]), command(0.0))
    assert full.battery_power_w[0] == 0.0
    assert full.dissipated_j[0] == pytest.approx(10e3)


def test_soc_stops_exactly_at_its_limits():
    state = plant(0.7003)
    for _ in range(5):
        state, _ = step(PAPER, state, np.array([200e3]), command(250e3))
    assert state.soc[0] == PAPER.battery.soc_min
    state = plant(0.8998)
    for _ in range(5):
        state, _ = step(PAPER, state, np.array([20e3]), command(-250e3))
    assert state.soc[0] == PAPER.battery.soc_max


def test_fuel_is_power_over_efficiency_and_heating_value():
    at_w = np.array([10e3, 130e3, 150e3, 275e3])
    expected = at_w / (np.array([0.10, 0.4285, 0.437, 0.39]) * 42.8e6)
    np.testing.assert_allclose(fuel_rate_kg_per_s(PAPER.engine, at_w), expected, rtol=1e-12)
    assert best_power_w(PAPER.engine) == 150e3
    assert fuel_rate_kg_per_s(PAPER.engine, np.zeros(1))[0] == 0.0


def test_one_function_serves_one_tractor_or_many():
    rng = np.random.default_rng(4)
    soc, demand_w = rng.uniform(0.7, 0.9, 64), rng.uniform(-100e3, 500e3, 64)
    asked = Command(rng.uniform(-3e5, 3e5, 64), np.where(rng.random(64) < 0.3, 0.0, np.nan))
    together, fuel = step(PAPER, initial_state(PAPER, soc, 64), demand_w, asked)
    for b in range(64):
        one = Command(asked.battery_power_w[b : b + 1], asked.engine_power_w[b : b + 1])
        alone, result = step(PAPER, plant(soc[b]), demand_w[b : b + 1], one)
        assert alone.soc[0] == together.soc[b]
        assert result.fuel_kg[0] == fuel.fuel_kg[b]


def test_a_start_costs_its_fuel_once():
    state = plant(0.8, RESTRICTED)
    on, first = step(RESTRICTED, state, np.array([50e3]), command(0.0))
    _, second = step(RESTRICTED, on, np.array([50e3]), command(0.0))
    assert first.engine_started[0] and not second.engine_started[0]
    assert first.fuel_kg[0] - second.fuel_kg[0] == pytest.approx(0.015)


def test_minimum_times_and_ramp_are_kept():
    state = plant(0.8, RESTRICTED)
    powers_w, on = [], []
    for asked in (command(-200e3), command(-200e3), command(0.0, 0.0), command(0.0, 0.0)):
        state, result = step(RESTRICTED, state, np.array([50e3]), asked)
        powers_w.append(result.engine_power_w[0])
        on.append(bool(state.engine_on[0]))
    assert on == [True, True, True, True], "off is refused for the first 5 s"
    assert np.all(np.abs(np.diff([0.0, *powers_w])) <= 60e3)
    assert powers_w[1] > powers_w[0]


@settings(max_examples=200, deadline=None)
@given(soc=st.floats(0.70, 0.7003), scale=st.floats(0.5, 1.0))
def test_rounding_does_not_start_the_engine(soc, scale):
    state = plant(soc)
    demand_w = power_limits(PAPER, state).discharge_w * scale
    after, result = step(PAPER, state, demand_w, Command(demand_w, np.full(1, np.nan)))
    assert not after.engine_on[0]
    assert result.fuel_kg[0] == 0.0
