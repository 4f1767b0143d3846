"""What a policy has seen in training: measured from traces, found again in observations."""

import json
import math

import numpy as np
import pytest

from tractor_ems.policies.envelope import MARGIN, envelope_of, outside, stored_envelope
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import (
    DemandFilter,
    Observation,
    ObservationSpec,
    filter_trace,
)

SPEC = ObservationSpec(
    dt_s=1.0, filters=(DemandFilter("low_pass", 5.0), DemandFilter("running_mean", 60.0, 8e4))
)
TRACES = [np.array([1e4, 2e5, -3e3, 4e4]), np.array([9e4, 5e4])]
ENVELOPE = envelope_of(SPEC, TRACES, 1.0, soc=(0.3, 0.8))


def seen(demand_w=5e4, soc=0.5, features=(5e4, 8e4)):
    """An observation of batch one."""
    one = np.ones(1)
    return Observation(
        stamp_ns=1,
        power_demand_w=demand_w * one,
        soc=soc * one,
        soc_target=0.5 * one,
        engine_on=np.array([False]),
        time_in_state_s=one,
        engine_power_w=0 * one,
        charge_limit_w=one,
        discharge_limit_w=one,
        engine_limit_w=one,
        features=np.array([features]),
    )


def test_it_holds_the_least_and_most_of_demand_and_of_every_filter_over_all_runs():
    features = np.vstack([filter_trace(SPEC, trace, 1.0) for trace in TRACES])
    assert ENVELOPE["power_demand_w"] == [-3e3, 2e5]
    for column in range(2):
        low, high = features[:, column].min(), features[:, column].max()
        assert ENVELOPE[f"feature{column}"] == [low, high]
    assert ENVELOPE["soc"] == [0.3, 0.8]
    assert "soc" not in envelope_of(SPEC, TRACES, 1.0)


def test_it_survives_a_policy_file_and_an_older_file_has_none():
    stored = stored_envelope(json.loads(json.dumps({"envelope": ENVELOPE})))
    assert stored == {name: tuple(pair) for name, pair in ENVELOPE.items()}
    assert stored_envelope({"kind": "ddqn_counterfactual"}) is None


@pytest.mark.parametrize(
    "damaged",
    [[1, 2], {"soc": 1.0}, {"soc": [1.0]}, {"soc": ["a", "b"]}, {"soc": [0.5, 0.4]},
     {"soc": [0.5, math.inf]}],
)  # fmt: skip
def test_a_damaged_envelope_is_refused(damaged):
    with pytest.raises(PolicyError, match="envelope"):
        stored_envelope({"envelope": damaged})


@pytest.mark.parametrize(
    ("what", "signal"),
    [
        ({"demand_w": 3e5}, "power_demand_w"),
        ({"demand_w": -2e4}, "power_demand_w"),
        ({"demand_w": math.nan}, "power_demand_w"),
        ({"features": (5e4, 5e5)}, "feature1"),
        ({"soc": 0.9}, "soc"),
    ],
)
def test_what_lies_outside_is_named_with_value_and_range(what, signal):
    (text,) = outside(ENVELOPE, seen(**what))
    least, most = ENVELOPE[signal]
    assert text.split(":")[0] == signal
    assert text.endswith(f"training saw {least:.6g}..{most:.6g}")


def test_what_was_seen_lies_inside_and_so_does_a_hair_beyond():
    for trace in TRACES:
        for demand_w, features in zip(trace, filter_trace(SPEC, trace, 1.0), strict=True):
            assert outside(ENVELOPE, seen(demand_w, features=features)) == ()
    beyond_w = 2e5 + 0.9 * MARGIN * (2e5 + 3e3)
    assert outside(ENVELOPE, seen(beyond_w)) == ()


def test_several_signals_are_named_each_once():
    texts = outside(ENVELOPE, seen(3e5, soc=0.1))
    assert [text.split(":")[0] for text in texts] == ["power_demand_w", "soc"]


@pytest.mark.parametrize("traces", [[], [np.array([])], [np.array([1.0, math.nan])]])
def test_traces_that_say_nothing_are_refused(traces):
    with pytest.raises(PolicyError, match="demand traces"):
        envelope_of(SPEC, traces, 1.0)
