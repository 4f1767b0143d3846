"""The dp node on a plant with engine state: it drives what the in-process policy drives."""

import dataclasses

import numpy as np
import pytest

from tractor_ems.drive import drive
from tractor_ems.policies.dp import solve_policy
from tractor_ems.policies.planned import PlannedPolicy
from tractor_ems.scenario import make_scenario
from tractor_msgs_py.errors import CycleError
from tractor_msgs_py.trajectory import trajectory_hash
from tractor_sim.duty_cycle.cycle_csv import write_cycle_csv
from tractor_sim.duty_cycle.generate import generate

pytest.importorskip("rclpy")


@pytest.fixture
def cycle_file(tmp_path):
    work = generate("loader", 5, duration_s=600)
    path = tmp_path / "loader.csv"
    write_cycle_csv(path, dataclasses.replace(work, power_demand_w=work.power_demand_w[:90]))
    return str(path)


def test_the_node_solves_its_cycle_and_drives_like_the_policy(cycle_file):
    from tractor_ems.nodes import dp_policy

    values = {parameter.name: parameter.default for parameter in dp_policy.PARAMETERS}
    setup = dp_policy.prepare(values | {"powertrain": "field", "cycle": cycle_file})
    assert isinstance(setup.policy, PlannedPolicy)
    scenario = make_scenario("field", cycle_file)
    demand_w = scenario.power_demand_w
    alone = solve_policy(scenario.params, demand_w, 0.55, 0.55)
    node, policy = (
        drive(made, scenario.params, demand_w[None, :], 0.55, 0.55)[0]
        for made in (dataclasses.replace(setup.policy, t0_ns=None), alone)
    )
    assert trajectory_hash(node) == trajectory_hash(policy)
    assert node.soc_final == pytest.approx(0.55, abs=1e-6)
    assert np.all(node.shortfall_j == 0.0)


def test_the_node_refuses_another_cycle(cycle_file):
    from tractor_ems.nodes import dp_policy
    from tractor_sim.plant_run import prepare_run

    values = {parameter.name: parameter.default for parameter in dp_policy.PARAMETERS}
    setup = dp_policy.prepare(values | {"powertrain": "field", "cycle": cycle_file})
    assert setup.check_run is not None
    with pytest.raises(CycleError, match="solved was"):
        setup.check_run(prepare_run("field", "whtc").info)
