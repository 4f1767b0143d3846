"""What every bag must hold: the golden ones, or your own (``pytest test/bag --bag PATH``).

A check that a bag gives no data for (a recording of demand alone has no SOC) is skipped with its
reason, so the closing line says what was not looked at.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from tractor_ems.bags.check import CHECKS, CheckReport
from tractor_ems.bags.inspect import info
from tractor_ems.bags.read import read_bag
from tractor_ems.bags.runs import observations_of
from tractor_ems.bags.transitions import features_of, iter_traces
from tractor_msgs_py.observation import DemandFilter, ObservationSpec

SPEC = ObservationSpec(
    filters=(DemandFilter("low_pass", 8.0), DemandFilter("running_mean", 60.0, 140e3))
)


@pytest.mark.parametrize("name", CHECKS)
def test_bag_passes(name: str, report: CheckReport) -> None:
    found = next(check for check in report.checks if check.name == name)
    if found.outcome == "not_applicable":
        pytest.skip(f"{name}: {found.detail}")
    assert found.outcome == "pass", f"{report.bag}: {name}: {found.detail}"


def test_verdict_is_pass(report: CheckReport) -> None:
    assert report.verdict == "pass"


def test_info_is_json_without_nan(bag: Path) -> None:
    document = json.loads(json.dumps(info(bag), allow_nan=False))
    assert document["runs"]


def test_learner_gets_the_features_a_live_policy_saw(bag: Path) -> None:
    traces = [trace for trace in iter_traces([bag]) if not trace.demand_only]
    if not traces:
        pytest.skip("demand only")
    live = [o for run in read_bag(bag) for o in observations_of(run, SPEC)[0]]
    seen = np.concatenate([observation.features for observation in live])
    steps = sum(len(trace) for trace in traces)
    learned = np.concatenate([features_of(trace, SPEC) for trace in traces])
    assert len(seen) >= steps
    np.testing.assert_array_equal(learned, seen[:steps])
