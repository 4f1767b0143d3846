"""Which recordings may teach: none of a held-out cycle, and no replay of what does not fit."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tractor_ems.bags.in_process import record_in_process, write_demand_bag
from tractor_ems.learning.config import TrainConfig, load_train_config
from tractor_ems.learning.recorded import drive_of_trace
from tractor_ems.learning.recordings import read_recordings
from tractor_ems.learning.train import train
from tractor_ems.policies.rules import RuleBased
from tractor_ems.scenario import make_scenario
from tractor_msgs_py.errors import BagError, ConfigError
from tractor_sim.duty_cycle.library import load_cycle
from tractor_sim.duty_cycle.shipped import held_out_name

HELD_OUT = "rotary_hoe_2001"


def test_bags_of_held_out_cycles_are_refused_unless_allowed(paper, tmp_path: Path):
    bag, out = tmp_path / "bag", tmp_path / "p.safetensors"
    record_in_process(RuleBased(paper), make_scenario("paper", HELD_OUT, 0.85, 0.836), bag)
    with pytest.raises(BagError, match=f"bag: drives {HELD_OUT}, a held-out"):
        train(TrainConfig(), [bag], [], out)
    with pytest.raises(BagError, match=f"{HELD_OUT}, a held-out cycle"):
        train(TrainConfig(), [], [bag], out)
    allowed = load_train_config(None, {"allow_held_out": True, "updates": 1})
    assert train(allowed, [bag], [], out).policy == str(out)


def test_a_bare_recording_of_a_held_out_demand_is_known_by_content(paper, tmp_path: Path):
    demand_w = load_cycle(HELD_OUT).power_demand_w + 4e3  # with a vehicle's auxiliaries in it
    stamp_ns = 10**9 * np.arange(1, len(demand_w) + 1)
    write_demand_bag(tmp_path / "bag", stamp_ns, demand_w, "/tractor1")
    with pytest.raises(BagError, match=f"drives {HELD_OUT}, a held-out"):
        read_recordings([tmp_path / "bag"], [], paper)
    assert read_recordings([tmp_path / "bag"], [], paper, allow_held_out=True).dp


def test_other_seeds_of_a_held_out_operation_are_known_by_name(make_traces):
    trace = make_traces([25], steps=50)[0]
    known = held_out_name(trace.power_demand_w, trace.dt_s, trace.cycle_hash, "rotary_hoe_77")
    assert known == "rotary_hoe_77"
    assert held_out_name(trace.power_demand_w, trace.dt_s, trace.cycle_hash, "planter_25") is None


def test_replay_takes_no_step_of_another_powertrain():
    with pytest.raises(ConfigError, match=r"sampled.yaml: .*allow_other_powertrain"):
        load_train_config("sampled", {"allow_other_powertrain": True})


def test_replay_takes_no_trace_that_begins_within_its_run(make_traces):
    trace = make_traces([25], steps=50)[0]
    assert drive_of_trace(trace) is not None
    assert drive_of_trace(replace(trace, from_start=False)) is None
