"""The compiled loops drive as the policies do, and their reference is the optimum."""

import numpy as np
import pytest

from tractor_ems.drive import drive
from tractor_ems.optimal.one_step_kernel import Cell
from tractor_ems.policies.a_ecms import AEcms
from tractor_ems.policies.genset import power_max_w, running_fuel_kg_per_s
from tractor_ems.tuning import closed_loop
from tractor_sim.batch import batch_plant
from tractor_sim.config import load_powertrain

FIELD = load_powertrain("field")
BATTERY = FIELD.battery
CELL = Cell(BATTERY.resistance_ohm, BATTERY.charge_c / FIELD.dt_s, BATTERY.power_max_w)


def work(steps):
    """A minute of light work and half a minute of passes, in turn."""
    k = np.arange(steps)
    return np.where(k % 90 < 60, 25e3, 140e3) + 5e3 * np.sin(k / 7.0)


def low_passed(demand_w, time_s):
    gain, value, out = 1.0 - np.exp(-1.0 / time_s), demand_w[0], []
    for power_w in demand_w:
        value += gain * (power_w - value)
        out.append(value)
    return np.array(out)


@pytest.mark.slow
def test_the_compiled_ecms_drives_as_the_policy_does():
    demand_w = work(600)
    policy = AEcms(FIELD, equivalence=2.42, adapt=0.05, write_off_s=60.0, stiffen_s=40.0)
    run = drive(policy, FIELD, demand_w[None, :], 0.55, 0.55)[0]
    settings = np.array([
        policy.equivalence / FIELD.engine.fuel_lhv_j_per_kg, policy.soc_gain, policy.adapt,
        FIELD.engine.start_fuel_kg / policy.write_off_s, 0.0, policy.stiffen_s,
    ])  # fmt: skip
    most_w = power_max_w(FIELD)
    fuel_kg = running_fuel_kg_per_s(FIELD, np.linspace(0.0, most_w, 4097)) * FIELD.dt_s
    totals = np.zeros(9)
    closed_loop.drive_ecms(
        *batch_plant(FIELD), CELL, fuel_kg, most_w, demand_w, low_passed(demand_w, 20.0),
        np.arange(600.0, 0.0, -1.0), 0.55, 0.55, settings, totals, np.zeros((0, 3)),
    )  # fmt: skip
    assert totals[closed_loop.FUEL] == pytest.approx(run.fuel_kg.sum(), rel=1e-4)
    assert totals[closed_loop.SOC_FINAL] == pytest.approx(run.soc_final, abs=1e-4)
    starts = np.sum(run.engine_on & ~np.append(False, run.engine_on[:-1]))
    assert totals[closed_loop.STARTS] == starts >= 1
