"""Table 1: the fitted vehicle, cycle and rules land on the five printed numbers."""

import numpy as np
import pytest

from tractor_ems.study.paper_values import TABLE_1
from tractor_ems.study.results import Table1Row
from tractor_ems.study.table1 import (
    efficiency_at_mean_load,
    implied_battery_j,
    table1_demand_w,
    table1_rows,
)
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.shipped import listed_name
from tractor_sim.fuel import gallons

PRINTED = {value.id: value for value in TABLE_1}


@pytest.fixture(scope="module")
def rows() -> dict[str, Table1Row]:
    return {row.id: row for row in table1_rows()}


def test_the_table_has_the_papers_three_columns(rows: dict[str, Table1Row]):
    assert list(rows) == [value.id for value in TABLE_1]


@pytest.mark.parametrize("name", ["conventional", "control_1", "control_2"])
def test_fuel_is_within_1_percent_of_the_printed(rows: dict[str, Table1Row], name: str):
    assert gallons(rows[name].fuel_kg) == pytest.approx(PRINTED[name].fuel_gal, rel=0.01)


@pytest.mark.parametrize("name", ["control_1", "control_2"])
def test_final_soc_is_within_half_a_point_of_the_printed(rows: dict[str, Table1Row], name: str):
    assert rows[name].soc_final == pytest.approx(PRINTED[name].soc_final, abs=0.005)


def test_the_conventional_vehicle_leaves_the_battery_alone(rows: dict[str, Table1Row]):
    initial = load_powertrain("paper_table1").soc_initial
    assert rows["conventional"].soc_final == pytest.approx(initial, abs=1e-12)


def test_the_cycle_is_13_minutes_with_its_peak_at_216_kw_and_a_mean_near_120():
    demand_w = table1_demand_w()
    assert demand_w.shape == (780,)
    assert demand_w.max() == 216e3
    assert demand_w.mean() == pytest.approx(120e3, rel=0.02)
    assert np.mean(demand_w == 216e3) < 0.02


def test_the_cycle_is_the_same_every_time_and_no_shipped_one():
    demand_w = table1_demand_w()
    assert np.array_equal(demand_w, table1_demand_w())
    assert listed_name(demand_w, 1.0) is None


def test_216_kw_as_a_mean_would_need_74_percent_efficiency():
    assert efficiency_at_mean_load() == pytest.approx(0.74, abs=0.006)
    assert efficiency_at_mean_load() > max(load_powertrain("paper_table1").engine.curve_efficiency)


def test_the_two_controls_imply_87_to_90_kwh_not_the_185_of_the_other_tables():
    low_kwh, high_kwh = (implied_battery_j(eta) / 3.6e6 for eta in (0.42, 0.435))
    assert low_kwh == pytest.approx(87.0, abs=0.5)
    assert high_kwh == pytest.approx(90.0, abs=0.5)
    assert load_powertrain("paper_table1").battery.energy_j / 3.6e6 == pytest.approx(87.0)
    assert high_kwh < 0.5 * load_powertrain("paper").battery.energy_j / 3.6e6
