"""Every figure of a run on trajectories made by hand, whose answers are known beforehand."""

from dataclasses import replace

import numpy as np
import pytest

from tractor_ems.result import count_violations, summarise
from tractor_msgs_py.trajectory import Trajectory
from tractor_sim.battery import soc_after
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.cycle import DutyCycle
from tractor_sim.engine import fuel_rate_kg_per_s
from tractor_sim.figures import run_figures
from tractor_sim.generator import to_bus_w, to_crank_w

PAPER = load_powertrain("paper")
FIELD = load_powertrain("field")


def by_hand(engine_w, battery_w, fuel_kg, *, on=None, soc=0.8, params=PAPER):
    """A run of these powers at the bus; the demand is what they give together."""
    engine_w, battery_w = np.array(engine_w, float), np.array(battery_w, float)
    steps = len(engine_w)
    nothing = np.zeros(steps)
    trace = [np.array([soc])]
    for power_w in battery_w:
        trace.append(soc_after(params.battery, trace[-1], np.array([power_w]), params.dt_s))
    socs = np.concatenate(trace)
    return Trajectory(
        stamp_ns=np.arange(steps) * 1_000_000_000,
        power_demand_w=engine_w + battery_w,
        soc_observed=socs[:-1],
        command_battery_power_w=battery_w,
        command_engine_power_w=nothing * np.nan,
        battery_power_w=battery_w,
        engine_power_w=engine_w,
        fuel_kg=np.array(fuel_kg, float),
        engine_on=engine_w > 0 if on is None else np.array(on, bool),
        shortfall_j=nothing,
        dissipated_j=nothing,
        soc=socs[:-1],
        soc_final=float(socs[-1]),
    )


def result_of(trajectory, params=PAPER, **cycle):
    demand_w = trajectory.power_demand_w
    return summarise(
        trajectory,
        policy="p",
        cycle=DutyCycle("c", demand_w, params.dt_s, "test", **cycle),
        params=params,
        soc_target=0.79,
        transport="in_process",
        dp_ratio=None,
    )


def test_fuel_is_counted_in_mass_volume_and_per_hour():
    run = by_hand([100e3] * 36, [0.0] * 36, [0.8375 / 36] * 36)  # one litre in a hundredth of an h
    figures = run_figures(run, PAPER)
    assert figures["fuel_kg"] == pytest.approx(0.8375)
    assert figures["fuel_l"] == pytest.approx(1.0)
    assert figures["fuel_gal"] == pytest.approx(1 / 3.785411784)
    assert figures["fuel_l_per_h"] == pytest.approx(100.0)
    assert figures["duration_s"] == 36.0


def test_fuel_per_hectare_needs_an_area():
    run = by_hand([100e3] * 2, [0.0] * 2, [0.8375 / 2] * 2)
    assert result_of(run, area_ha=0.25).fuel_l_per_ha == pytest.approx(4.0)
    assert result_of(run).fuel_l_per_ha is None
    assert result_of(run, area_ha=0.0).fuel_l_per_ha is None, "a cycle that stood still"


def test_efficiency_is_of_the_crankshaft_and_of_what_reaches_the_bus():
    peak_w = FIELD.engine.power_max_w
    bus_w = float(to_bus_w(FIELD.generator, np.array(110e3), peak_w))  # 0.94 at 0.4 of the load
    run = by_hand([bus_w] * 10, [0.0] * 10, [0.006] * 10, soc=0.55, params=FIELD)
    figures = run_figures(run, FIELD)
    assert figures["efficiency"] == pytest.approx(110e3 / (0.006 * 42.7e6))
    assert figures["bus_efficiency"] == pytest.approx(0.94 * figures["efficiency"])


def test_a_run_without_fuel_has_no_efficiency():
    figures = run_figures(by_hand([0.0] * 5, [10e3] * 5, [0.0] * 5), PAPER)
    assert figures["efficiency"] is None and figures["bus_efficiency"] is None
    assert figures["engine_starts"] == 0 and figures["engine_h"] == 0.0


def test_starts_hours_and_low_power_are_counted_from_an_engine_that_is_off():
    on = [1, 1, 0, 0, 1, 1, 1, 0, 1, 1]
    engine_w = [59e3, 60e3, 0, 0, 0, 100e3, 10e3, 0, 200e3, 61e3]  # 59, idling 0 and 10 are low
    figures = run_figures(by_hand(engine_w, [0.0] * 10, [0.0] * 10, on=on), PAPER)
    assert figures["engine_starts"] == 3
    assert figures["engine_starts_per_h"] == pytest.approx(3 * 360)
    assert figures["engine_h"] == pytest.approx(7 / 3600)
    assert figures["below_60kw_s"] == 3.0


def test_low_power_is_that_of_the_crankshaft():
    run = by_hand([57e3, 54e3], [0.0] * 2, [0.004] * 2, soc=0.55, params=FIELD)
    assert run_figures(run, FIELD)["below_60kw_s"] == 1.0  # 57 kW at the bus are 61 kW before it


def test_a_full_cycle_is_the_nominal_energy_out_and_in_again():
    energy_j, hour_s = PAPER.battery.energy_j, 3600
    power_w = 0.1 * energy_j / hour_s  # a tenth out and a tenth in: a tenth of a full cycle
    battery_w = np.concatenate([np.full(hour_s, power_w), np.full(hour_s, -power_w)])
    figures = run_figures(by_hand([0.0] * 7200, battery_w, [0.0] * 7200), PAPER)
    assert figures["equivalent_full_cycles"] == pytest.approx(0.1)
    assert figures["battery_throughput_kwh"] == pytest.approx(0.2 * energy_j / 3.6e6)
    assert figures["soc_excursion"] == pytest.approx(0.1)
    assert figures["soc_min"] == pytest.approx(0.7) and figures["soc_max"] == pytest.approx(0.8)
    assert figures["soc_final"] == pytest.approx(0.8)


def test_the_last_moment_counts_for_the_soc_extremes():
    run = by_hand([0.0], [200e3], [0.0])
    result = result_of(run)
    assert result.soc_min == run.soc_final < 0.8
    assert result.soc_deviation == pytest.approx(run.soc_final - 0.79)


def test_a_user_cycle_has_no_split_and_a_validation_cycle_is_unseen():
    run = by_hand([100e3], [0.0], [0.1])
    assert (result_of(run).split, result_of(run).held_out) == (None, False)
    assert result_of(run, split="validation").held_out
    assert not result_of(run, split="train").held_out


def explained(run, params):
    """The run with the SOC and the fuel that follow from its powers."""
    soc = [0.55]
    for power_w in run.battery_power_w:
        soc.append(float(soc_after(params.battery, np.array(soc[-1]), power_w, params.dt_s)))
    peak_w, on = params.engine.power_max_w, run.engine_on
    crank_w = to_crank_w(params.generator, run.engine_power_w, peak_w)
    fuel_kg = fuel_rate_kg_per_s(params.engine, crank_w, on) * params.dt_s
    fuel_kg[on & ~np.append(False, on[:-1])] += params.engine.start_fuel_kg
    return replace(run, soc=np.array(soc[:-1]), soc_final=soc[-1], fuel_kg=fuel_kg)


STEADY = by_hand([50e3] + [100e3] * 6, [0.0] * 7, [0.01] * 7, soc=0.55, params=FIELD)


def test_a_run_within_all_limits_has_no_violation():
    assert count_violations(explained(STEADY, FIELD), FIELD) == 0


@pytest.mark.parametrize(
    ("limit", "engine_w", "battery_w"),
    [
        ("engine power at the bus", [50e3, 100e3, 150e3, 200e3, 250e3, 250e3, 254e3], 0.0),
        ("engine ramp", [50e3, 180e3, 180e3, 180e3, 180e3, 180e3, 180e3], 0.0),
        ("minimum on time", [9e3, 9e3, 9e3, 0, 0, 0, 0], 0.0),
        ("minimum off time", [9e3, 9e3, 9e3, 9e3, 9e3, 0, 9e3], 0.0),
        ("battery current", [50e3] * 7, -149e3),
    ],
)
def test_each_limit_of_the_field_plant_counts_once(limit, engine_w, battery_w):
    engine_w = np.array(engine_w)
    charge_w = np.array([0.0] * 6 + [battery_w])
    run = replace(
        STEADY,
        engine_power_w=engine_w,
        engine_on=engine_w > 0,
        battery_power_w=charge_w,
        power_demand_w=engine_w + charge_w,
    )
    run = explained(run, FIELD)
    params = FIELD
    if limit == "battery current":
        params = replace(FIELD, battery=replace(FIELD.battery, current_max_charge_a=200.0))
        assert count_violations(run, FIELD) == 0
    assert count_violations(run, params) == 1, limit
