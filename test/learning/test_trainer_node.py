"""The trainer as a real process: progress on its topic, exit codes, a checkpoint on SIGTERM."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest
import rclpy
from domain_coordinator import domain_id
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String

from tractor_ems.learning.checkpoint import checkpoint_path
from tractor_ems.nodes.trainer import PROGRESS_QOS
from tractor_ems.policies.q_policy import load_policy
from tractor_msgs_py.ros.shell import qos_profile

DEADLINE_S = 120.0


@contextmanager
def trainer(domain: int, log: Path, **parameters: str) -> Iterator[subprocess.Popen[bytes]]:
    """The node with its output in ``log``; never outlives the test."""
    command = [sys.executable, "-m", "tractor_ems.nodes.trainer", "--ros-args"]
    for name, value in parameters.items():
        command += ["-p", f"{name}:={value}"]
    env = os.environ | {
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    with log.open("wb") as file:
        process = subprocess.Popen(command, env=env, stdout=file, stderr=file)
        try:
            yield process
        finally:
            process.kill()
            process.wait()


@contextmanager
def progress(domain: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], list[dict]]]:
    """Every progress message so far; each call spins once."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = rclpy.create_node("listener", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    seen: list[dict] = []
    node.create_subscription(
        String,
        "/trainer/progress",
        lambda msg: seen.append(json.loads(msg.data)),
        qos_profile(PROGRESS_QOS),
    )

    def look() -> list[dict]:
        executor.spin_once(timeout_sec=0.1)
        return seen

    try:
        yield look
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown(context=context)


def wait_for(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline, f"timed out waiting for {what}"


@pytest.mark.slow
def test_trainer_tells_its_progress_and_exits_0_when_done(
    bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    out, log = tmp_path / "p.safetensors", tmp_path / "log"
    given = {
        "bags": f"['{bags / 'best'}']",
        "output": str(out),
        "updates": "500",
        "reward": "equivalent_fuel",
        "targets": "counterfactual",
        "seed": "4",
    }
    with (
        domain_id() as domain,
        progress(domain, monkeypatch) as look,
        trainer(domain, log, **given) as process,
    ):
        wait_for(lambda: bool(look()) and look()[-1]["state"] == "done", "the last progress")
        assert process.wait(DEADLINE_S) == 0, log.read_text()
    policy = load_policy(out)
    assert policy.metadata["seed"] == 4 and policy.metadata["training"]["updates"] == 500
    assert "Traceback" not in log.read_text()


@pytest.mark.slow
def test_sigterm_leaves_a_checkpoint_and_exits_0(
    bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    out, log = tmp_path / "p.safetensors", tmp_path / "log"
    given = {"bags": str(bags / "best"), "output": str(out), "updates": "100000000"}
    with (
        domain_id() as domain,
        progress(domain, monkeypatch) as look,
        trainer(domain, log, **given) as process,
    ):
        wait_for(lambda: any(p["step"] > 0 for p in look()), "the first updates")
        process.send_signal(signal.SIGTERM)
        assert process.wait(DEADLINE_S) == 0, log.read_text()
    assert checkpoint_path(out).is_file() and not out.exists()
    assert "Traceback" not in log.read_text()


@pytest.mark.slow
def test_sigterm_exits_2_where_the_checkpoint_cannot_be_written(
    bags: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    out, log, preset = tmp_path / "p.safetensors", tmp_path / "log", tmp_path / "preset.yaml"
    preset.write_text("checkpoint_every: 100000000\n")
    checkpoint_path(out).mkdir()
    given = {
        "bags": f"['{bags / 'best'}']",
        "output": str(out),
        "updates": "100000000",
        "preset": str(preset),
    }
    with (
        domain_id() as domain,
        progress(domain, monkeypatch) as look,
        trainer(domain, log, **given) as process,
    ):
        wait_for(lambda: any(p["step"] > 0 for p in look()), "the first updates")
        process.send_signal(signal.SIGTERM)
        assert process.wait(DEADLINE_S) == 2, log.read_text()
    last = log.read_text().splitlines()[-1]
    assert last.startswith("trainer: ") and str(checkpoint_path(out)) in last
    assert "Traceback" not in log.read_text()


slow = partial(pytest.param, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("parameters", "named"),
    [
        ({"bags": "['/no/such/bag']", "output": "p.safetensors"}, "/no/such/bag"),
        slow({"bags": "/no/such/bag", "output": "p.safetensors"}, "/no/such/bag"),
        slow({"bags": "7", "output": "p.safetensors"}, "parameter bags"),
        slow({"bags": "['x']"}, "parameter output"),
        slow(
            {"bags": "['x']", "output": "p.safetensors", "targets": "guess"}, "parameter targets"
        ),
    ],
)
def test_bad_input_exits_2_with_one_line(
    parameters: dict[str, str], named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    log = tmp_path / "log"
    with domain_id() as domain, trainer(domain, log, **parameters) as process:
        assert process.wait(DEADLINE_S) == 2, log.read_text()
    lines = log.read_text().splitlines()
    assert len(lines) == 1 and lines[0].startswith("trainer: ") and named in lines[0]
    assert [path.name for path in tmp_path.iterdir()] == ["log"]
