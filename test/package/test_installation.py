"""After `pip install` and `colcon build` everything is where ROS 2 looks, and starts anywhere."""

import ast
import filecmp
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from ament_index_python.packages import get_package_prefix, get_package_share_directory

ROOT = Path(__file__).resolve().parents[2]
EXECUTABLES = next(
    list(ast.literal_eval(node.value))
    for node in ast.parse((ROOT / "setup.py").read_text()).body
    if isinstance(node, ast.Assign) and node.targets[0].id == "EXECUTABLES"
)
GIVEN_INPUT = {"bag_player", "trainer"}
"""Nodes that cannot begin without being told with what."""
SHIPPED_FOLDERS = {"config": "config", "tractor_sim/data": "data", "bags": "bags"}
START_LIMIT_S = 90.0
STOP_LIMIT_S = 30.0


def shipped_files() -> dict[str, Path]:
    """Return {path below share/tractor_ems: file in the checkout}."""
    files = {"package.xml": ROOT / "package.xml"}
    for source, destination in SHIPPED_FOLDERS.items():
        folder = ROOT / source
        for path in folder.rglob("*"):
            hidden = any(part.startswith((".", "__")) for part in path.relative_to(folder).parts)
            if path.is_file() and not hidden and path.suffix != ".part":
                files[str(Path(destination) / path.relative_to(folder))] = path
    return files


def test_ament_index_leads_to_executables(any_installation, monkeypatch):
    monkeypatch.setenv("AMENT_PREFIX_PATH", any_installation.env["AMENT_PREFIX_PATH"])
    prefix = Path(get_package_prefix("tractor_ems"))
    assert prefix == any_installation.prefix
    assert Path(get_package_share_directory("tractor_ems")) == any_installation.share
    for name in EXECUTABLES:
        assert any_installation.executable(name) == prefix / "lib" / "tractor_ems" / name


def test_this_environment_serves_ros2_run_too(monkeypatch):
    monkeypatch.setenv("AMENT_PREFIX_PATH", os.environ.get("AMENT_PREFIX_PATH") or sys.prefix)
    prefix = Path(get_package_prefix("tractor_ems"))
    for name in EXECUTABLES:
        assert os.access(prefix / "lib" / "tractor_ems" / name, os.X_OK), name


def test_configuration_data_and_bags_are_under_share(installation):
    files = shipped_files()
    wrong = [
        name
        for name, source in files.items()
        if not (installation.share / name).is_file()
        or not filecmp.cmp(source, installation.share / name, shallow=False)
    ]
    assert not wrong
    top_level = {Path(name).parts[0] for name in files}
    assert {"package.xml", *SHIPPED_FOLDERS.values()} == top_level


def test_no_tests_are_installed(installation):
    program = "import tractor_ems; print(tractor_ems.__file__)"
    package = Path(output_of(installation, ["-c", program])).parent
    assert package.is_relative_to(installation.prefix)
    assert not (package.parent / "test").exists()


def output_of(installation, arguments: list[str], cwd: Path | None = None) -> str:
    """Run the installation's Python and return what it prints."""
    done = subprocess.run(
        [installation.python, *arguments],
        cwd=cwd or installation.prefix, env=installation.env, text=True, capture_output=True,
        timeout=START_LIMIT_S,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_installed_code_finds_installed_resources(installation, empty_folder):
    program = (
        "from tractor_sim import resources as r\n"
        "print(r.__file__, r.share_dir(), sep='\\n')\n"
        "print(*(r.resource_path(k) for k in ('config', 'data', 'bags')), sep='\\n')"
    )
    module, share, *folders = output_of(installation, ["-c", program], empty_folder).splitlines()
    assert Path(module).is_relative_to(installation.prefix)
    assert Path(share) == installation.share
    assert [Path(f) for f in folders] == [
        installation.share / k for k in ("config", "data", "bags")
    ]


def node_env(installation, folder: Path, domain_id: int) -> dict[str, str]:
    """Return the environment of a started node: own domain, own machine, logs aside."""
    return installation.env | {
        "ROS_DOMAIN_ID": str(domain_id),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(folder.parent / "ros_log"),
    }


@contextmanager
def graph_names(domain_id: int, monkeypatch) -> Iterator:
    """Yield a function that lists the other nodes in this domain."""
    import rclpy
    from rclpy.context import Context

    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    context = Context()
    rclpy.init(context=context, domain_id=domain_id)
    observer = rclpy.create_node("package_test_observer", context=context)
    try:
        yield lambda: set(observer.get_node_names()) - {observer.get_name()}
    finally:
        observer.destroy_node()
        rclpy.shutdown(context=context)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name != "plant_sim"))
        for name in sorted({*EXECUTABLES} - GIVEN_INPUT - {"ems"})
    ],
)
def test_node_starts_in_an_empty_folder_and_ends_on_sigterm(
    name, any_installation, empty_folder, domain_id, monkeypatch
):
    log = empty_folder.parent / "output"
    with graph_names(domain_id, monkeypatch) as others, log.open("w") as output:
        process = subprocess.Popen(
            [any_installation.executable(name)],
            cwd=empty_folder, env=node_env(any_installation, empty_folder, domain_id),
            stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
        )  # fmt: skip
        try:
            deadline = time.monotonic() + START_LIMIT_S
            while name not in others():
                assert process.poll() is None, (
                    f"ended with {process.returncode}: {log.read_text()}"
                )
                assert time.monotonic() < deadline, f"not in the graph: {log.read_text()}"
                time.sleep(0.05)
            process.send_signal(signal.SIGTERM)
            code = process.wait(STOP_LIMIT_S)
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
    assert code == 0, log.read_text()
    assert "Traceback" not in log.read_text()


@pytest.mark.parametrize("name", sorted(GIVEN_INPUT & {*EXECUTABLES}))
def test_node_without_its_input_says_so_in_one_line(
    name, any_installation, empty_folder, domain_id
):
    done = subprocess.run(
        [any_installation.executable(name)],
        cwd=empty_folder, env=node_env(any_installation, empty_folder, domain_id), text=True,
        stdin=subprocess.DEVNULL, capture_output=True, timeout=START_LIMIT_S,
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not any(empty_folder.iterdir())


def test_command_line_helps_from_an_empty_folder(any_installation, empty_folder):
    done = subprocess.run(
        [any_installation.executable("ems"), "--help"],
        cwd=empty_folder, env=any_installation.env, text=True, capture_output=True,
        timeout=START_LIMIT_S,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    for command in ("demo", "train", "evaluate", "dp", "cycle", "bag"):
        assert command in done.stdout
