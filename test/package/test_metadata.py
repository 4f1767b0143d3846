"""One version, one list of executables, and metadata that colcon, rosdep and pip agree on."""

import importlib
import re
import subprocess
import xml.etree.ElementTree as ElementTree
from importlib.metadata import distribution
from pathlib import Path

import pytest

import tractor_ems

ROOT = Path(__file__).resolve().parents[2]
ENTRY_POINTS = {
    e.name: e for e in distribution("tractor_ems").entry_points if e.group == "console_scripts"
}


@pytest.fixture(scope="module")
def manifest() -> ElementTree.Element:
    return ElementTree.parse(ROOT / "package.xml").getroot()


def test_one_version_everywhere(manifest):
    assert manifest.findtext("version") == tractor_ems.__version__
    assert distribution("tractor_ems").version == tractor_ems.__version__


def test_manifest_is_a_plain_ament_python_package(manifest):
    assert manifest.get("format") == "3"
    assert manifest.findtext("name") == "tractor_ems"
    assert manifest.findtext("export/build_type") == "ament_python"
    assert manifest.find("buildtool_depend") is None
    assert manifest.findtext("license") == "Apache-2.0"


def test_rclpy_is_an_extra_on_pip_and_a_dependency_in_ros(manifest):
    requires = distribution("tractor_ems").requires or []
    ros = [
        r
        for r in requires
        if r.startswith("ros-jazzy-") and "extra == 'ros'" in r.replace('"', "'")
    ]
    assert {re.split(r"[\[;>= ]", r)[0] for r in ros} == {
        "ros-jazzy-rclpy",
        "ros-jazzy-common-interfaces",
    }
    assert not [r for r in requires if "rclpy" in r and "extra ==" not in r]
    depends = {d.text for d in manifest.iter("exec_depend")}
    assert {"rclpy", "sensor_msgs", "std_msgs", "diagnostic_msgs"} <= depends


def test_torch_is_not_a_runtime_dependency():
    requires = distribution("tractor_ems").requires or []
    torch = [r for r in requires if r.startswith("torch")]
    assert torch
    assert all("extra ==" in r for r in torch)


def test_tests_are_an_extra_and_not_tests_require():
    assert "tests_require" not in re.sub(r"#.*", "", (ROOT / "setup.py").read_text())


def test_executables_are_those_the_documentation_names():
    nodes = "plant_sim rule_based_policy dp_policy ddqn_policy bag_recorder bag_player trainer"
    assert set(ENTRY_POINTS) == {"ems", *nodes.split()}


def test_the_page_on_installing_names_every_executable():
    page = (ROOT / "docs" / "install.md").read_text()
    (line,) = re.findall(r"^    bag_player .*$", page, re.MULTILINE)
    assert set(line.split()) == set(ENTRY_POINTS)


@pytest.mark.parametrize("name", sorted(ENTRY_POINTS))
def test_entry_point_leads_to_a_callable(name):
    module = importlib.import_module(ENTRY_POINTS[name].module)
    assert callable(getattr(module, ENTRY_POINTS[name].attr))


def test_lock_pins_every_direct_requirement():
    lock = (ROOT / "requirements.lock").read_text()
    pinned = set(re.findall(r"^([a-z0-9-]+)==", lock, re.MULTILINE))
    direct = {
        re.split(r"[\[;<>=! ]", r)[0].lower().replace("_", "-").replace(".", "-")
        for r in distribution("tractor_ems").requires or []
    }
    assert direct <= pinned
    assert re.search(r"^torch==2\.13\.0$", lock, re.MULTILINE)
    assert "://" not in lock


def test_ci_script_is_executable_and_parses():
    script = ROOT / ".ci" / "run"
    assert script.stat().st_mode & 0o111
    subprocess.run(["bash", "-n", str(script)], check=True)
