"""Package metadata: the one home of name, version, dependencies, entry points and data files.

colcon and pip both read this file. Tool settings are in pyproject.toml, the tested set of versions
in requirements.lock, rosdep keys in package.xml.
"""

import ast
import os
from pathlib import Path

from setuptools import Distribution, find_packages, setup

from distutils.command.install_data import install_data  # isort: skip  (setuptools brings it)

NAME = "tractor_ems"
ROOT = Path(__file__).resolve().parent

EXECUTABLES = {
    "ems": "tractor_ems.cli:main",
    "plant_sim": "tractor_ems.executables:plant_sim",
    "rule_based_policy": "tractor_ems.executables:rule_based_policy",
    "dp_policy": "tractor_ems.executables:dp_policy",
    "ddqn_policy": "tractor_ems.executables:ddqn_policy",
    "bag_recorder": "tractor_ems.executables:bag_recorder",
    "bag_player": "tractor_ems.executables:bag_player",
    "trainer": "tractor_ems.executables:trainer",
}

# `ros2 run` looks in lib/<package>, pip installs console scripts in bin/ alone: one launcher per
# executable closes the gap. colcon writes its own scripts over them.
LAUNCHER = """\
#!/bin/sh
# Where `ros2 run {package} {name}` looks: hands over to the same installation's console script.
prefix=$(dirname -- "$(readlink -f -- "$0")")/../..
exec "$prefix/bin/{name}" "$@"
"""


class InstallDataAndLaunchers(install_data):
    """Install data_files, then write the launchers into lib/<package>."""

    def run(self):
        super().run()
        folder = Path(self.install_dir, "lib", NAME)
        self.mkpath(str(folder))
        for name in EXECUTABLES:
            launcher = folder / name
            launcher.write_text(LAUNCHER.format(package=NAME, name=name))
            launcher.chmod(0o755)
            self.outfiles.append(str(launcher))


class DistributionWithData(Distribution):
    """Make `pip install -e` install the data files too.

    setuptools' editable build asks for has_data and silently skips them without it.
    """

    has_data = Distribution.has_data_files


def version():
    """Read __version__ without importing the package."""
    for node in ast.parse((ROOT / "tractor_msgs_py" / "__init__.py").read_text()).body:
        if isinstance(node, ast.Assign) and node.targets[0].id == "__version__":
            return ast.literal_eval(node.value)
    raise SystemExit("tractor_msgs_py/__init__.py has no __version__")


def tree(source, destination):
    """List data_files entries for every file under source, keeping its folders."""
    entries = []
    for folder, subfolders, files in os.walk(ROOT / source):
        subfolders[:] = sorted(d for d in subfolders if not d.startswith((".", "__")))
        relative = Path(folder).relative_to(ROOT)
        target = Path("share", NAME, destination, relative.relative_to(source))
        kept = [str(relative / f) for f in sorted(files) if not f.startswith(".")]
        if kept:
            entries.append((str(target), kept))
    return entries


setup(
    name=NAME,
    version=version(),
    description="Energy management of a series hybrid tractor on ROS 2: plant, policies, bags",
    license="Apache-2.0",
    maintainer="tractor_ems maintainers",
    maintainer_email="maintainers@example.org",
    python_requires=">=3.10,<3.14",
    packages=find_packages(include=["tractor_*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *tree("config", "config"),
        *tree("tractor_sim/data", "data"),
        *tree("bags", "bags"),
    ],
    distclass=DistributionWithData,
    cmdclass={"install_data": InstallDataAndLaunchers},
    zip_safe=False,
    install_requires=[
        "lz4>=4",
        "matplotlib>=3.8",
        "mcap>=1.2",
        "numba>=0.60",
        "numpy>=1.26",
        "pydantic>=2.7",
        "pyyaml>=6",
        "rich>=13",
        "rosbags>=0.10.4",
        "safetensors>=0.4",
        "typer>=0.12",
        "zstandard>=0.22",
    ],
    extras_require={
        # rclpy and the messages come from the ROS installation where there is one.
        "ros": ["ros-jazzy-rclpy[fastrtps]", "ros-jazzy-common-interfaces"],
        "train": ["torch>=2.2"],
        "tensorboard": ["tensorboard>=2.16"],
        "gym": ["gymnasium>=1.1"],
        "examples": ["gymnasium>=1.1", "stable-baselines3>=2.7"],
        "colcon": ["colcon-bash", "colcon-core", "colcon-python-setup-py", "colcon-ros"],
        # An extra, not tests_require, with which `colcon test` would run nothing and succeed.
        "test": [
            "hypothesis>=6.100",
            "mypy>=1.11",
            "psutil>=5.9",
            "pytest>=8",
            "pytest-timeout>=2.3",
            "pytest-xdist>=3.5",
            "ros-jazzy-domain-coordinator",
            "ruff>=0.6",
            "types-PyYAML",
        ],
    },
    entry_points={"console_scripts": [f"{k} = {v}" for k, v in EXECUTABLES.items()]},
)
