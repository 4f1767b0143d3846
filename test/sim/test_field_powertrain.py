"""The field powertrain as a whole: balances, starts, ramp, settings by name, what stays the same
on the paper's."""

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tractor_ems.bags.read import read_bag
from tractor_ems.cli import main
from tractor_msgs_py.errors import ConfigError
from tractor_sim.battery import discharge_current_a, open_circuit_v
from tractor_sim.config import load_powertrain
from tractor_sim.engine import fuel_rate_kg_per_s
from tractor_sim.generator import to_bus_w, to_crank_w
from tractor_sim.powertrain import Command, PlantState, initial_state, step
from tractor_sim.powertrain_json import params_from_json, params_to_json, powertrain_hash
from tractor_sim.readings import battery_reading

FIELD = load_powertrain("field")
GOLDEN = Path(__file__).resolve().parents[2] / "bags"
SHIPPED = ("paper", "paper_table1", "field", "utility_150kw", "wheel_loader")
VARIANTS = (*SHIPPED, "field:engine.curve=fixed_1800_rpm", "field:engine.ramp_w_per_s=null")
BUS_MAX_W = 275e3 * 0.92  # engine at full load through the generator at full load


def asked(battery_w: float, engine_w: float = np.nan) -> Command:
    return Command(np.array([battery_w]), np.array([engine_w]))


def drive(state: PlantState, demand_w: float, command: Command, steps: int = 1, params=FIELD):
    results = []
    for _ in range(steps):
        state, result = step(params, state, np.array([demand_w]), command)
        results.append(result)
    return state, results


def running(power_w: float, soc: float = 0.55, time_s: float = 100.0) -> PlantState:
    return PlantState(
        np.array([soc]), np.array([True]), np.array([time_s]), np.array([float(power_w)])
    )


@settings(max_examples=25, deadline=None)
@given(
    soc=st.floats(0.30, 0.80),
    demands_w=st.lists(st.floats(-400e3, 600e3), min_size=1, max_size=8),
    commands=st.lists(
        st.tuples(st.floats(-300e3, 300e3), st.sampled_from([np.nan, 0.0])),
        min_size=8,
        max_size=8,
    ),
)
def test_balances_and_limits_hold_on_every_step(soc, demands_w, commands):
    state = initial_state(FIELD, soc)
    for demand_w, command in zip(demands_w, commands, strict=False):
        after, result = step(FIELD, state, np.array([demand_w]), asked(*command))
        battery_w, engine_w = result.battery_power_w, result.engine_power_w
        residual_w = result.shortfall_j - result.dissipated_j
        np.testing.assert_allclose(battery_w + engine_w + residual_w, demand_w, atol=2e-6)
        i = discharge_current_a(FIELD.battery, state.soc, battery_w)
        assert abs(i[0]) <= 250.0 * (1 + 1e-12) and abs(battery_w[0]) <= 150e3
        moved = (state.soc - after.soc) * FIELD.battery.charge_c
        np.testing.assert_allclose(moved, i, rtol=0, atol=1e-6)
        cell_w = open_circuit_v(FIELD.battery, state.soc) * i
        np.testing.assert_allclose(cell_w, battery_w + 0.08 * i**2, rtol=0, atol=1e-6)
        assert 0.30 <= after.soc[0] <= 0.80
        assert 0.0 <= engine_w[0] <= BUS_MAX_W * (1 + 1e-12)
        state = after


def test_the_engine_gives_the_bus_what_the_generator_leaves():
    _, results = drive(running(BUS_MAX_W), 400e3, asked(0.0))
    assert results[0].engine_power_w[0] == pytest.approx(253e3)
    assert results[0].battery_power_w[0] == pytest.approx(147e3)
    assert results[0].shortfall_j[0] == 0.0


def test_a_start_burns_its_fuel_once_and_idling_burns_what_idling_burns():
    state, (first,) = drive(initial_state(FIELD, 0.55), 1.0, asked(-1e-3))
    assert first.engine_started[0] and state.engine_on[0]
    _, (second,) = drive(state, 1.0, asked(1.0))
    assert not second.engine_started[0] and second.engine_power_w[0] == 0.0
    assert second.fuel_kg[0] == pytest.approx(0.25e-3, rel=1e-12)
    assert first.fuel_kg[0] - second.fuel_kg[0] == pytest.approx(0.015, abs=1e-7)


@pytest.mark.parametrize("start_fuel_kg", [0.0, 0.015, 0.020, 0.060])
def test_start_fuel_is_selectable_and_is_all_that_changes(start_fuel_kg):
    params = load_powertrain(f"field:engine.start_fuel_kg={start_fuel_kg}")
    _, results = drive(initial_state(params, 0.55), 50e3, asked(0.0), 3, params)
    _, free = drive(
        initial_state(FIELD, 0.55),
        50e3,
        asked(0.0),
        3,
        load_powertrain("field:engine.start_fuel_kg=0"),
    )
    extra = [a.fuel_kg[0] - b.fuel_kg[0] for a, b in zip(results, free, strict=True)]
    np.testing.assert_allclose(extra, [start_fuel_kg, 0.0, 0.0], atol=1e-15)


def test_once_started_the_engine_stays_on_five_seconds_and_once_stopped_off_five():
    state, on = initial_state(FIELD, 0.55), []
    state, _ = drive(state, 50e3, asked(0.0))
    for _ in range(7):  # off is asked for all the time
        state, _ = drive(state, 50e3, asked(0.0, 0.0))
        on.append(bool(state.engine_on[0]))
    assert on == [True] * 4 + [False] * 3
    on = []
    for _ in range(4):  # now a start is asked for; off for 3 s already
        state, _ = drive(state, 50e3, asked(0.0))
        on.append(bool(state.engine_on[0]))
    assert on == [False] * 2 + [True] * 2


def test_the_crankshaft_ramps_sixty_kilowatt_a_second_and_the_battery_bridges():
    state, results = drive(initial_state(FIELD, 0.55), 140e3, asked(0.0), 4)
    engine_w = np.array([r.engine_power_w[0] for r in results])
    crank_w = to_crank_w(FIELD.generator, engine_w, 275e3)
    np.testing.assert_allclose(crank_w[:2], [60e3, 120e3])
    np.testing.assert_allclose(engine_w[2:], 140e3)
    bridged_w = [r.battery_power_w[0] for r in results]
    np.testing.assert_allclose(bridged_w, 140e3 - engine_w, atol=1e-6)
    assert all(r.shortfall_j[0] == 0.0 for r in results)
    assert state.engine_on[0]


def test_an_engine_that_may_not_stop_ramps_down_and_charges_meanwhile():
    state, results = drive(running(200e3, time_s=1.0), 20e3, asked(0.0, 0.0), 2)
    crank_w = to_crank_w(FIELD.generator, np.array([200e3]), 275e3)
    expected_w = to_bus_w(FIELD.generator, crank_w - 60e3, 275e3)
    np.testing.assert_allclose(results[0].engine_power_w, expected_w)
    np.testing.assert_allclose(results[0].battery_power_w, 20e3 - expected_w)
    assert results[1].engine_power_w[0] < results[0].engine_power_w[0]
    assert state.engine_on[0]


def test_an_engine_that_may_stop_does_so_at_once_whatever_the_ramp():
    state, (result,) = drive(running(200e3), 20e3, asked(0.0, 0.0))
    assert not state.engine_on[0] and result.engine_power_w[0] == 0.0
    assert result.fuel_kg[0] == 0.0 and result.battery_power_w[0] == 20e3


def test_braking_stops_the_engine_charges_to_the_limit_and_dissipates_the_rest():
    state, (result,) = drive(running(100e3), -200e3, asked(0.0))
    assert result.battery_power_w[0] == -150e3
    assert result.dissipated_j[0] == pytest.approx(50e3)
    assert result.fuel_kg[0] == 0.0 and not state.engine_on[0]
    i = discharge_current_a(FIELD.battery, np.array([0.55]), np.array([-150e3]))
    assert state.soc[0] == pytest.approx(0.55 - i[0] / FIELD.battery.charge_c)


def test_auxiliaries_and_losses_burn_more_than_work_alone():
    """No chain of losses may come out above the engine's own efficiency."""
    _, results = drive(running(150e3), 150e3, asked(0.0), 5)
    eta = 150e3 / (results[-1].fuel_kg[0] * FIELD.engine.fuel_lhv_j_per_kg)
    crank_w = to_crank_w(FIELD.generator, np.array([150e3]), 275e3)
    engine_eta = crank_w / (fuel_rate_kg_per_s(FIELD.engine, crank_w) * 42.7e6)
    assert eta == pytest.approx(engine_eta[0] * 150e3 / crank_w[0])
    assert eta < 0.42


def test_an_engine_of_one_hundred_percent_is_refused():
    engine = FIELD.engine
    perfect = tuple(p / engine.fuel_lhv_j_per_kg for p in engine.curve_power_w)
    with pytest.raises(ConfigError, match="efficiency below 1"):
        dataclasses.replace(engine, curve_fuel_kg_per_s=perfect)


WRONG_SETTINGS = {
    "engine.start=0.06": "engine.start",
    "engine.start_fuel_kg=-1": "greater than or equal to 0",
    "engine.start_fuel_kg=much": "engine.start_fuel_kg",
    "engine.start_fuel_kg": "is no setting",
    "engine.curve=fixed_1900_rpm": "fixed_1800_rpm",
    "motor.power_max_w=1": "motor.power_max_w=1",
    "battery.soc_min=0.9": "battery.soc_min",
    "soc_initial=0.9": "allowed 0.3..0.8",
    "dt_s=2023-13-01": "no value of dt_s",
    "engine.ramp_w_per_s=": "'' is no value of engine.ramp_w_per_s",
    "engine.min_on_s=yes": "engine.min_on_s",
    "engine.min_on_s=1:30": "'1:30' is no value of engine.min_on_s",
    "engine.min_on_s=1,engine.min_on_s=2": "given twice",
    f"battery.resistance_ohm={'1' * 300}x": "battery.resistance_ohm",
    "battery.ocv_v=[1,2]": "ocv_v",
}


@pytest.mark.parametrize("setting", WRONG_SETTINGS, ids=lambda s: s[:30])
def test_a_wrong_setting_is_refused_in_one_line_that_names_it(setting):
    with pytest.raises(ConfigError) as caught:
        load_powertrain(f"field:{setting}")
    message = str(caught.value)
    assert WRONG_SETTINGS[setting] in message and "\n" not in message


def test_a_wrong_setting_ends_the_command_with_code_2(capsys):
    assert main(["evaluate", "--powertrain", "field:engine.start=1", "--json"]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and "engine.start" in captured.err
    assert captured.err.count("\n") == 1


def test_settings_change_what_they_name_and_the_name_tells():
    name = "field:engine.start_fuel_kg=0.06,engine.curve=fixed_1800_rpm"
    params = load_powertrain(name)
    assert params.name == name
    assert params.engine.start_fuel_kg == 0.06
    assert fuel_rate_kg_per_s(params.engine, np.zeros(1), np.ones(1, bool))[0] == 1.0377e-3
    assert params.battery == FIELD.battery and params.generator == FIELD.generator


@pytest.mark.parametrize("name", VARIANTS)
def test_every_vehicle_survives_json(name):
    params = load_powertrain(name)
    again = params_from_json(params_to_json(params))
    assert again == params and powertrain_hash(again) == powertrain_hash(params)


def test_no_two_vehicles_share_a_hash():
    hashes = {name: powertrain_hash(load_powertrain(name)) for name in VARIANTS}
    for a, b in itertools.combinations(VARIANTS, 2):
        assert hashes[a] != hashes[b], (a, b)


@pytest.fixture(scope="module")
def recorded_run():
    (run,) = read_bag(GOLDEN / "dp_planter")
    return run


def test_the_papers_powertrain_keeps_the_hash_that_its_recordings_carry(recorded_run):
    assert powertrain_hash(load_powertrain("paper")) == recorded_run.info.powertrain_hash


def test_the_papers_battery_reports_what_its_recordings_hold(recorded_run):
    """A lossless battery's voltage under load is its nominal one, to the bit."""
    params = load_powertrain("paper")
    run = recorded_run
    state = initial_state(params, run.info.soc_initial)
    for stamp, end in zip(run.stamps_ns[:60], run.ends_ns[:60], strict=True):
        battery_w = run.powertrain[end].applied_battery_power_w
        engine_w = run.powertrain[end].applied_engine_power_w
        command = asked(battery_w, 0.0 if engine_w == 0.0 else np.nan)
        state, result = step(params, state, np.array([run.demand[stamp].power_w]), command)
        reading = battery_reading(params, state, result, end)
        recorded = run.battery[end]
        assert np.float32(reading.voltage_v) == np.float32(recorded.voltage_v)
        assert np.float32(reading.current_a) == np.float32(recorded.current_a)
        assert reading.soc == recorded.soc
