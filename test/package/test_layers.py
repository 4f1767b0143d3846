"""The core runs without ROS, and imports point upwards only."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ["tractor_msgs_py", "tractor_sim", "tractor_ems"]
ROS_SHELL = ["tractor_msgs_py/ros", "tractor_sim/nodes", "tractor_ems/nodes"]
FORBIDDEN = {"tractor_msgs_py": {"tractor_sim", "tractor_ems"}, "tractor_sim": {"tractor_ems"}}
ROS = [
    "rclpy",
    "sensor_msgs",
    "std_msgs",
    "diagnostic_msgs",
    "std_srvs",
    "builtin_interfaces",
    "rosidl_runtime_py",
]

# Run in a process of its own: a None in sys.modules makes every import of that name fail.
IMPORT_ALL = """
import importlib, sys, traceback
blocked, modules = sys.argv[1].split(","), sys.argv[2:]
sys.modules.update(dict.fromkeys(blocked))
failed = 0
for name in modules:
    try:
        importlib.import_module(name)
    except Exception:
        failed += 1
        print(name, traceback.format_exc(limit=-2))
sys.exit(failed != 0)
"""


def sources(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def core_modules() -> list[str]:
    shell = tuple(f"{folder}/" for folder in ROS_SHELL)
    return [
        module_name(path)
        for package in PACKAGES
        for path in sources(package)
        if not str(path.relative_to(ROOT)).startswith(shell) and path.name != "__main__.py"
    ]


def import_with(blocked: list[str], modules: list[str]) -> None:
    command = [sys.executable, "-c", IMPORT_ALL, ",".join(blocked), *modules]
    done = subprocess.run(command, cwd=ROOT, text=True, capture_output=True, timeout=240)
    assert done.returncode == 0, done.stdout + done.stderr


@cache
def imported_names(path: Path) -> tuple[str, ...]:
    """The dotted name of every import in a file, wherever it stands."""
    return tuple(names_imported_by(path))


def names_imported_by(path: Path) -> Iterator[str]:
    package = module_name(path).split(".")
    if path.name != "__init__.py":
        package.pop()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            yield ".".join([*base, *([node.module] if node.module else [])])


@pytest.mark.slow
def test_core_imports_with_ros_blocked():
    modules = core_modules()
    assert {"tractor_msgs_py", "tractor_sim.resources", "tractor_ems"} <= set(modules)
    import_with(ROS, modules)


def test_command_line_starts_without_torch():
    import_with(["torch", *ROS], ["tractor_ems.cli"])


@pytest.mark.parametrize("package", FORBIDDEN)
def test_imports_point_upwards_only(package):
    offences = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in sources(package)
        for name in imported_names(path)
        if name.split(".")[0] in FORBIDDEN[package]
    ]
    assert not offences


def test_only_the_shell_names_rclpy():
    shell = tuple(f"{folder}/" for folder in ROS_SHELL)
    offences = [
        f"{path.relative_to(ROOT)} imports {name}"
        for package in PACKAGES
        for path in sources(package)
        if not str(path.relative_to(ROOT)).startswith(shell)
        for name in imported_names(path)
        if name.split(".")[0] == "rclpy"
    ]
    assert not offences


def test_every_folder_of_modules_is_a_package():
    folders = {path.parent for package in PACKAGES for path in sources(package)}
    assert not [str(f.relative_to(ROOT)) for f in folders if not (f / "__init__.py").is_file()]
