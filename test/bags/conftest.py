"""Short runs, their samples, one bag of them, and a ROS graph to record from."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import domain_coordinator
import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.duration import Duration

from tractor_ems.bags.in_process import run_info_of, samples_of, write_samples_bag
from tractor_ems.drive import drive
from tractor_ems.policies.rules import RuleBased
from tractor_ems.scenario import Scenario, make_scenario
from tractor_msgs_py import topics
from tractor_msgs_py.codec import encode
from tractor_msgs_py.ros.messages import CLASSES, RosMessages
from tractor_msgs_py.ros.shell import qos_profile
from tractor_msgs_py.topics import Qos
from tractor_msgs_py.trajectory import Trajectory
from tractor_msgs_py.types import RunInfo, Sample

STEPS = 60
DEADLINE_S = 60.0


@dataclass(frozen=True)
class DrivenRun:
    """A short rule-based run: what was driven and everything that was said."""

    scenario: Scenario
    info: RunInfo
    trajectory: Trajectory
    samples: tuple[Sample, ...]


@pytest.fixture(scope="session")
def driven() -> DrivenRun:
    return drive_part("planter", 100, STEPS)


def drive_part(cycle: str, first: int, steps: int) -> DrivenRun:
    """Drive ``steps`` steps of a shipped cycle; from 100 on there is a headland turn in them."""
    whole = make_scenario("paper", cycle)
    demand_w = whole.cycle.power_demand_w[first : first + steps]
    scenario = replace(whole, cycle=replace(whole.cycle, name="part", power_demand_w=demand_w))
    policy = RuleBased(scenario.params)
    trajectory = drive(
        policy,
        scenario.params,
        scenario.power_demand_w[None, :],
        scenario.soc_initial,
        scenario.soc_target,
    )[0]
    assert np.any(trajectory.engine_on) and not np.all(trajectory.engine_on)
    info = run_info_of(scenario, trajectory, policy.name)
    samples, _ = samples_of(scenario.params, info, trajectory)
    return DrivenRun(scenario, info, trajectory, tuple(samples))


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Writes samples as a new bag and returns its folder."""

    def write_bag(samples: Sequence[Sample], name: str = "bag", namespace: str = "") -> Path:
        write_samples_bag(tmp_path / name, samples, {}, namespace)
        return tmp_path / name

    return write_bag


@pytest.fixture(scope="session")
def bag(driven: DrivenRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of the driven run, shared: tests only read it."""
    path = tmp_path_factory.mktemp("shared") / "bag"
    write_samples_bag(path, driven.samples, {f"policy:{driven.info.run_id}": "rule_based"})
    return path


@pytest.fixture
def wait_for() -> Callable[[Callable[[], Any], str], None]:
    """Polls until something holds, far longer than it should ever take."""

    def wait(condition: Callable[[], Any], what: str) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while not condition():
            assert time.monotonic() < deadline, f"waited {DEADLINE_S} s for {what}"
            time.sleep(0.01)

    return wait


class Graph:
    """Plays plant and policy in a domain of its own: publishes samples as they do.

    The publishers keep more than the contract's, so that the tests need not wait for a slow
    recorder after each message; reliability and durability are the contract's.
    """

    def __init__(self, domain_id: int, namespace: str = "") -> None:
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain_id)
        self._node = rclpy.create_node(
            "rule_based_policy", context=self._context, namespace=namespace
        )
        self._factory = RosMessages()
        self.publishers = {}
        for topic in topics.RECORDED:
            depth = topic.qos.depth if topic is topics.RUN_INFO else 20_000
            qos = Qos(topic.qos.reliability, topic.qos.durability, depth)
            self.publishers[topic.name] = self._node.create_publisher(
                CLASSES[topic.type], topic.name, qos_profile(qos)
            )

    def subscribed(self, count: int = 1) -> bool:
        counts = [p.get_subscription_count() for p in self.publishers.values()]
        return min(counts) >= count

    def publish(self, samples: Sequence[Sample]) -> list[tuple[str, Any]]:
        """Publish, and return topic names and messages."""
        sent = []
        for sample in samples:
            topic, message = encode(sample, self._factory)
            self.publishers[topic.name].publish(message)
            sent.append((topic.name, message))
        return sent

    def delivered(self) -> None:
        for publisher in self.publishers.values():
            assert publisher.wait_for_all_acked(Duration(seconds=DEADLINE_S))

    def close(self) -> None:
        """Leave the domain; a second call does nothing."""
        if not self._context.ok():
            return
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)


@pytest.fixture
def domain_id(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """A ROS domain that no other test on this machine uses, for this process and its children."""
    with domain_coordinator.domain_id() as reserved:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(reserved))
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        monkeypatch.delenv("ROS_LOCALHOST_ONLY", raising=False)
        yield reserved


@pytest.fixture
def make_graph(domain_id: int) -> Iterator[Callable[..., Graph]]:
    graphs = []

    def make(namespace: str = "") -> Graph:
        graphs.append(Graph(domain_id, namespace))
        return graphs[-1]

    yield make
    for graph in graphs:
        graph.close()


@pytest.fixture
def graph(make_graph: Callable[..., Graph]) -> Graph:
    return make_graph()


class Recorder:
    """A bag_recorder process."""

    def __init__(self, folder: Path, arguments: Sequence[str]) -> None:
        command = [sys.executable, "-m", "tractor_ems.nodes.bag_recorder", *arguments]
        self.process = subprocess.Popen(
            command, cwd=folder, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )

    def end(self, number: int | None = None) -> tuple[int, str, str]:
        """Send a signal, if any, and wait: exit code, stdout, stderr."""
        if number is not None:
            self.process.send_signal(number)
        out, error = self.process.communicate(timeout=DEADLINE_S)
        return self.process.returncode, out, error


@pytest.fixture
def start_recorder(tmp_path: Path, domain_id: int) -> Iterator[Callable[..., Recorder]]:
    """Starts recorders in the test's domain, by default into ``tmp_path/rec``."""
    started: list[Recorder] = []

    def start(*parameters: str, output: str | None = "rec", ros: Sequence[str] = ()) -> Recorder:
        words = ["--ros-args", *ros]
        for text in (*parameters, *([f"output:={output}"] if output is not None else [])):
            words += ["-p", text]
        started.append(Recorder(tmp_path, words))
        return started[-1]

    yield start
    left = [recorder for recorder in started if recorder.process.poll() is None]
    for recorder in left:
        recorder.end(signal.SIGKILL)
    assert not left, "a recorder outlived its test"
