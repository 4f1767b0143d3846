"""Installs the package the ways a user does, with pip and with colcon, into scratch folders."""

import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import domain_coordinator
import pytest

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = [
    "package.xml", "setup.py", "setup.cfg", "pyproject.toml", "LICENSE", "resource",
    "config", "bags", "tractor_ems", "tractor_sim", "tractor_msgs_py",
]  # fmt: skip


@dataclass(frozen=True)
class Installation:
    """One installed copy: where it is and the environment a shell would have for it."""

    prefix: Path
    python: str
    env: dict[str, str] = field(repr=False)

    @property
    def share(self) -> Path:
        return self.prefix / "share" / "tractor_ems"

    def executable(self, name: str) -> Path:
        return self.prefix / "lib" / "tractor_ems" / name


def base_env() -> dict[str, str]:
    """Return this environment without what points at the running installation."""
    dropped = {
        "PYTHONPATH",
        "PYTHONHOME",
        "VIRTUAL_ENV",
        "AMENT_PREFIX_PATH",
        "COLCON_PREFIX_PATH",
    }
    return {k: v for k, v in os.environ.items() if k not in dropped}


def foreign_env() -> dict[str, str]:
    """Return base_env for an interpreter with ROS wheels of its own: it must find them itself."""
    env = base_env()
    if env.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None):
        env.pop("LD_LIBRARY_PATH", None)
    return env


def copy_source(destination: Path) -> Path:
    """Copy what ships, so that no build leaves anything in the checkout or picks up leftovers."""
    destination.mkdir()
    for name in SHIPPED:
        source = ROOT / name
        if source.is_dir():
            ignore = shutil.ignore_patterns("__pycache__", "*.part")
            shutil.copytree(source, destination / name, ignore=ignore)
        else:
            shutil.copy2(source, destination / name)
    return destination


def run_quietly(command: list[str], cwd: Path, env: dict[str, str]) -> None:
    """Run a build step and show its output only if it fails."""
    done = subprocess.run(
        command, cwd=cwd, env=env, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    assert done.returncode == 0, f"{command} failed:\n{done.stdout}"


def install_with_pip(folder: Path) -> Installation:
    """Install with pip, not editable, into a venv that borrows the dependencies of this one.

    A folder named in a .pth file joins sys.path, its own .pth files are not read: neither the
    checkout's editable install nor the ROS bootstrap of the parent comes along. The ROS libraries
    are therefore the parent's, found through its LD_LIBRARY_PATH.
    """
    venv = folder / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(venv)], check=True)
    python = str(venv / "bin" / "python")
    site_packages = next(venv.glob("lib/python3*/site-packages"))
    parents = dict.fromkeys([sysconfig.get_path("purelib"), sysconfig.get_path("platlib")])
    parents.update(dict.fromkeys(p for p in sys.path if p.endswith("-packages")))
    (site_packages / "dependencies.pth").write_text("\n".join(parents) + "\n")
    env = base_env()
    command = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet"]
    command += ["--no-deps", "--no-build-isolation", "--no-index", "."]
    run_quietly(command, copy_source(folder / "source"), env)
    env |= {"VIRTUAL_ENV": str(venv), "AMENT_PREFIX_PATH": str(venv)}
    env["PATH"] = f"{venv / 'bin'}{os.pathsep}{env['PATH']}"
    return Installation(venv, python, env)


def install_with_colcon(folder: Path) -> Installation:
    """Build with colcon in a scratch workspace and take the environment its setup file makes."""
    pytest.importorskip("colcon_core")
    copy_source(folder / "src")
    command = [sys.executable, "-m", "colcon", "--log-base", "log", "build", "--base-paths", "src"]
    run_quietly(command, folder, foreign_env())
    shell = subprocess.run(
        ["bash", "-c", "source install/local_setup.bash >&2 && env -0"],
        cwd=folder, env=foreign_env(), check=True, text=True, stdout=subprocess.PIPE,
    )  # fmt: skip
    env = dict(entry.split("=", 1) for entry in shell.stdout.split("\0") if entry)
    return Installation(folder / "install" / "tractor_ems", sys.executable, env)


@pytest.fixture(scope="session", params=["pip", pytest.param("colcon", marks=pytest.mark.slow)])
def installation(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Installation:
    """A fresh installation outside the checkout."""
    install = {"pip": install_with_pip, "colcon": install_with_colcon}[request.param]
    return install(tmp_path_factory.mktemp(request.param))


@pytest.fixture
def domain_id() -> Iterator[int]:
    """A ROS domain no other test on this machine uses."""
    with domain_coordinator.domain_id() as reserved:
        yield reserved


@pytest.fixture
def empty_folder(tmp_path: Path) -> Path:
    """A working directory with nothing in it."""
    folder = tmp_path / "empty"
    folder.mkdir()
    return folder
