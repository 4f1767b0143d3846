"""Joining by stamp: no sample of another tick, no repeat, no NaN ever reaches a policy."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import (
    MAX_PENDING,
    DemandFilter,
    ObservationBuilder,
    ObservationSpec,
    filter_trace,
)
from tractor_msgs_py.types import BatteryReading, PowerDemand, PowertrainReading, RunInfo

RUN = RunInfo("r", "c", "h", "p", "h", 10**12, 1.0, 20, 0.0, 0.8, 0.8)
FILTERS = (DemandFilter("low_pass", 8.0), DemandFilter("running_mean", 60.0, 140e3))


def tick(k, demand_w=100e3, run=RUN):
    stamp = run.stamp_ns(k)
    return [
        PowerDemand(stamp, demand_w),
        BatteryReading(stamp, 0.8, 650.0, 0.0),
        PowertrainReading(stamp, False, 1.0, 0.0, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    ]


def builder(spec=None):
    made = ObservationBuilder(spec or ObservationSpec(filters=FILTERS))
    made.start_run(RUN)
    return made


@given(order=st.permutations(range(6)), demands_w=st.tuples(st.floats(0, 3e5), st.floats(0, 3e5)))
def test_only_samples_of_equal_stamp_are_joined_in_any_order(order, demands_w):
    samples = tick(0, demands_w[0]) + tick(1, demands_w[1])
    made = builder()
    seen = [o for o in (made.add(samples[i]) for i in order) if o is not None]
    for observation in seen:
        k = (observation.stamp_ns - RUN.t0_ns) // RUN.dt_ns
        assert observation.power_demand_w[0] == demands_w[k]
    assert [o.stamp_ns for o in seen] == sorted({o.stamp_ns for o in seen})


def test_a_repeated_tick_is_refused_and_counted():
    made = builder()
    assert [made.add(s) for s in tick(0)][-1] is not None
    assert all(made.add(s) is None for s in tick(0))
    assert made.refusals["repeated_or_old_stamp"] == 3


@pytest.mark.parametrize(
    ("position", "change", "reason"),
    [
        (0, {"power_w": math.nan}, "not_finite"),
        (0, {"power_w": math.inf}, "not_finite"),
        (1, {"soc": math.nan}, "soc_out_of_range"),
        (1, {"soc": 83.6}, "soc_out_of_range"),
        (2, {"engine_limit_w": math.nan}, "not_finite"),
        (0, {"stamp_ns": 0}, "zero_stamp"),
        (0, {"stamp_ns": 10**12 + 5}, "stamp_off_grid"),
        (0, {"stamp_ns": 10**15}, "stamp_outside_run"),
    ],
)
def test_a_bad_sample_is_refused_by_reason_and_the_good_one_still_counts(position, change, reason):
    made, samples = builder(), tick(0)
    assert made.add(dataclasses.replace(samples[position], **change)) is None
    assert made.refusals[reason] == 1
    assert [made.add(s) for s in samples][-1] is not None


def test_nothing_is_observed_before_a_run_is_announced():
    made = ObservationBuilder(ObservationSpec())
    assert all(made.add(s) is None for s in tick(0))
    assert made.refusals["no_run_info"] == 3


def test_a_new_run_forgets_filters_and_stamps_but_a_repeated_run_info_does_not():
    made = builder()
    first = [made.add(s) for s in tick(0, 50e3)][-1]
    made.start_run(RUN)
    assert all(made.add(s) is None for s in tick(0, 50e3))
    made.start_run(dataclasses.replace(RUN, run_id="other"))
    again = [made.add(s) for s in tick(0, 50e3)][-1]
    np.testing.assert_array_equal(first.features, again.features)


def test_a_missing_tick_is_counted_as_a_gap():
    made = builder()
    for k in (0, 1, 3):
        for sample in tick(k):
            made.add(sample)
    assert made.refusals["gap"] == 1


def test_live_features_equal_those_of_the_whole_trace():
    demand_w = np.random.default_rng(1).uniform(0, 3e5, 20)
    made = builder()
    live = [[made.add(s) for s in tick(k, demand_w[k])][-1].features[0] for k in range(20)]
    np.testing.assert_array_equal(live, filter_trace(made.spec, demand_w, 1.0))


def test_filters_do_what_their_names_say():
    spec = ObservationSpec(filters=FILTERS)
    features = filter_trace(spec, np.full(2000, 90e3), 1.0)
    assert np.all(features[:, 0] == 90e3)
    expected = (60 * 140e3 + 90e3 * np.arange(1, 2001)) / (60 + np.arange(1, 2001))
    np.testing.assert_allclose(features[:, 1], expected)


def test_a_policy_made_for_another_step_length_refuses_the_run():
    made = ObservationBuilder(ObservationSpec(dt_s=0.5))
    with pytest.raises(PolicyError, match=r"0\.5"):
        made.start_run(RUN)


def test_a_spec_survives_json_and_refuses_what_cannot_be_supplied():
    spec = ObservationSpec(dt_s=1.0, filters=FILTERS)
    assert ObservationSpec.from_json(spec.to_json()) == spec
    for change in ({"signals": ["wheel_slip"]}, {"mode": "sampled"}, {"filters": [{"kind": "x"}]}):
        with pytest.raises(PolicyError):
            ObservationSpec.from_json({**spec.to_json(), **change})


REAL_TIME = dataclasses.replace(RUN, run_id="rt", lockstep=False, steps=10_000)


def test_samples_that_never_find_their_partners_do_not_pile_up():
    made = ObservationBuilder(ObservationSpec())
    made.start_run(REAL_TIME)
    for k in range(1000):
        assert made.add(PowerDemand(REAL_TIME.stamp_ns(0) + k, 1e5)) is None
    assert made.refusals["unjoined"] == 1000 - MAX_PENDING
    newest = tick(0, run=dataclasses.replace(REAL_TIME, t0_ns=REAL_TIME.t0_ns + 999))
    assert [made.add(s) for s in newest[1:]][-1] is not None


@pytest.mark.parametrize("k", [-1, 10_001])
def test_a_real_time_run_has_a_first_and_a_last_stamp_too(k):
    made = ObservationBuilder(ObservationSpec())
    made.start_run(REAL_TIME)
    assert all(made.add(s) is None for s in tick(k, run=REAL_TIME))
    assert made.refusals == {"stamp_outside_run": 3}
    assert [made.add(s) for s in tick(10_000, run=REAL_TIME)][-1] is not None


def test_a_demand_of_no_tractor_is_refused():
    made = builder()
    assert all(made.add(s) is None for s in tick(0, demand_w=-1.1e9))
    assert made.refusals == {"demand_out_of_range": 1}
