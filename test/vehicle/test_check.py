"""``ems vehicle check`` finds what is implausible, and says how far the hull is from the data."""

import functools
import json

import numpy as np
import pytest

from tractor_ems.cli import main
from tractor_ems.drive import drive
from tractor_ems.policies.rules import Conventional
from tractor_ems.vehicle.check import check
from tractor_ems.vehicle.check_battery import PASS_START, bridging
from tractor_ems.vehicle.curves import fuel_curves, load_vehicle, round_trip_efficiency
from tractor_sim.config import load_powertrain, read_powertrain
from tractor_sim.engine import fuel_rate_kg_per_s

SHIPPED = ("paper", "paper_table1", "field", "utility_150kw", "wheel_loader")

SMALL = """
name: small
dt_s: 1.0
p_aux_w: 1000.0
soc_initial: 0.5
engine:
  power_max_w: 100000.0
  fuel_lhv_j_per_kg: 42.7e+6
  curve: bumped
  curves:
    bumped: {power_w: [0, 50000, 100000], fuel_kg_per_s: [0.001, 0.005, 0.007]}
battery:
  {energy_j: 72.0e+6, voltage_v: 400.0, power_max_w: 60000.0, soc_min: 0.3, soc_max: 0.8,
   resistance_ohm: 0.05}
"""


@functools.cache
def found(name):
    return {item.field: item for item in check(name)[0].findings}


@pytest.mark.parametrize("name", SHIPPED)
def test_no_shipped_vehicle_has_an_error(name):
    assert not [item for item in found(name).values() if item.severity == "error"]


def test_the_field_tractor_is_plausible_but_for_its_hull():
    warned = [item.field for item in found("field").values() if item.severity == "warning"]
    assert warned == ["engine: hull below the data"]


IMPLAUSIBLE = {
    "engine.fuel_lhv_j_per_kg=38e6": ("engine: peak efficiency", "warning"),
    "engine.fuel_lhv_j_per_kg=46e6": ("engine.fuel_lhv_j_per_kg", "warning"),
    "engine.idle_fuel_kg_per_s=0": ("engine: idle fuel over fuel at rated power", "warning"),
    "engine.start_fuel_kg=0.2": ("engine.start_fuel_kg", "warning"),
    "engine.min_off_s=120": ("engine.min_off_s", "warning"),
    "engine.ramp_w_per_s=20e3": ("engine: seconds to full power", "warning"),
    "engine.ramp_w_per_s=400e3": ("engine: seconds to full power", "warning"),
    "engine.ramp_w_per_s=null": ("engine: seconds to full power", "note"),
    "p_aux_w=40e3": ("p_aux_w over rated engine power", "warning"),
    "p_aux_w=0": ("p_aux_w", "note"),
    "battery.energy_j=36e6": ("battery: C-rate at the power limit", "warning"),
    "battery.voltage_v=500": ("battery.voltage_v over mean OCV of the window", "warning"),
    "battery.resistance_ohm=0.6": ("battery: loss at the discharge limit", "warning"),
    "battery.resistance_ohm=1": ("battery.power_max_w", "error"),
    "battery.resistance_ohm=0": ("battery.resistance_ohm", "warning"),
    "battery.soc_max=0.56": ("soc_initial", "warning"),
    "battery.current_max_discharge_a=100": ("battery.current_max_discharge_a", "note"),
    "battery.power_max_w=10e3": ("bridging power [W] over the battery's limit", "error"),
}


@pytest.mark.parametrize("setting", IMPLAUSIBLE)
def test_an_implausible_value_is_flagged_and_was_not_before(setting):
    name, severity = IMPLAUSIBLE[setting]
    assert name not in found("field")
    item = found(f"field:{setting}")[name]
    assert item.severity == severity and item.why


def test_the_papers_simplifications_are_named():
    names = set(found("paper"))
    assert {
        "engine: fuel above its convex hull",
        "generator.curve_efficiency",
        "battery.resistance_ohm",
        "battery.ocv_v",
        "engine: seconds to full power",
    } <= names


def test_findings_come_worst_first():
    order = [
        item.severity for item in check("field:battery.power_max_w=10e3,p_aux_w=0")[0].findings
    ]
    assert order == sorted(order, key=("error", "warning", "note").index)
    assert {"error", "warning", "note"} == set(order)


def test_the_hull_of_a_known_bump_departs_by_a_fifth_in_the_middle(tmp_path):
    """Data 1, 5, 7 g/s at 0, 50, 100 kW: the chord is at 4 g/s where the data are at 5."""
    path = tmp_path / "small.yaml"
    path.write_text(SMALL)
    report, _ = check(str(path))
    hull = report.hull
    assert hull.driven
    assert hull.largest == pytest.approx(0.2)
    assert hull.at_crank_w == hull.at_bus_w == 50e3
    assert hull.largest_kg_per_s == pytest.approx(1e-3)
    finding = next(f for f in report.findings if f.field == "engine: hull below the data")
    assert finding.value == pytest.approx(0.2)


def test_an_efficiency_curve_is_shown_as_the_fuel_it_means_and_as_not_changed():
    vehicle = load_vehicle("paper")
    on = np.ones(len(vehicle.data_power_w), bool)
    expected = fuel_rate_kg_per_s(vehicle.params.engine, vehicle.data_power_w, on)
    np.testing.assert_array_equal(vehicle.data_fuel_kg_per_s, expected)
    report, _ = check("paper")
    assert not report.hull.driven and report.hull.largest > 0.5


def test_data_are_the_files_and_the_hull_is_what_is_driven():
    vehicle = load_vehicle("field")
    engine = read_powertrain("field")[1]["engine"]
    written = engine["curves"]["optimal_line"]
    np.testing.assert_array_equal(vehicle.data_power_w[1:], written["power_w"])
    assert vehicle.data_fuel_kg_per_s[0] == engine["idle_fuel_kg_per_s"]
    curves = fuel_curves(vehicle)
    on = np.ones(len(curves.crank_w), bool)
    driven = fuel_rate_kg_per_s(vehicle.params.engine, curves.crank_w, on)
    np.testing.assert_allclose(curves.hull_kg_per_s, driven, rtol=1e-12)


def test_figures_follow_from_the_file():
    figures = check("field")[0].figures
    curve = read_powertrain("field")[1]["engine"]["curves"]["optimal_line"]
    eta = np.array(curve["power_w"]) / (np.array(curve["fuel_kg_per_s"]) * 42.7e6)
    assert figures["engine_peak_efficiency"] == pytest.approx(eta.max(), rel=1e-9)
    assert figures["engine_least_bsfc_g_per_kwh"] == pytest.approx(3.6e9 / (eta.max() * 42.7e6))
    assert figures["engine_bus_power_max_w"] == pytest.approx(253e3)
    assert figures["engine_seconds_to_full_power"] == pytest.approx(275 / 60)
    assert figures["battery_charge_ah"] == pytest.approx(40e3 / 650)
    assert figures["battery_c_rate"] == pytest.approx(150 / 40)
    assert figures["battery_matched_load_w"] == pytest.approx(659.06**2 / 0.32)


def test_round_trip_is_voltage_out_over_voltage_in():
    """The currents are the roots of R I^2 -+ OCV I +- P, out and in."""
    battery = load_powertrain("field:battery.resistance_ohm=0.4").battery
    power_w = np.array([0.0, 60e3, 120e3])
    efficiency = round_trip_efficiency(battery, 0.55, power_w)
    assert efficiency[0] == 1.0
    for p, eta in zip(power_w[1:], efficiency[1:], strict=True):
        out_a = min(np.roots([0.4, -659.06, p]).real)
        in_a = max(np.roots([0.4, 659.06, -p]).real)
        assert eta == pytest.approx((659.06 - 0.4 * out_a) / (659.06 + 0.4 * in_a), rel=1e-9)


def test_bridging_power_is_what_the_plant_needs_at_a_measured_pass_start():
    base = load_powertrain("field")
    needed_w, needed_j = bridging(base)
    low, high, rate = PASS_START
    seconds = np.arange(10.0)
    demand_w = 253e3 * np.minimum(low + rate * seconds, high) + base.p_aux_w
    for share, short in ((1.001, False), (0.98, True)):
        params = load_powertrain(f"field:battery.power_max_w={needed_w * share}")
        (run,) = drive(Conventional(), params, demand_w[None, :], 0.55, 0.55)
        assert (run.shortfall_j.sum() > 0.0) == short
    (run,) = drive(Conventional(), base, demand_w[None, :], 0.55, 0.55)
    assert np.maximum(run.battery_power_w, 0.0).sum() == pytest.approx(needed_j)


@pytest.mark.slow
def test_the_command_prints_one_document_and_draws(tmp_path, capsys):
    picture = tmp_path / "curves.png"
    assert main(["vehicle", "check", "field", "--plot", str(picture), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["powertrain"] == "field" and document["plot"] == str(picture)
    assert document["hull"]["largest"] > 0.0
    assert {"severity", "field", "value", "plausible", "why"} == set(document["findings"][0])
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert picture.stat().st_size < 150_000


def test_warnings_are_no_failure_and_say_where_the_hull_is(capsys):
    assert main(["vehicle", "check", "utility_150kw"]) == 0
    text = capsys.readouterr().out
    assert "convex hull that is driven lies below the data by up to" in text
    assert "kW at the bus" in text and "warning" in text


@pytest.mark.parametrize("name", ["nothing", "field:engine.nothing=1", "missing.yaml"])
def test_what_cannot_be_read_ends_with_code_2(name, capsys):
    assert main(["vehicle", "check", name]) == 2
    assert capsys.readouterr().err.count("\n") == 1
