"""What the golden bags in ``bags/`` promise beyond the contract; see bags/README.md."""

import shlex
from pathlib import Path

import pytest

from tractor_ems.bags.check import check
from tractor_ems.bags.inspect import info
from tractor_ems.bags.read import find_bags, provenance_of, read_bag
from tractor_ems.bags.transitions import cycle_of_bag, iter_traces

GOLDEN = Path(__file__).resolve().parents[2] / "bags"
RUNS = {"dp_planter": "dp", "rule_based_planter": "rule_based"}
NAMES = (*RUNS, "demand_only")
FOREIGN = "vehicle_planter"
"""A bag of other topics, which its signal map reads: test/signals."""

pytestmark = pytest.mark.usefixtures("golden_only")


def test_golden_bags_are_these_and_below_one_megabyte():
    assert {path.name for path in find_bags([GOLDEN])} == {*NAMES, FOREIGN}
    files = [path for path in GOLDEN.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 1_000_000


@pytest.mark.parametrize("name", (*NAMES, FOREIGN))
def test_readme_says_how_a_golden_bag_was_made(name):
    text = (GOLDEN / "README.md").read_text(encoding="utf-8")
    assert name in text


@pytest.mark.parametrize("name", RUNS)
def test_recorded_run_passes_every_check_that_applies_to_a_simulated_run(name):
    report = check(GOLDEN / name)
    assert {c.name: c.outcome for c in report.checks} == dict.fromkeys(
        [c.name for c in report.checks], "pass"
    )


@pytest.mark.parametrize(("name", "policy"), RUNS.items())
def test_recorded_run_was_driven_by_the_node_it_is_named_after(name, policy):
    (run,) = info(GOLDEN / name)["runs"]
    assert (run["policy"], run["cycle"], run["lockstep"]) == (policy, "planter", True)
    assert provenance_of(GOLDEN / name)["recorder"] == "bag_recorder"
    assert provenance_of(GOLDEN / name)["recovered"] == "false"


@pytest.mark.parametrize("name", NAMES)
def test_golden_bag_names_no_path_of_the_machine_that_made_it(name):
    document = info(GOLDEN / name)
    commands = [v for k, v in document["provenance"].items() if k.endswith("command_line")]
    commands += [run.info.command_line for run in read_bag(GOLDEN / name) if run.info is not None]
    paths = [word for text in commands for word in shlex.split(text) if word.startswith("/")]
    assert paths == []


def test_demand_only_bag_is_one_stretch_of_demand_to_learn_from():
    (trace,) = iter_traces([GOLDEN / "demand_only"])
    assert trace.demand_only and trace.dt_s == 1.0
    assert trace.run_id == "" and trace.powertrain_hash == ""
    assert len(cycle_of_bag(GOLDEN / "demand_only")) == len(trace) >= 300
