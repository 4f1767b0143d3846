"""Installs the package the ways a user does, with pip and with colcon, into scratch folders."""

import functools
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Callable, Iterator
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
        """Return what ``ros2 run tractor_ems NAME`` starts: by the index, then by walking lib."""
        prefixes = [Path(p) for p in self.env["AMENT_PREFIX_PATH"].split(os.pathsep)]
        marker = Path("share", "ament_index", "resource_index", "packages", "tractor_ems")
        prefix = next(p for p in prefixes if (p / marker).is_file())
        found = [
            Path(folder, file)
            for folder, _, files in os.walk(prefix / "lib" / "tractor_ems")
            for file in files
            if file == name and os.access(Path(folder, file), os.X_OK)
        ]
        assert len(found) == 1, f"{name}: {found}"
        return found[0]


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


def make_venv(folder: Path) -> tuple[Path, list[str], dict[str, str]]:
    """Make a venv that borrows the dependencies of this one; return it, pip there and its env.

    A folder named in a .pth file joins sys.path, its own .pth files are not read: neither the
    checkout's editable install nor the ROS bootstrap of the parent comes along. The ROS libraries
    are therefore the parent's, found through its LD_LIBRARY_PATH.
    """
    venv = folder / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(venv)], check=True)
    site_packages = next(venv.glob("lib/python3*/site-packages"))
    parents = dict.fromkeys([sysconfig.get_path("purelib"), sysconfig.get_path("platlib")])
    parents.update(dict.fromkeys(p for p in sys.path if p.endswith("-packages")))
    (site_packages / "dependencies.pth").write_text("\n".join(parents) + "\n")
    env = base_env() | {"VIRTUAL_ENV": str(venv), "AMENT_PREFIX_PATH": str(venv)}
    env["PATH"] = f"{venv / 'bin'}{os.pathsep}{env['PATH']}"
    pip = [sys.executable, "-m", "pip", "--python", str(venv / "bin" / "python")]
    return venv, [*pip, "install", "--quiet", "--no-deps", "--no-index"], env


def install_with_pip(folder: Path, *options: str) -> Installation:
    """Install the sources with pip."""
    venv, pip, env = make_venv(folder)
    run_quietly(
        [*pip, "--no-build-isolation", *options, "."], copy_source(folder / "source"), base_env()
    )
    return Installation(venv, str(venv / "bin" / "python"), env)


def install_editable(folder: Path) -> Installation:
    """Install as `make venv` does: the code stays in the source folder."""
    return install_with_pip(folder, "--editable")


def install_wheel(folder: Path) -> Installation:
    """Build a wheel and install that, as on a machine without the sources."""
    venv, pip, env = make_venv(folder)
    source, wheels = copy_source(folder / "source"), folder / "wheels"
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-index"]
    build += ["--no-build-isolation", "--wheel-dir", str(wheels), "."]
    run_quietly(build, source, base_env())
    shutil.rmtree(source)
    run_quietly([*pip, *map(str, wheels.glob("*.whl"))], folder, base_env())
    return Installation(venv, str(venv / "bin" / "python"), env)


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


WAYS: dict[str, Callable[[Path], Installation]] = {
    "pip": install_with_pip,
    "editable": install_editable,
    "wheel": install_wheel,
    "colcon": install_with_colcon,
}
COPIES = ["pip", *(pytest.param(way, marks=pytest.mark.slow) for way in ("wheel", "colcon"))]


@pytest.fixture(scope="session")
def install(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Installation]:
    """Installs outside the checkout in the named way, once per session."""
    return functools.cache(lambda way: WAYS[way](tmp_path_factory.mktemp(way)))


@pytest.fixture(scope="session", params=COPIES)
def installation(
    request: pytest.FixtureRequest, install: Callable[[str], Installation]
) -> Installation:
    """A fresh installation that is a copy of the package."""
    return install(request.param)


@pytest.fixture(
    scope="session", params=[*COPIES, pytest.param("editable", marks=pytest.mark.slow)]
)
def any_installation(
    request: pytest.FixtureRequest, install: Callable[[str], Installation]
) -> Installation:
    """A fresh installation in any way; an editable one runs the code of its source folder."""
    return install(request.param)


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
