"""Every import of the package has a rosdep key in package.xml, or is named there as pip's.

The keys below were looked up in rosdistro: ``rosdep/base.yaml``, ``rosdep/python.yaml`` and, for
ROS packages, which are their own keys, ``jazzy/distribution.yaml``.
"""

import ast
import re
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("tractor_msgs_py", "tractor_sim", "tractor_ems")

ROS = {
    "rclpy",
    "builtin_interfaces",
    "diagnostic_msgs",
    "rcl_interfaces",
    "sensor_msgs",
    "std_msgs",
    "std_srvs",
}
KEYS = {
    "matplotlib": "python3-matplotlib",
    "numba": "python3-numba",
    "numpy": "python3-numpy",
    "pydantic": "python3-pydantic",
    "rich": "python3-rich",
    "rosbags": "python3-rosbags-pip",
    "typer": "python3-typer",
    "yaml": "python3-yaml",
} | {name: name for name in ROS}
WITHOUT_KEY = {"lz4", "mcap", "safetensors", "zstandard"}
EXTRAS = {"torch": "train", "tensorboard": "tensorboard", "gymnasium": "gym"}
TEST_KEYS = {
    "ament_index_python": "ament_index_python",
    "domain_coordinator": "domain_coordinator",
    "hypothesis": "python3-hypothesis",
    "psutil": "python3-psutil",
    "_pytest": "python3-pytest",
    "pytest": "python3-pytest",
    "pytest_timeout": "python3-pytest-timeout",  # nobody imports it: pyproject.toml sets it
    "xdist": "python3-pytest-xdist",
}


def imported(folder: Path) -> set[str]:
    """Return the top level names of every import below ``folder`` that come from elsewhere."""
    names = {name.split(".")[0] for path in folder.rglob("*.py") for name in imports_of(path)}
    own = {path.stem for path in (ROOT / "test").rglob("*.py")} | {
        path.name for path in (ROOT / "test").iterdir()
    }
    here = own if folder.name == "test" else set()
    return names - set(sys.stdlib_module_names) - set(PACKAGES) - here


def imports_of(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module


@pytest.fixture(scope="module")
def by_package() -> set[str]:
    return set().union(*(imported(ROOT / package) for package in PACKAGES))


@pytest.fixture(scope="module")
def manifest() -> ElementTree.Element:
    return ElementTree.parse(ROOT / "package.xml").getroot()


def keys_of(manifest: ElementTree.Element, tag: str) -> set[str]:
    return {element.text or "" for element in manifest.iter(tag)}


def test_every_import_has_a_rosdep_key_or_is_pips(by_package):
    assert by_package - set(KEYS) - WITHOUT_KEY - set(EXTRAS) == set()


def test_the_manifest_depends_on_exactly_what_has_a_key(manifest):
    assert keys_of(manifest, "exec_depend") == set(KEYS.values())


def test_nothing_is_depended_on_that_nobody_imports(by_package):
    assert set(KEYS) - by_package == set()


def test_what_has_no_key_is_named_in_the_manifest():
    comments = " ".join(re.findall(r"<!--(.*?)-->", (ROOT / "package.xml").read_text(), re.S))
    assert not {name for name in WITHOUT_KEY | set(EXTRAS) if name not in comments}


def asked_of_pip(keyword: str) -> Any:
    """Return what setup.py, whatever is installed now, gives as ``keyword``."""
    (value,) = [
        node.value
        for node in ast.walk(ast.parse((ROOT / "setup.py").read_text()))
        if isinstance(node, ast.keyword) and node.arg == keyword
    ]
    return ast.literal_eval(value)


def names_of(requirements: list[str]) -> set[str]:
    return {re.split(r"[\[;<>=! ]", requirement)[0] for requirement in requirements}


def test_pip_is_told_of_exactly_the_imports(by_package):
    plain = names_of(asked_of_pip("install_requires"))
    of_pip = {"yaml": "pyyaml"}
    assert {of_pip.get(name, name) for name in by_package - ROS - set(EXTRAS)} == plain
    extras = asked_of_pip("extras_require")
    for name, extra in EXTRAS.items():
        assert name in names_of(extras[extra]), name


def test_tests_import_nothing_without_a_key(manifest):
    known = set(KEYS) | WITHOUT_KEY | set(EXTRAS) | set(TEST_KEYS) | {"stable_baselines3"}
    assert imported(ROOT / "test") - known == set()
    assert keys_of(manifest, "test_depend") == set(TEST_KEYS.values())
