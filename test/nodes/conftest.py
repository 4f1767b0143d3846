"""Nodes in one process on a graph of their own, and nodes as processes."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import domain_coordinator
import numpy as np
import pytest
from rclpy import init, shutdown
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from tractor_ems.answer import Answerer
from tractor_ems.learning.rewards import RewardConfig
from tractor_ems.nodes.policy_node import PolicyNode
from tractor_ems.policies.mlp import Mlp
from tractor_ems.policies.q_policy import Normalisation, QPolicy, save_policy
from tractor_msgs_py import topics
from tractor_msgs_py.codec import DECODERS, encode
from tractor_msgs_py.observation import DemandFilter, ObservationSpec
from tractor_msgs_py.ros.messages import RosMessages
from tractor_msgs_py.ros.wire import publish_on, subscribe_to
from tractor_msgs_py.trajectory import Trajectory
from tractor_msgs_py.types import Sample
from tractor_sim.config import load_powertrain
from tractor_sim.nodes.plant_parameters import PARAMETERS
from tractor_sim.nodes.plant_sim import PlantSim
from tractor_sim.run_files import read_run

DEADLINE_S = 60.0
BIN = Path(sys.executable).parent


@pytest.fixture
def domain_id(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[int]:
    """A ROS domain that no other test on this machine uses, for this process and its children."""
    with domain_coordinator.domain_id() as reserved:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(reserved))
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "ros_log"))
        monkeypatch.delenv("ROS_LOCALHOST_ONLY", raising=False)
        yield reserved


@pytest.fixture
def make_cycle(tmp_path: Path) -> Callable[..., str]:
    """Writes a cycle of demands as a CSV file and returns its path."""

    def make(power_demand_w: Sequence[float], name: str = "short") -> str:
        path = tmp_path / f"{name}.csv"
        rows = "".join(f"{k},{float(power)!r}\n" for k, power in enumerate(power_demand_w))
        path.write_text("time_s,power_demand_w\n" + rows)
        return str(path)

    return make


@pytest.fixture
def untrained(tmp_path: Path) -> Callable[..., tuple[str, QPolicy]]:
    """A policy file of a learned kind whose weights nobody trained, and the policy in it."""

    def make(kind: str = "ddqn_sampled") -> tuple[str, QPolicy]:
        rng = np.random.default_rng(3)
        inputs, outputs = (4, 1600) if kind == "ddqn_sampled" else (3, 2)
        shapes = [(16, inputs), (outputs, 16)]
        policy = QPolicy(
            name=kind,  # type: ignore[arg-type]
            spec=ObservationSpec(dt_s=1.0, filters=(DemandFilter("low_pass", 5.0),)),
            params=load_powertrain("paper"),
            reward=RewardConfig(),
            net=Mlp(
                tuple(rng.normal(0, 0.3, shape).astype(np.float32) for shape in shapes),
                tuple(rng.normal(0, 0.3, shape[0]).astype(np.float32) for shape in shapes),
            ),
            scaling=Normalisation(143e3, 60e3),
            gamma=0.99,
        )
        path = tmp_path / f"{kind}.safetensors"
        save_policy(path, policy)
        return str(path), policy

    return make


class Peer:
    """Plays any side of the contract: hears every topic, says what it is told to."""

    def __init__(self, node: Node, heard: Sequence[topics.Topic]) -> None:
        self.node = node
        self.heard: dict[str, list[Any]] = {topic.name: [] for topic in heard}
        self.on_sample: Callable[[Sample], None] = lambda sample: None
        self._publishers: dict[str, Any] = {}
        for topic in heard:
            subscribe_to(node, topic, self._receiver(topic))

    def _receiver(self, topic: topics.Topic) -> Callable[[Any], None]:
        decode = DECODERS.get(topic.name, lambda msg: msg)

        def receive(msg: Any) -> None:
            sample = decode(msg)
            self.heard[topic.name].append(sample)
            self.on_sample(sample)

        return receive

    def publisher(self, topic: topics.Topic) -> Any:
        if topic.name not in self._publishers:
            self._publishers[topic.name] = publish_on(self.node, topic)
        return self._publishers[topic.name]

    def say(self, *samples: Sample) -> None:
        for sample in samples:
            topic, msg = encode(sample, RosMessages())
            self.publisher(topic).publish(msg)


class Graph:
    """One context and one executor; every node of it lives in this process."""

    def __init__(self, domain: int, folder: Path) -> None:
        self.context = Context()
        init(
            context=self.context,
            domain_id=domain,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self._executor = SingleThreadedExecutor(context=self.context)
        self._folder = folder
        self._runs = 0

    def node(self, name: str, namespace: str = "") -> Node:
        node = Node(name, context=self.context, namespace=namespace)
        self._executor.add_node(node)
        return node

    def remove(self, node: Node) -> None:
        self._executor.remove_node(node)
        node.destroy_node()

    def plant(self, **values: Any) -> PlantSim:
        self._runs += 1
        defaults = {parameter.name: parameter.default for parameter in PARAMETERS}
        output = str(self._folder / f"run{self._runs}")
        return PlantSim(self.node("plant_sim"), {**defaults, "output": output, **values})

    def policy(self, answerer: Answerer, name: str = "test_policy") -> PolicyNode:
        return PolicyNode(self.node(name), answerer, history_depth=10)

    def peer(self, *heard: topics.Topic, name: str = "peer", namespace: str = "") -> Peer:
        return Peer(self.node(name, namespace), heard)

    def spin_until(self, condition: Callable[[], Any], what: str) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while not condition():
            assert time.monotonic() < deadline, f"waited in vain for {what}"
            self._executor.spin_once(timeout_sec=0.02)

    def spin(self, times: int) -> None:
        for _ in range(times):
            self._executor.spin_once(timeout_sec=0.02)

    def spin_to(self, due_s: float) -> None:
        """Spin until ``time.monotonic()`` is ``due_s``."""
        while (left_s := due_s - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=left_s)

    def drive(self, plant: PlantSim) -> tuple[Trajectory, dict[str, Any]]:
        """Spin until the plant is done, take it off the graph and return its result."""
        self.spin_until(lambda: plant.finished() is not None, "the end of the run")
        assert plant.finished() == 0
        self.remove(plant._node)
        return read_run(self._folder / f"run{self._runs}")

    def close(self) -> None:
        for node in self._executor.get_nodes():
            self.remove(node)
        self._executor.shutdown()
        shutdown(context=self.context)


@pytest.fixture
def graph(domain_id: int, tmp_path: Path) -> Iterator[Graph]:
    graph = Graph(domain_id, tmp_path)
    yield graph
    graph.close()


class Process:
    """A node as a process; its output goes to a file."""

    def __init__(self, name: str, command: Sequence[str], folder: Path) -> None:
        self.name = name
        self._log = folder / f"{name}_{time.monotonic_ns()}.log"
        with self._log.open("wb") as file:
            self.process = subprocess.Popen(
                command, cwd=folder, stdin=subprocess.DEVNULL, stdout=file, stderr=file
            )

    @property
    def output(self) -> str:
        return self._log.read_text()

    def end(self, number: int | None = None) -> int:
        """Send a signal, if any, and wait for the exit code."""
        if number is not None:
            self.process.send_signal(number)
        return self.process.wait(DEADLINE_S)


@pytest.fixture
def start(tmp_path: Path, domain_id: int) -> Iterator[Callable[..., Process]]:
    """Starts executables by name; parameters are keywords. None may outlive the test."""
    started: list[Process] = []

    def begin(name: str, namespace: str = "", **parameters: Any) -> Process:
        command = [str(BIN / name)]
        if parameters or namespace:
            command += ["--ros-args"]
        if namespace:
            command += ["-r", f"__ns:={namespace}"]
        for key, value in parameters.items():
            command += ["-p", f"{key}:={value}"]
        started.append(Process(name, command, tmp_path))
        return started[-1]

    yield begin
    left = [process for process in started if process.process.poll() is None]
    for process in left:
        process.end(signal.SIGKILL)
    assert not left, f"outlived the test: {[process.name for process in left]}"


@pytest.fixture
def wait_for() -> Callable[[Callable[[], Any], str], None]:
    """Polls a condition until a generous deadline."""

    def wait(condition: Callable[[], Any], what: str) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while not condition():
            assert time.monotonic() < deadline, f"waited in vain for {what}"
            time.sleep(0.02)

    return wait
