"""Never-stop ECMS takes the cheapest power of the moment and never stops a started engine."""

import numpy as np
import pytest
from policies.work import ALL, FIELD, HEAVY, LIGHT, driven

from tractor_ems.policies.ecms import NeverStopEcms
from tractor_ems.policies.genset import power_max_w, running_fuel_kg_per_s
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.trajectory import trajectory_hash
from tractor_sim.battery import discharge_current_a, open_circuit_v
from tractor_sim.config import load_powertrain

POLICY = NeverStopEcms(FIELD)


def test_a_started_engine_never_stops():
    for run in driven(POLICY, ALL):
        on = run.engine_on.astype(int)
        assert on.any()
        assert np.all(np.diff(on) >= 0)
        assert run.shortfall_j.sum() == 0.0


def test_downhill_the_engine_idles_and_the_battery_takes_what_flows_back():
    demand_w = np.concatenate([np.full(60, 160e3), np.full(60, -40e3), np.full(60, 100e3)])
    (run,) = driven(POLICY, demand_w)
    assert run.engine_on.all()
    assert run.engine_power_w[70:120].max() < 10.0
    assert run.dissipated_j.sum() == 0.0


def test_soc_comes_back_towards_its_target_from_either_side():
    soc = np.array([0.48, 0.62])
    runs = driven(POLICY, np.stack([HEAVY, HEAVY]), soc=soc)
    for run, start in zip(runs, soc, strict=True):
        assert abs(run.soc_final - 0.55) < 0.5 * abs(start - 0.55)


def test_the_engine_power_is_the_minimum_of_the_equivalent_fuel():
    """Against a search over another, finer grid, where nothing but the battery limits it."""
    (run,) = driven(POLICY, np.full(40, 140e3))
    k, demand_w = 30, 140e3
    soc = run.soc[k : k + 1]
    engine_w = np.arange(1.0, power_max_w(FIELD), 10.0)
    battery_w = demand_w - engine_w
    price = POLICY.equivalence * (1.0 + POLICY.soc_gain * (0.55 - soc))
    fuel_w = running_fuel_kg_per_s(FIELD, engine_w) * FIELD.engine.fuel_lhv_j_per_kg
    inside_w = open_circuit_v(FIELD.battery, soc) * discharge_current_a(
        FIELD.battery, np.full_like(battery_w, soc[0]), battery_w
    )
    cost_w = fuel_w + price * inside_w
    assert run.engine_power_w[k] == pytest.approx(engine_w[np.argmin(cost_w)], abs=1.1e3)


def test_a_dearer_battery_is_drained_less():
    dear, cheap = (driven(NeverStopEcms(FIELD, equivalence=s), HEAVY[:300])[0] for s in (2.6, 2.2))
    assert dear.soc_final > cheap.soc_final + 0.01


def test_light_work_begins_on_the_battery():
    (run,) = driven(POLICY, LIGHT[:30])
    assert not run.engine_on[:10].any()


def test_a_batch_acts_like_its_members():
    together = driven(POLICY, ALL[:, :120])
    for demand_w, run in zip(ALL, together, strict=True):
        (alone,) = driven(POLICY, demand_w[:120])
        assert trajectory_hash(run) == trajectory_hash(alone)


def test_it_drives_a_lossless_plant_with_an_efficiency_curve():
    paper = load_powertrain("paper")
    (run,) = driven(NeverStopEcms(paper), np.full(60, 150e3), soc=0.8, params=paper)
    assert np.all(np.diff(run.engine_on.astype(int)) >= 0)
    assert run.shortfall_j.sum() == 0.0


@pytest.mark.parametrize(("field", "value"), [("equivalence", 0.0), ("soc_gain", -1.0)])
def test_a_setting_out_of_range_is_refused_by_name(field, value):
    with pytest.raises(PolicyError, match=field):
        NeverStopEcms(FIELD, **{field: value})
