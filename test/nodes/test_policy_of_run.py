"""A learned policy without a file waits for a run, then is that powertrain's shipped one."""

import json
import signal
from dataclasses import replace

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from nodes.scripted import TENTH, ScriptedPlant, write_cycle

from tractor_ems.answer import Answerer
from tractor_ems.nodes import ddqn_policy
from tractor_ems.nodes.policy_node import PolicyNode
from tractor_ems.nodes.policy_of_run import PolicyOfRun
from tractor_ems.policies.envelope import envelope_of
from tractor_ems.policies.q_policy import save_policy
from tractor_msgs_py import topics
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.types import CommandMode, Reason
from tractor_sim.config import load_powertrain

VALUES = {
    **{parameter.name: parameter.default for parameter in ddqn_policy.PARAMETERS},
    "signals": "",
    "report": "",
}


@pytest.fixture
def waiting(graph):
    """The node on the graph, and what it built its policy of."""
    asked = []

    def build(node, values):
        asked.append(values)
        setup = ddqn_policy.prepare(values)
        return PolicyNode(node, Answerer(setup.policy, setup.powertrain_hash), 10)

    return PolicyOfRun(graph.node("ddqn_policy"), VALUES, build), asked


def test_it_waits_then_drives_the_run_that_comes(graph, waiting, make_cycle):
    logic, asked = waiting
    peer = graph.peer(topics.DIAGNOSTICS)
    heard = peer.heard[topics.DIAGNOSTICS.name]
    graph.spin_until(lambda: heard, "diagnostics")
    assert heard[0].status[0].message == "waiting for a run"
    logic.on_parameters({"planned_work_s": 9.0})
    assert logic.finished() is None and not asked
    plant = graph.plant(cycle=make_cycle([60e3, 150e3, 90e3]))

    def chosen():
        assert logic.finished() is None
        return asked

    graph.spin_until(chosen, "a run")
    assert asked == [{**VALUES, "powertrain": "paper", "planned_work_s": 9.0}]
    trajectory, _ = graph.drive(plant)
    assert len(trajectory) == 3
    logic.on_parameters({"planned_work_s": 5.0})
    assert logic._chosen._answers.decider.plan.work_s == 5.0


def test_a_run_of_a_powertrain_without_a_shipped_policy_is_refused_by_name(
    graph, waiting, make_cycle
):
    logic, _ = waiting
    graph.plant(cycle=make_cycle([60e3, 60e3]), powertrain="wheel_loader")
    graph.spin_until(lambda: logic._powertrain, "the run")
    with pytest.raises(PolicyError, match="none ships for powertrain 'wheel_loader'"):
        logic.finished()


def test_a_wait_in_vain_leaves_a_report_of_its_own(graph, tmp_path):
    report = tmp_path / "report.json"
    report.write_text('{"ended": true, "policy": "of yesterday"}')
    logic = PolicyOfRun(graph.node("ddqn_policy"), {**VALUES, "report": str(report)}, None)
    assert json.loads(report.read_text()) == {"ended": False, "policy": ""}
    logic.shutdown()
    assert json.loads(report.read_text())["ended"]


@pytest.mark.slow
def test_outside_its_envelope_a_real_node_leaves_the_drive_to_the_fallback_law_and_comes_back(
    start, graph, untrained, tmp_path
):
    _, policy = untrained()
    spec = replace(policy.spec, dt_s=0.1)
    known = envelope_of(replace(spec, filters=()), [[0.0, 1e5]], 0.1)
    made = replace(policy, params=load_powertrain(TENTH), spec=spec, metadata={"envelope": known})
    file = tmp_path / "with_envelope.safetensors"
    save_policy(file, made)
    cycle = write_cycle(tmp_path / "work.csv", [6e4] * 40 + [2e5] * 40 + [6e4] * 20_000, 0.1)
    plant = ScriptedPlant(graph.peer(topics.COMMAND, topics.DIAGNOSTICS), cycle)
    node = start(
        "ddqn_policy",
        policy_file=file,
        outside_envelope="fallback",
        outside_envelope_s=1.0,
        planned_work_s=3600.0,
    )
    plant.begin()
    plant.drive_until_nominal(graph.spin_to)

    def away():
        plant.drive(graph.spin_to, 1)
        return plant.commands and plant.commands[-1][1].reason is Reason.OUTSIDE_ENVELOPE

    graph.spin_until(away, "the fallback law")
    assert plant.commands[-1][1].mode is CommandMode.FALLBACK
    plant.drive_until_nominal(graph.spin_to)
    heard = plant.peer.heard[topics.DIAGNOSTICS.name]
    status = [s for array in heard for s in array.status if s.name == "/ddqn_policy"]
    values = [{item.key: item.value for item in s.values} for s in status]
    told = [v["outside_envelope"] for v in values if "outside_envelope" in v]
    assert told[0].startswith("power_demand_w: 200000, training saw 0..100000")
    assert any(s.level == DiagnosticStatus.WARN for s in status)
    assert 0.0 < float(values[-1]["time_left_s"]) < 3600.0
    assert plant.unsafe == 0
    assert node.end(signal.SIGTERM) == 0
    assert "Traceback" not in node.output
    assert "outside" in node.output and "inside" in node.output
