"""Which recordings may teach: none of a held-out cycle, and no replay of what does not fit."""

from dataclasses import replace
from pathlib import Path

import pytest

from tractor_ems.bags.in_process import record_in_process
from tractor_ems.learning.config import TrainConfig, load_train_config
from tractor_ems.learning.recorded import drive_of_trace
from tractor_ems.learning.train import train
from tractor_ems.policies.rules import RuleBased
from tractor_ems.scenario import make_scenario
from tractor_msgs_py.errors import BagError, ConfigError


def test_bags_of_held_out_cycles_are_refused_unless_allowed(paper, tmp_path: Path):
    bag, out = tmp_path / "bag", tmp_path / "p.safetensors"
    record_in_process(RuleBased(paper), make_scenario("paper", "planter_1001", 0.85, 0.836), bag)
    with pytest.raises(BagError, match="bag: drives planter_1001, a held-out"):
        train(TrainConfig(), [bag], [], out)
    with pytest.raises(BagError, match="planter_1001, a held-out cycle"):
        train(TrainConfig(), [], [bag], out)
    allowed = load_train_config(None, {"allow_held_out": True, "updates": 1})
    assert train(allowed, [bag], [], out).policy == str(out)


def test_replay_takes_no_step_of_another_powertrain():
    with pytest.raises(ConfigError, match=r"sampled.yaml: .*allow_other_powertrain"):
        load_train_config("sampled", {"allow_other_powertrain": True})


def test_replay_takes_no_trace_that_begins_within_its_run(make_traces):
    trace = make_traces([25], steps=50)[0]
    assert drive_of_trace(trace) is not None
    assert drive_of_trace(replace(trace, from_start=False)) is None
