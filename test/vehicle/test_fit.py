"""``ems vehicle fit`` gets known parameters back within its errors; it says what it cannot see."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from vehicle.recordings import samples, write

from tractor_ems.bags.transitions import iter_traces
from tractor_ems.cli import main
from tractor_ems.vehicle.fit import fit
from tractor_ems.vehicle.fit_battery import fit_battery
from tractor_ems.vehicle.fit_fuel import fit_fuel
from tractor_ems.vehicle.fit_yaml import missing_parts, write_fit
from tractor_msgs_py.errors import BagError, ConfigError
from tractor_sim.battery import open_circuit_v
from tractor_sim.config import load_powertrain
from tractor_sim.engine import fuel_rate_kg_per_s
from tractor_sim.generator import to_crank_w
from tractor_sim.powertrain import Command, PlantState, step

FIELD = load_powertrain("field")


def by_name(found):
    return {item.name: item for item in found.estimates}


def true_fuel(bus_w, params=FIELD):
    crank_w = to_crank_w(params.generator, bus_w, params.engine.power_max_w)
    return fuel_rate_kg_per_s(params.engine, crank_w, np.ones(len(bus_w), bool))


def within(estimate, truth, errors=3.0):
    assert estimate.verdict == "identified", estimate
    assert abs(estimate.value - truth) <= errors * estimate.error, (estimate, truth)


@pytest.fixture(scope="module")
def field_fit(varied_field_bag):
    return fit(varied_field_bag)


@pytest.fixture(scope="module")
def paper_fit(varied_paper_bag):
    return fit(varied_paper_bag)


@pytest.fixture(scope="module")
def steady_fit(steady_bag):
    return fit(steady_bag)


def with_rest_from(found, powertrain):
    return dataclasses.replace(found, base=powertrain and load_powertrain(powertrain))


def test_known_parameters_come_back_within_their_errors(field_fit):
    estimates = by_name(field_fit)
    within(estimates["engine.start_fuel_kg"], 0.015)
    within(estimates["engine.idle_fuel_kg_per_s"], 0.25e-3)
    within(estimates["battery.resistance_ohm"], 0.08)
    within(estimates["battery: charge [C]"], FIELD.battery.charge_c)
    assert estimates["engine.start_fuel_kg"].error < 0.1e-3
    assert estimates["battery.resistance_ohm"].error < 0.8e-3
    assert estimates["battery: charge [C]"].error < 1e-3 * FIELD.battery.charge_c


def test_the_fuel_curve_comes_back_within_its_errors(field_fit):
    fuel = field_fit.fuel
    off = np.abs(fuel.fuel_kg_per_s - true_fuel(fuel.bus_w))
    assert np.all(off <= 3.0 * fuel.error_kg_per_s + 1e-12)
    between_w = np.linspace(fuel.bus_w[0], fuel.bus_w[-1], 500)
    apart = fuel.fuel_at(between_w) / true_fuel(between_w) - 1.0
    assert np.abs(apart).max() < 0.01 and np.sqrt(np.mean(apart**2)) < 0.002


def test_open_circuit_voltage_comes_back_within_its_errors(field_fit):
    battery = field_fit.battery
    off = np.abs(battery.ocv_v - open_circuit_v(FIELD.battery, battery.ocv_soc))
    assert np.all(off <= 3.0 * battery.ocv_error_v)
    assert battery.ocv_error_v.max() < 0.1


def test_bounds_hold_and_what_the_bus_hides_is_said(field_fit):
    estimates = by_name(field_fit)
    ramp = estimates["engine.ramp_w_per_s, at the bus"]
    assert ramp.verdict == "bound" and 50e3 < ramp.value <= 60e3
    for name in ("engine.min_on_s", "engine.min_off_s"):
        assert estimates[name].verdict == "bound" and estimates[name].value >= 5.0
    hidden = {item.name for item in field_fit.not_identified}
    assert {"generator.curve_efficiency", "engine.fuel_lhv_j_per_kg"} <= hidden
    assert estimates["p_aux_w"].verdict == "announced"


@pytest.mark.parametrize("powertrain", [None, "field"])
def test_the_file_of_a_fit_drives_as_the_recorded_vehicle_did(
    field_fit, varied_field_bag, powertrain, tmp_path
):
    """Every recorded step once more from the recorded state: fuel and SOC move alike.

    But for steps at the edge of the window, which without a powertrain is what was visited, and
    for those that the ramp left short, because without a powertrain there is no ramp.
    """
    out = tmp_path / "fitted.yaml"
    write_fit(with_rest_from(field_fit, powertrain), out)
    params = load_powertrain(out)
    (trace,) = iter_traces([varied_field_bag])
    room = np.minimum(trace.soc - params.battery.soc_min, params.battery.soc_max - trace.soc)
    inside = np.minimum(room[1:], room[:-1]) > 0.001
    inside &= (trace.shortfall_j == 0.0) & (trace.dissipated_j == 0.0)
    state = PlantState(
        trace.soc[:-1],
        trace.engine_on[:-1],
        np.full(len(trace), 100.0),
        np.append(0.0, trace.engine_power_w[:-1]),
    )
    off_w = np.where(trace.engine_on[1:], np.nan, 0.0)
    after, result = step(
        params, state, trace.power_demand_w, Command(trace.battery_power_w, off_w)
    )
    assert inside.mean() > 0.75
    burnt_kg = result.fuel_kg[inside].sum()
    assert burnt_kg == pytest.approx(trace.fuel_kg[inside].sum(), rel=1e-3)
    np.testing.assert_allclose(after.soc[inside], trace.soc[1:][inside], rtol=0, atol=2e-6)


def test_what_is_not_in_the_recording_comes_from_the_named_powertrain(field_fit, tmp_path):
    out = tmp_path / "fitted.yaml"
    origins = write_fit(with_rest_from(field_fit, "field"), out)
    params = load_powertrain(out)
    assert params.generator == FIELD.generator
    assert (params.engine.ramp_w_per_s, params.engine.min_on_s) == (60e3, 5.0)
    assert (params.battery.soc_min, params.battery.soc_max) == (0.30, 0.80)
    assert origins["generator, heating value"] == "powertrain field"
    assert "fitted" in origins["engine.curves"]
    soc = np.linspace(0.30, 0.80, 50)
    ocv_v = open_circuit_v(params.battery, soc)
    np.testing.assert_allclose(ocv_v, open_circuit_v(FIELD.battery, soc), rtol=0, atol=0.2)
    for name, origin in origins.items():
        assert f"# {name}: {origin}" in out.read_text()


def test_noise_widens_the_errors_and_they_still_hold(field_fit):
    """Half a volt, an ampere with an offset of half of one, 2 % of fuel."""
    rng, clean = np.random.Generator(np.random.PCG64(3)), field_fit.recorded
    volts, amperes, share = rng.standard_normal((3, len(clean)))
    recorded = dataclasses.replace(
        clean,
        voltage_v=clean.voltage_v + 0.5 * volts,
        current_a=clean.current_a + 0.5 + amperes,
        fuel_kg=clean.fuel_kg * (1.0 + 0.02 * share),
    )
    battery, fuel = fit_battery(recorded), fit_fuel(recorded, 42.7e6)
    estimates = {item.name: item for item in (*battery.estimates, *fuel.estimates)}
    within(estimates["engine.start_fuel_kg"], 0.015)
    within(estimates["battery.resistance_ohm"], 0.08)
    within(estimates["battery: charge [C]"], FIELD.battery.charge_c)
    assert 0.4 < battery.rms_v < 0.7
    off = np.abs(fuel.fuel_kg_per_s - true_fuel(fuel.bus_w))
    assert np.all(off <= 3.0 * fuel.error_kg_per_s)


def test_a_voltage_that_never_moves_tells_no_resistance(paper_fit):
    estimates = by_name(paper_fit)
    resistance = estimates["battery.resistance_ohm"]
    assert resistance.verdict == "not_identified" and "stays at 650.00 V" in resistance.why
    within(estimates["battery: charge [C]"], 666e6 / 650.0)
    within(estimates["engine.start_fuel_kg"], 0.0)
    assert {"battery.ocv_v", "battery.resistance_ohm"} <= set(missing_parts(paper_fit))


def test_only_data_that_are_not_convex_are_called_so(paper_fit, field_fit):
    assert "not convex" in paper_fit.estimates[0].why
    assert "not convex" not in field_fit.estimates[0].why


def test_a_constant_demand_tells_one_point_and_says_what_else_it_does_not(steady_fit):
    estimates = by_name(steady_fit)
    point = estimates["engine: fuel at 90.0 kW at the bus [kg/s]"]
    assert point.value == pytest.approx(true_fuel(np.array([90e3]))[0], rel=1e-9)
    for name in (
        "engine: fuel curve",
        "engine.idle_fuel_kg_per_s",
        "engine.start_fuel_kg",
        "engine.min_on_s",
        "battery: charge [C]",
        "battery.resistance_ohm",
        "generator.curve_efficiency",
        "battery.soc_min, battery.soc_max",
    ):
        assert estimates[name].verdict == "not_identified" and estimates[name].why


def test_too_little_for_a_vehicle_is_refused_without_one_to_take_the_rest_from(
    steady_fit, tmp_path
):
    out = tmp_path / "fitted.yaml"
    with pytest.raises(ConfigError, match=r"engine: fuel curve.*--powertrain"):
        write_fit(steady_fit, out)
    assert not out.exists()
    write_fit(with_rest_from(steady_fit, "field"), out)
    params = load_powertrain(out)
    assert params.engine.start_fuel_kg == 0.015 and params.battery == FIELD.battery
    bus_w = np.linspace(0.0, 253e3, 99)
    np.testing.assert_allclose(true_fuel(bus_w, params), true_fuel(bus_w), rtol=1e-9)


def test_a_powertrain_that_is_too_weak_for_the_recording_is_refused(field_fit, tmp_path):
    with pytest.raises(ConfigError, match="utility_150kw allows"):
        write_fit(with_rest_from(field_fit, "utility_150kw"), tmp_path / "fitted.yaml")


def test_powers_never_visited_are_named(tmp_path):
    """Two bands of power with 40 kW between them, from one start only."""
    rng = np.random.Generator(np.random.PCG64(5))
    engine_w = np.where(np.arange(240) < 120, rng.uniform(60e3, 100e3, 240), 0.0)
    engine_w[120:] = rng.uniform(140e3, 160e3, 120)
    found = fit(write(tmp_path / "bag", samples("field", engine_w + 5e3, engine_w)))
    (gap,) = found.fuel.gaps_w
    assert 97e3 < gap[0] < gap[1] < 143e3
    estimates = by_name(found)
    assert "never visited" in estimates["engine: fuel curve, residual [kg/s]"].why
    assert estimates["engine.idle_fuel_kg_per_s"].verdict == "not_identified"


def test_a_handful_of_powers_is_no_curve(field_fit):
    clean = field_fit.recorded
    held_w = np.round(clean.engine_w / 60e3) * 60e3
    fit_of_few = fit_fuel(dataclasses.replace(clean, engine_w=held_w), 42.7e6)
    assert not fit_of_few.identified
    assert "different powers" in fit_of_few.estimates[0].why


def test_coarse_soc_and_missing_voltage_are_named(field_fit):
    clean = field_fit.recorded
    found = fit_battery(
        dataclasses.replace(
            clean,
            soc=np.round(clean.soc / 0.005) * 0.005,
            voltage_v=np.full(len(clean), np.nan),
        )
    )
    assert any("SOC comes in" in note for note in found.notes)
    charge, resistance, _ = found.estimates
    assert "0 steps with voltage" in resistance.why
    within(charge, FIELD.battery.charge_c)
    assert charge.error > by_name(field_fit)["battery: charge [C]"].error


def test_a_battery_only_discharged_by_little_says_so(tmp_path):
    rng = np.random.Generator(np.random.PCG64(6))
    battery_w = rng.uniform(2e3, 3e3, 150)
    engine_w = np.full(150, 50e3)
    found = fit(write(tmp_path / "bag", samples("field", engine_w + battery_w, engine_w)))
    notes = " ".join(found.battery.notes)
    assert "only ever discharged" in notes
    assert by_name(found)["battery: charge [C]"].verdict == "not_identified"


def test_demand_alone_and_two_vehicles_at_once_are_refused(tmp_path):
    golden = Path(__file__).resolve().parents[2] / "bags"
    with pytest.raises(BagError, match="demand alone"):
        fit(golden / "demand_only")
    power = np.full(40, 60e3)
    said = [*samples("field", power, power), *samples("wheel_loader", power, power)]
    with pytest.raises(BagError, match="runs of 2 powertrains"):
        fit(write(tmp_path / "bag", said))


def test_the_command_prints_one_document_and_writes_a_vehicle(steady_bag, tmp_path, capsys):
    out = tmp_path / "fitted.yaml"
    words = ["vehicle", "fit", str(steady_bag), "--powertrain", "field", "--out", str(out)]
    assert main([*words, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["rest_from"] == "field" and document["out"] == str(out)
    assert "engine: fuel curve" in document["missing"] and document["origins"]
    assert load_powertrain(out).name == "fitted_field"


def test_a_vehicle_that_is_there_already_is_replaced_only_with_force(steady_bag, tmp_path, capsys):
    out = tmp_path / "mine.yaml"
    out.write_text("name: mine\n")
    words = ["vehicle", "fit", str(steady_bag), "--powertrain", "field", "--out", str(out)]
    assert main(words) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    assert str(out) in captured.err and "--force" in captured.err
    assert out.read_text() == "name: mine\n"
    assert main([*words, "--force"]) == 0
    assert load_powertrain(out).name == "fitted_field"


def test_the_table_names_what_is_not_identified(steady_bag, capsys):
    assert main(["vehicle", "fit", str(steady_bag)]) == 0
    text = capsys.readouterr().out
    assert "not_identified" in text and "battery.resistance_ohm" in text


@pytest.mark.parametrize("words", [["nothing"], ["nothing", "--json"]])
def test_a_bag_that_is_not_there_ends_with_code_2(words, capsys):
    assert main(["vehicle", "fit", *words]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
