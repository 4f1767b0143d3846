"""The executables as a user starts them: by hand, killed, doubled, signalled."""

import signal
import subprocess
import sys

import pytest

from tractor_ems.drive import drive
from tractor_ems.policies.q_policy import load_policy
from tractor_ems.policies.rules import RuleBased
from tractor_msgs_py import topics
from tractor_msgs_py.trajectory import trajectory_hash
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import load_cycle
from tractor_sim.resources import resource_path

NODES = ("plant_sim", "rule_based_policy", "dp_policy", "ddqn_policy")
LONG = 50_000


def default_policy(executable: str):
    """What the executable decides with when it is started without parameters."""
    if executable == "ddqn_policy":
        return load_policy(resource_path("data", "policy", "paper.safetensors"))
    return RuleBased(load_powertrain("paper"))


@pytest.fixture
def observer(graph):
    """A node that hears how far the plant is."""
    return graph.peer(topics.BATTERY)


def planter_hash(policy) -> str:
    params, cycle = load_powertrain("paper"), load_cycle("planter")
    (trajectory,) = drive(policy, params, cycle.power_demand_w[None], 0.85, 0.85)
    return trajectory_hash(trajectory)


@pytest.mark.slow
@pytest.mark.parametrize("executable", ["rule_based_policy", "ddqn_policy"])
def test_plant_and_policy_started_by_hand_in_either_order_drive_the_planter(start, executable):
    expected = planter_hash(default_policy(executable))[:16]
    node = start(executable)
    first = start("plant_sim")
    assert first.end() == 0, first.output
    assert f"hash {expected}" in first.output
    assert node.end(signal.SIGTERM) == 0
    assert "Traceback" not in node.output
    second = start("plant_sim")
    node = start(executable)
    assert second.end() == 0, second.output
    assert f"hash {expected}" in second.output
    assert node.end(signal.SIGINT) == 0
    assert "Traceback" not in node.output


def test_a_policy_killed_mid_run_ends_the_run_with_a_named_reason(
    start, make_cycle, graph, observer, tmp_path
):
    cycle = make_cycle([150e3] * LONG, "long")
    policy = start("rule_based_policy")
    plant = start("plant_sim", cycle=cycle, answer_timeout_s=1.0, output=tmp_path / "run")
    graph.spin_until(lambda: len(observer.heard[topics.BATTERY.name]) > 20, "some ticks")
    policy.end(signal.SIGKILL)
    assert plant.end() == 3
    (line,) = [text for text in plant.output.splitlines() if text.startswith("plant_sim: ")]
    assert "no answer to tick" in line and "the policy died or hangs" in line
    assert "Traceback" not in plant.output
    assert not any((tmp_path / "run").iterdir())


@pytest.mark.slow
def test_a_second_policy_ends_the_run_and_both_policies_say_so(start, make_cycle, wait_for):
    policies = [start("rule_based_policy"), start("rule_based_policy", policy="conventional")]
    for policy in policies:
        wait_for(lambda p=policy: "2 publishers on" in p.output, "the policy to notice")
    plant = start("plant_sim", cycle=make_cycle([150e3] * LONG, "long"))
    assert plant.end() == 3
    assert "plant_sim: 2 publishers on battery_power_command, allowed 1" in plant.output
    for policy in policies:
        assert policy.end(signal.SIGTERM) == 0


def test_a_plant_ends_mid_run_on_a_signal_without_a_result(
    start, make_cycle, graph, observer, tmp_path
):
    policy = start("rule_based_policy")
    plant = start("plant_sim", cycle=make_cycle([150e3] * LONG), output=tmp_path / "run")
    graph.spin_until(lambda: len(observer.heard[topics.BATTERY.name]) > 20, "some ticks")
    assert plant.end(signal.SIGINT) == 0
    assert "Traceback" not in plant.output
    assert not any((tmp_path / "run").iterdir())
    assert policy.end(signal.SIGTERM) == 0


def end_every_node(number, start, graph, policy_file) -> None:
    """Start every node, each in a namespace of its own, and end all once they are in the graph."""
    observer = graph.peer(name="observer").node
    started = [
        start(name, f"/{name}", **({"policy_file": policy_file} if name == "ddqn_policy" else {}))
        for name in NODES
    ]
    graph.spin_until(lambda: set(NODES) <= set(observer.get_node_names()), "all nodes")
    for process in started:
        process.process.send_signal(number)
    for process in started:
        assert process.end() == 0, process.output
        assert "Traceback" not in process.output
    graph.remove(observer)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_every_node_ends_with_code_0_on_a_signal(start, graph, untrained, number):
    policy_file, _ = untrained()
    end_every_node(number, start, graph, policy_file)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_every_node_ends_with_code_0_on_twenty_signals(start, graph, untrained, number):
    policy_file, _ = untrained()
    for _ in range(20):
        end_every_node(number, start, graph, policy_file)


FORBIDDEN = {"torch", "yaml", "numba", "pydantic", "rosbags", "mcap", "matplotlib", "typer"}
FORBIDDEN |= {"rich", "tractor_sim.config"}
# rclpy imports yaml itself: what counts is what comes on top of it.
IMPORTED = """
import sys
import rclpy
before = set(sys.modules)
import tractor_ems.nodes.ddqn_policy as node
node.prepare({"policy_file": sys.argv[1]})
print(*(set(sys.modules) - before))
"""


def test_ddqn_policy_needs_rclpy_messages_numpy_and_safetensors_only(untrained):
    policy_file, _ = untrained()
    done = subprocess.run(
        [sys.executable, "-c", IMPORTED, policy_file], text=True, capture_output=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    imported = set(done.stdout.split())
    assert {"tractor_ems.policies.q_policy", "safetensors"} <= imported
    assert not imported & FORBIDDEN
