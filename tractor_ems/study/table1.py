"""The paper's Table 1: a 13-minute planter operation, conventional and under two rules.

The paper prints fuel and final SOC only. Vehicle (``config/powertrain/paper_table1.yaml``),
cycle and both rules are assumptions fitted to its five numbers: calibrated, not reproduced.
"""

import numpy as np

from tractor_ems.drive import drive
from tractor_ems.policies.protocol import Policy
from tractor_ems.policies.rules import Conventional, RuleBased
from tractor_ems.study.paper_values import SETTINGS, TABLE_1
from tractor_ems.study.results import Table1Row
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.planter import PlanterParams, planter_demand_w
from tractor_sim.fuel import gallons

POWERTRAIN = "paper_table1"

CYCLE = PlanterParams(
    duration_s=780,
    dt_s=1.0,
    mean_w=118.0e3,
    pass_mean_w=155.0e3,
    pass_scale_w=35.0e3,
    ar_coefficient=0.97,
    ar_innovation_sd=0.25,
    turn_duration_s=14,
    turn_period_min_s=80,
    turn_period_max_s=110,
    turn_mean_w=45.0e3,
    turn_sd_w=10.0e3,
    clip_min_w=5.0e3,
    clip_max_w=270.0e3,
)
"""The planter family of config/cycle/planter.yaml over 13 minutes. Fitted: the mean, to the
conventional 1.69 gal, and the spread in a pass (35 kW for 25), so that demand reaches 216 kW."""

SEED = 6
"""Of the seeds 1..12 the one that reaches 216 kW with the mean nearest to 120 kW. No shipped
cycle: length, mean and spread are others."""

PEAK_W = 216e3
"""Where demand is clipped, after scaling. The table's title says "at 216 kW load"; as a mean that
needs :func:`efficiency_at_mean_load`, so it is taken as the peak."""

CONTROL_1_THRESHOLD_W, CONTROL_2_THRESHOLD_W = 60e3, 115e3
"""The two controls, of which the paper says only that the second is the first adjusted: assumed
to be its own rule base, "the engine carries demand above a threshold, the battery the rest",
without SOC guard, at two thresholds. 60 kW is where the paper's inefficient region ends, 115 kW
is fitted. Control 1 then rests the engine in headland turns, Control 2 in light passes too."""


def table1_demand_w() -> FloatArray:
    """Demand at the bus, shape (780,) [W]: mean 118 kW, peak 216 kW."""
    return np.minimum(planter_demand_w(CYCLE, SEED), PEAK_W)


def table1_rows() -> tuple[Table1Row, ...]:
    """``conventional``, ``control_1`` and ``control_2``, driven here."""
    params, demand_w = load_powertrain(POWERTRAIN), table1_demand_w()
    policies: dict[str, Policy] = {
        "conventional": Conventional(),
        "control_1": RuleBased(params, CONTROL_1_THRESHOLD_W, soc_guard=False),
        "control_2": RuleBased(params, CONTROL_2_THRESHOLD_W, soc_guard=False),
    }
    rows = []
    for name, policy in policies.items():
        run = drive(policy, params, demand_w[None, :], params.soc_initial, params.soc_initial)[0]
        rows.append(Table1Row(name, float(run.fuel_kg.sum()), run.soc_final))
    return tuple(rows)


def efficiency_at_mean_load() -> float:
    """Engine efficiency that 216 kW as the mean of 13 minutes would need on the printed
    conventional fuel: 0.74, which no diesel engine has."""
    load_j = SETTINGS.table1_load_w * SETTINGS.table1_duration_s
    return load_j / _fuel_energy_j(TABLE_1[0].fuel_gal)


def implied_battery_j(engine_efficiency: float) -> float:
    """Battery energy that the two printed controls imply [J].

    What Control 2 burns less, times the engine efficiency, is what it takes out of the battery
    more: 44.8 MJ of fuel for 6 % of SOC. 87 kWh at 0.42, 90 kWh at 0.435.
    """
    _, first, second = TABLE_1
    assert first.soc_final is not None and second.soc_final is not None
    saved_j = _fuel_energy_j(first.fuel_gal) - _fuel_energy_j(second.fuel_gal)
    return engine_efficiency * saved_j / (first.soc_final - second.soc_final)


def _fuel_energy_j(fuel_gal: float) -> float:
    fuel_kg = fuel_gal / gallons(1.0)
    return fuel_kg * load_powertrain(POWERTRAIN).engine.fuel_lhv_j_per_kg
