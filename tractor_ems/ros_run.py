"""One run through the real nodes as separate processes: plant, policy and, if asked, recorder.

Standard library only, no rclpy in this process. Whatever happens, no child outlives the call.
"""

import csv
import importlib.util
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from tractor_ems.scenario import Scenario
from tractor_msgs_py.errors import ConfigError, RunAborted
from tractor_msgs_py.trajectory import Trajectory
from tractor_sim.run_files import read_run

MODULES = {
    "plant_sim": "tractor_sim.nodes.plant_sim",
    "rule_based_policy": "tractor_ems.nodes.rule_based_policy",
    "dp_policy": "tractor_ems.nodes.dp_policy",
    "ddqn_policy": "tractor_ems.nodes.ddqn_policy",
    "bag_recorder": "tractor_ems.nodes.bag_recorder",
}
DOMAIN_VARIABLE = "TRACTOR_EMS_DOMAIN_ID"
"""Environment variable that sets the ROS domain of these runs; unset picks a free one."""

POLL_S = 0.02
STOP_S = 10.0
RECORDER_S = 60.0
MATCH_S = 120.0
"""How long a policy may take until it is connected; ``dp_policy`` solves its cycle first [s]."""

_DOMAINS = range(1, 101)  # 0 is everybody's default, above 101 ports collide with ephemeral ones
_DOMAIN_PORT = 32768  # port + id is held while the domain is: the convention of domain_coordinator


@dataclass(frozen=True)
class RosRunResult:
    """A finished run.

    Attributes:
        trajectory: from the plant's own data.
        run: what the plant says about it, see ``tractor_sim.run_files.summary``.
        bag: the folder it was recorded into, None where it was not.
    """

    trajectory: Trajectory
    run: dict[str, Any]
    bag: Path | None


@dataclass(frozen=True)
class _Node:
    name: str
    process: subprocess.Popen[bytes]
    log: Path

    def line(self) -> str:
        """The one line with which it explains its end."""
        lines = [line.strip() for line in self.log.read_text(errors="replace").splitlines()]
        own = [line for line in lines if line.startswith(f"{self.name}: ")]
        return (own or [line for line in lines if line] or [f"{self.name}: no message"])[-1]


def run_ros(
    policy: tuple[str, Mapping[str, object]],
    scenario: Scenario,
    *,
    record: Path | None = None,
    timeout_s: float = 900.0,
    domain_id: int | None = None,
) -> RosRunResult:
    """Drive ``scenario`` in lockstep with every node a process of its own.

    Args:
        policy: executable and parameters of the policy node; ``dp_policy`` is given the
            scenario besides.
        scenario: what to drive.
        record: folder of a new bag; None records nothing. It is removed if the run fails.
        timeout_s: wall clock for everything [s].
        domain_id: ROS domain 0..232; None: :data:`DOMAIN_VARIABLE`, or else a free one.

    Raises:
        ConfigError: ROS is not installed, the domain is out of range, or a node refused its
            input (its exit code 2).
        RunAborted: anything else that kept the run from its last step, in the node's own words.
    """
    if importlib.util.find_spec("rclpy") is None:
        raise ConfigError("transport ros: no rclpy, install the extra 'ros' or source ROS 2")
    if record is not None and record.exists():
        raise ConfigError(f"{record}: exists already, a recording overwrites nothing")
    name, arguments = policy
    with (
        _sigterm_unwinds(),
        tempfile.TemporaryDirectory(prefix="tractor_ems_") as folder_name,
        _domain(domain_id) as domain,
    ):
        folder = Path(folder_name)
        what = _scenario_parameters(scenario, folder)
        plant = {
            **what,
            "output": str(folder / "run"),
            "expected_recorders": int(record is not None),
            "match_timeout_s": MATCH_S,
        }
        nodes: list[_Node] = []
        try:
            nodes.append(_start("plant_sim", plant, folder, domain))
            given = {**what, **arguments} if name == "dp_policy" else arguments
            nodes.append(_start(name, given, folder, domain))
            if record is not None:
                nodes.append(_start("bag_recorder", {"output": str(record)}, folder, domain))
            _wait(nodes, time.monotonic() + timeout_s)
            trajectory, run = read_run(folder / "run")
        except BaseException:
            _stop(nodes)
            if record is not None:
                shutil.rmtree(record, ignore_errors=True)
            raise
        _stop(nodes)
    return RosRunResult(trajectory, run, record)


def _scenario_parameters(scenario: Scenario, folder: Path) -> dict[str, object]:
    cycle = scenario.cycle_source
    if Path(cycle).is_dir() or cycle.endswith(".mcap"):  # the nodes read names and CSV files
        path = folder / f"{Path(scenario.cycle.name).name}.csv"
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(("time_s", "power_demand_w"))
            for k, power_w in enumerate(scenario.cycle.power_demand_w.tolist()):
                writer.writerow((k * scenario.cycle.dt_s, power_w))
        cycle = str(path)
    return {
        "powertrain": scenario.powertrain_source,
        "cycle": cycle,
        "soc_initial": scenario.soc_initial,
        "soc_target": scenario.soc_target,
    }


def _start(name: str, parameters: Mapping[str, object], folder: Path, domain: int) -> _Node:
    command = [sys.executable, "-m", MODULES[name], "--ros-args"]
    if name == "rule_based_policy" and "policy" in parameters:
        command += ["-r", f"__node:={parameters['policy']}_policy"]  # a bag names its policy so
    for key, value in parameters.items():
        # JSON scalars are YAML scalars: a quoted string cannot turn into a number.
        command += ["-p", f"{key}:={json.dumps(value)}"]
    environment = {
        **{key: value for key, value in os.environ.items() if key != "ROS_LOCALHOST_ONLY"},
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(folder / "log"),
    }
    log = folder / f"{name}.log"
    with log.open("wb") as file:
        process = subprocess.Popen(
            command, env=environment, stdin=subprocess.DEVNULL, stdout=file, stderr=file
        )
    return _Node(name, process, log)


def _wait(nodes: list[_Node], deadline_s: float) -> None:
    """Until the plant and then the recorder are done; raises where any of them is not."""
    plant, policy, *recorders = nodes
    while plant.process.poll() is None:
        for other in (policy, *recorders):
            if other.process.poll() and plant.process.poll() is None:
                raise _failure(other)
        if policy.process.poll() == 0:
            raise RunAborted(f"{policy.name}: ended before the run did")
        if time.monotonic() > deadline_s:
            raise RunAborted(f"plant_sim: not done in time: {plant.line()}")
        time.sleep(POLL_S)
    if plant.process.returncode != 0:
        raise _failure(policy if policy.process.poll() else plant)
    for recorder in recorders:
        try:
            code = recorder.process.wait(min(RECORDER_S, max(deadline_s - time.monotonic(), 0.0)))
        except subprocess.TimeoutExpired:
            raise RunAborted(
                f"bag_recorder: did not see the end of the run: {recorder.line()}"
            ) from None
        if code != 0:
            raise _failure(recorder)


def _failure(node: _Node) -> ConfigError | RunAborted:
    code = node.process.returncode
    if code < 0:
        return RunAborted(f"{node.name}: killed by {signal.Signals(-code).name}")
    return ConfigError(node.line()) if code == 2 else RunAborted(node.line())


def _stop(nodes: list[_Node]) -> None:
    """End and reap every child, those that do not listen by force."""
    for node in nodes:
        if node.process.poll() is None:
            node.process.terminate()
    deadline_s = time.monotonic() + STOP_S
    for node in nodes:
        try:
            node.process.wait(max(deadline_s - time.monotonic(), 0.0))
        except subprocess.TimeoutExpired:
            node.process.kill()
            node.process.wait()


@contextmanager
def _domain(wanted: int | None) -> Iterator[int]:
    """The domain asked for, or a free one that stays reserved on this machine."""
    text = os.environ.get(DOMAIN_VARIABLE, "") if wanted is None else str(wanted)
    if text:
        if not (text.isascii() and text.isdigit() and int(text) <= 232):
            raise ConfigError(f"{DOMAIN_VARIABLE}: {text!r}, allowed 0..232")
        yield int(text)
        return
    for offset in _DOMAINS:
        domain = (os.getpid() + offset) % len(_DOMAINS) + 1
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as reservation:
            try:
                reservation.bind(("", _DOMAIN_PORT + domain))
            except OSError:
                continue
            yield domain
            return
    raise RunAborted(f"no free ROS domain in 1..100, set {DOMAIN_VARIABLE}")


@contextmanager
def _sigterm_unwinds() -> Iterator[None]:
    """SIGTERM ends this process through its ``finally`` clauses, so that no child is left."""

    def unwind(number: int, _frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, unwind)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
