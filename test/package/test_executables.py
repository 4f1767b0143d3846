"""A signal during the first second of an executable, before rclpy is there, ends it cleanly."""

import signal
import subprocess
import sys

import pytest

from tractor_ems import executables

NODES = [
    "plant_sim",
    "rule_based_policy",
    "dp_policy",
    "ddqn_policy",
    "bag_recorder",
    "bag_player",
    "trainer",
]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_importing_ends_with_code_0_and_no_traceback(number):
    code = (
        "import importlib, os; from tractor_ems import executables; "
        f"importlib.import_module = lambda name: os.kill(os.getpid(), {int(number)}); "
        "executables.plant_sim(); print('went on')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_the_beginning_of_an_executable_imports_no_library():
    code = "import sys; from tractor_ems import executables; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"rclpy", "numpy", "pydantic"} & set(done.stdout.split())


@pytest.mark.parametrize("name", NODES)
def test_every_node_begins_there(name, monkeypatch):
    begun = []
    monkeypatch.setattr(executables, "_node", lambda module: begun.append(module) or 0)
    assert getattr(executables, name)() == 0
    assert begun[0].endswith(f".nodes.{name}")
