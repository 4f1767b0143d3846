"""Traces and transitions: applied power, features as live, demand alone, cuts at gaps."""

import dataclasses

import numpy as np
import pytest

from tractor_ems.bags.in_process import write_demand_bag
from tractor_ems.bags.read import bag_hash, read_bag
from tractor_ems.bags.runs import observations_of
from tractor_ems.bags.transitions import (
    cycle_of_bag,
    features_of,
    iter_traces,
    transitions_of,
)
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.observation import DemandFilter, ObservationSpec
from tractor_msgs_py.types import BatteryPowerCommand, PowertrainReading
from tractor_sim.duty_cycle.cycle import cycle_hash

SECOND_NS = 1_000_000_000
SPEC = ObservationSpec(
    filters=(DemandFilter("low_pass", 8.0), DemandFilter("running_mean", 60.0, 140e3))
)


def test_trace_holds_the_driven_run(bag, driven):
    (trace,) = iter_traces([bag])
    wrote = driven.trajectory
    np.testing.assert_array_equal(trace.power_demand_w, wrote.power_demand_w)
    np.testing.assert_array_equal(trace.battery_power_w, wrote.battery_power_w)
    np.testing.assert_array_equal(trace.engine_power_w, wrote.engine_power_w)
    np.testing.assert_array_equal(trace.fuel_kg, wrote.fuel_kg)
    np.testing.assert_array_equal(trace.engine_on[1:], wrote.engine_on)
    np.testing.assert_array_equal(trace.soc[:-1], wrote.soc_observed)
    assert trace.soc[-1] == np.float32(wrote.soc_final)
    assert len(trace.soc) == len(trace.time_in_state_s) == len(trace) + 1
    assert (trace.from_start, trace.to_end, trace.policy) == (True, True, "rule_based")
    assert trace.cycle_hash == driven.info.cycle_hash and trace.bag_hash == bag_hash(bag)


def test_transitions_use_applied_power_and_not_the_commanded_one(driven, write):
    absurd = [
        dataclasses.replace(s, battery_power_w=9e9) if isinstance(s, BatteryPowerCommand) else s
        for s in driven.samples
    ]
    found = transitions_of(iter_traces([write(absurd)]))
    np.testing.assert_array_equal(found.battery_power_w, driven.trajectory.battery_power_w[:-1])


def test_transition_chains_to_the_next_and_ends_truncated(bag, driven):
    found = transitions_of(iter_traces([bag]))
    assert len(found) == len(driven.trajectory) - 1
    np.testing.assert_array_equal(found.next_soc[:-1], found.soc[1:])
    np.testing.assert_array_equal(found.next_engine_on[:-1], found.engine_on[1:])
    np.testing.assert_array_equal(found.next_power_demand_w[:-1], found.power_demand_w[1:])
    assert found.truncated.tolist() == [False] * (len(found) - 1) + [True]


def test_features_equal_those_of_the_live_builder(bag):
    live, _ = observations_of(read_bag(bag)[0], SPEC)
    np.testing.assert_array_equal(
        features_of(iter_traces([bag])[0], SPEC), np.concatenate([o.features for o in live])
    )


def test_missing_state_cuts_a_run_into_two_traces(driven, write):
    lost = driven.info.stamp_ns(10)
    kept = [
        s for s in driven.samples if not (isinstance(s, PowertrainReading) and s.stamp_ns == lost)
    ]
    before, after = iter_traces([write(kept)])
    # The state at t_10 ends step 9 and begins step 10: neither can be learnt from.
    assert (len(before), len(after)) == (9, len(driven.trajectory) - 11)
    assert (before.from_start, before.to_end) == (True, False)
    assert (after.from_start, after.to_end) == (False, True)
    assert after.stamp_ns[0] == driven.info.stamp_ns(11)


def test_demand_alone_gives_a_demand_only_trace(tmp_path):
    demand_w = np.linspace(40e3, 200e3, 30)
    stamps = SECOND_NS * (1_750_000_000 + np.arange(30))
    stamps[::10] += 4_000_000
    write_demand_bag(tmp_path / "bag", stamps, demand_w, "/tractor7")
    (trace,) = iter_traces([tmp_path / "bag"])
    assert trace.demand_only and trace.soc is None and trace.fuel_kg is None
    assert trace.dt_s == 1.0 and trace.irregular == 0
    np.testing.assert_array_equal(trace.stamp_ns, stamps)
    np.testing.assert_array_equal(trace.power_demand_w, demand_w)
    assert len(transitions_of([trace])) == 0
    cycle = cycle_of_bag(tmp_path / "bag")
    assert cycle.dt_s == 1.0
    np.testing.assert_array_equal(cycle.power_demand_w, demand_w)


def test_missing_demand_cuts_and_jitter_is_counted(tmp_path):
    ticks = np.array([*range(10), *range(13, 20)])
    stamps = SECOND_NS * (1000 + ticks)
    stamps[3] += 30_000_000
    write_demand_bag(tmp_path / "bag", stamps, np.full(17, 1e5))
    one, two = iter_traces([tmp_path / "bag"])
    assert (len(one), len(two)) == (10, 7)
    assert (one.irregular, two.irregular) == (2, 0)
    with pytest.raises(BagError, match="2 stretches"):
        cycle_of_bag(tmp_path / "bag")


def test_cycle_of_a_recorded_run_is_the_cycle_that_was_driven(bag, driven):
    assert cycle_hash(cycle_of_bag(bag)) == driven.info.cycle_hash
