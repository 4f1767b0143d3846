"""One run through the real nodes as separate processes: plant, policy and, if asked, recorder.

No rclpy in this process. Whatever happens, short of SIGKILL, no child outlives the call.
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
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from tractor_ems.scenario import Scenario
from tractor_msgs_py.atomic import sync_folder
from tractor_msgs_py.errors import ConfigError, RunAborted
from tractor_msgs_py.provenance import command_line
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

RECORDED_DEPTH = 100_000
"""History of a recorded run's publishers: with less, a recorder that the machine makes wait for a
moment has lost ticks (measured: 0.1 s are too much for a history of ten)."""

HEARTBEAT_FILES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
HEARTBEAT_XML = """\
<?xml version="1.0" encoding="UTF-8"?>
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <data_writer profile_name="recorded_run" is_default_profile="true">
    <times><heartbeatPeriod><nanosec>20000000</nanosec></heartbeatPeriod></times>
  </data_writer>
</profiles>
"""
"""Fast DDS asks every 20 ms instead of 3 s what a subscriber has missed."""

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
        record: folder of a new bag; None records nothing. It appears when the run is over;
            until then the bag grows in a hidden folder beside it, which a failed run removes.
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
    with (
        _signals_noted() as signals,
        tempfile.TemporaryDirectory(prefix="tractor_ems_") as folder_name,
        _domain(domain_id) as domain,
        _place_for(record) as bag,
    ):
        folder = Path(folder_name)
        nodes: list[_Node] = []
        try:
            for name, parameters in _what_to_start(policy, scenario, bag, folder).items():
                nodes.append(_start(name, parameters, folder, domain))
            _wait(nodes, time.monotonic() + timeout_s, signals)
            trajectory, run = read_run(folder / "run")
        except OSError as error:
            raise RunAborted(f"nodes cannot be started: {error}") from None
        finally:
            _stop(nodes)
    return RosRunResult(trajectory, run, record)


def _what_to_start(
    policy: tuple[str, Mapping[str, object]], scenario: Scenario, bag: Path | None, folder: Path
) -> dict[str, Mapping[str, object]]:
    """Executables with their parameters: the plant, then the policy, then the recorder."""
    name, arguments = policy
    what = _scenario_parameters(scenario, folder)
    plant = {
        **what,
        "output": str(folder / "run"),
        "expected_recorders": int(bag is not None),
        "match_timeout_s": MATCH_S,
        # Bytes that are no text cannot be a parameter.
        "command_line": command_line().encode(errors="replace").decode(),
    }
    arguments = {**what, **arguments} if name == "dp_policy" else arguments
    if bag is None:
        return {"plant_sim": plant, name: arguments}
    kept = {"history_depth": RECORDED_DEPTH}
    return {
        "plant_sim": {**plant, **kept},
        name: {**arguments, **kept},
        "bag_recorder": {"output": str(bag)},
    }


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
        command += ["-p", f"{key}:={json.dumps(value, ensure_ascii=False)}"]
    environment = {
        **{key: value for key, value in os.environ.items() if key != "ROS_LOCALHOST_ONLY"},
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(folder / "log"),
    }
    if not any(variable in os.environ for variable in HEARTBEAT_FILES):
        profile = folder / "heartbeat.xml"
        profile.write_text(HEARTBEAT_XML)
        environment |= {variable: str(profile) for variable in HEARTBEAT_FILES}
    log = folder / f"{name}.log"
    with log.open("wb") as file:
        process = subprocess.Popen(
            command, env=environment, stdin=subprocess.DEVNULL, stdout=file, stderr=file
        )
    return _Node(name, process, log)


def _wait(nodes: Sequence[_Node], deadline_s: float, signals: Sequence[int]) -> None:
    """Until the plant and then the recorder are done; raises where any of them is not, or where
    a signal was noted."""
    plant, policy, *recorders = nodes
    while plant.process.poll() is None:
        _obey(signals)
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
    deadline_s = min(deadline_s, time.monotonic() + RECORDER_S)
    for recorder in recorders:
        while recorder.process.poll() is None:
            _obey(signals)
            if time.monotonic() > deadline_s:
                raise RunAborted(
                    f"bag_recorder: did not see the end of the run: {recorder.line()}"
                )
            time.sleep(POLL_S)
        if recorder.process.returncode != 0:
            raise _failure(recorder)


def _failure(node: _Node) -> ConfigError | RunAborted:
    code = node.process.returncode
    if code < 0:
        return RunAborted(f"{node.name}: killed by {signal.Signals(-code).name}")
    return ConfigError(node.line()) if code == 2 else RunAborted(node.line())


def _stop(nodes: Sequence[_Node]) -> None:
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
def _place_for(record: Path | None) -> Iterator[Path | None]:
    """Where to record: a bag of that name in a hidden folder beside, put in place at the end.

    Whoever makes ``record`` in the meantime keeps it; the run fails then.
    """
    if record is None:
        yield None
        return
    try:
        record.parent.mkdir(parents=True, exist_ok=True)
        hidden = Path(tempfile.mkdtemp(prefix=f".{record.name}.", dir=record.parent))
    except OSError as error:
        raise ConfigError(f"{record}: cannot be created ({error.strerror})") from None
    try:
        yield hidden / record.name
        try:
            os.rename(hidden / record.name, record)
            sync_folder(record.parent)
        except OSError as error:
            raise RunAborted(f"{record}: cannot be put in place ({error.strerror})") from None
    finally:
        shutil.rmtree(hidden, ignore_errors=True)


@contextmanager
def _signals_noted() -> Iterator[Sequence[int]]:
    """SIGINT and SIGTERM are noted instead of raised wherever this process happens to be.

    Between the start of a child and its entry in the list, or half way through ending them all,
    an exception would leave one behind. :func:`_obey` raises where it is safe; what came after
    its last call is raised at the end.
    """
    noted: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield noted
        return

    def note(number: int, _frame: FrameType | None) -> None:
        noted.append(number)

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, note)
    try:
        yield noted
        _obey(noted)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _obey(signals: Sequence[int]) -> None:
    """End this process through its ``finally`` clauses where a signal was noted."""
    if signal.SIGINT in signals:
        raise KeyboardInterrupt
    if signals:
        raise SystemExit(128 + signals[0])
