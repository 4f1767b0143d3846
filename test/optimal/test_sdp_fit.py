"""Fitted tables drive near the optimum where the chain tells all, and never beyond it."""

import numpy as np
import pytest

from tractor_ems.drive import drive
from tractor_ems.optimal.engine_dp import solve_engine
from tractor_ems.optimal.sdp import cell_of
from tractor_ems.optimal.sdp_fit import SdpSettings, features_of, fit_sdp, machine_of
from tractor_ems.tuning import closed_loop
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.observation import DemandFilter
from tractor_sim.batch import batch_plant
from tractor_sim.config import load_powertrain

FIELD = load_powertrain("field")
STEADY_W = np.full(900, 45e3)
MIXED_W = np.where(np.arange(900) % 150 < 90, 28e3, 130e3)


def test_features_are_what_a_policy_would_see():
    fast = DemandFilter("low_pass", 20.0)
    long, short = features_of((fast,), [MIXED_W, MIXED_W[:200] + 5e3], 1.0)
    value = MIXED_W[0]
    for power_w in MIXED_W[1:]:
        value += (1.0 - np.exp(-1.0 / 20.0)) * (power_w - value)
    assert long.shape == (900, 2) and short.shape == (200, 2)
    assert long[-1] == pytest.approx([MIXED_W[-1], value])


@pytest.mark.parametrize(
    ("field", "value"), [("end_kg", 0.0), ("gamma", 1.0), ("slow", "mean"), ("varied", 99.0)]
)
def test_a_setting_out_of_range_is_refused_by_name(field, value):
    with pytest.raises(ConfigError, match=field):
        SdpSettings(**{field: value})


def test_nothing_to_count_is_refused():
    with pytest.raises(ConfigError, match="two steps"):
        fit_sdp(FIELD, [], SdpSettings())


@pytest.mark.slow
def test_where_demand_is_known_the_table_finds_the_optimum_and_nothing_beats_it():
    policy = fit_sdp(FIELD, [STEADY_W], SdpSettings())
    (run,) = drive(policy, FIELD, STEADY_W[None, :], 0.55, 0.55)
    optimum = solve_engine(FIELD, STEADY_W, 0.55, run.soc_final)
    ratio = optimum.lower_bound_kg / run.fuel_kg.sum()
    assert 0.995 < ratio <= 1.0005
    assert abs(run.soc_final - 0.55) < 0.02
    assert run.shortfall_j.sum() == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("planned", [True, False])
def test_the_compiled_table_drives_as_the_policy_does(planned):
    settings = SdpSettings(planned=planned, sweeps=200)
    policy = fit_sdp(FIELD, [MIXED_W, STEADY_W], settings)
    (run,) = drive(policy, FIELD, MIXED_W[None, :], 0.55, 0.55)
    machine, totals = machine_of(FIELD), np.zeros(9)
    place = policy.number[cell_of(policy.edges, features_of(policy.filters, [MIXED_W], 1.0)[0])]
    closed_loop.drive_table(
        *batch_plant(FIELD), machine.cell, machine.fuel_kg, machine.engine_max_w, MIXED_W, place,
        np.arange(900.0, 0.0, -1.0), 0.55, 0.55, policy.price_kg, policy.start_kg, policy.gamma,
        policy.times_s, policy.offset, policy.value_kg, totals, np.zeros((0, 3)),
    )  # fmt: skip
    assert totals[closed_loop.FUEL] == pytest.approx(run.fuel_kg.sum(), rel=1e-4)
    assert totals[closed_loop.SOC_FINAL] == pytest.approx(run.soc_final, abs=1e-4)
    starts = np.sum(run.engine_on & ~np.append(False, run.engine_on[:-1]))
    assert totals[closed_loop.STARTS] == starts >= 1
