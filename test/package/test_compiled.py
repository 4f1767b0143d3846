"""Compiled code is never older than its sources, whichever file they stand in."""

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import tractor_ems
from tractor_ems.compiled import _SOURCES, sources_digest

PACKAGES = ("tractor_ems", "tractor_msgs_py", "tractor_sim")

REWARD = """
import numpy as np
from tractor_ems.learning.mdp import make_mdp
from tractor_ems.learning.rewards import RewardConfig
from tractor_ems.study.experts import _retell
from tractor_sim.config import load_powertrain
two = np.full(2, 100e3)
mdp = make_mdp(load_powertrain("paper"), two, RewardConfig("piecewise"), mapping="p_batt_grid",
               actions=100, soc_initial=0.85, soc_target=0.85)
print(_retell(mdp, two, np.full(3, 0.85), two, np.zeros(2), np.zeros(2))[1][0])
"""


def test_every_file_with_compiled_functions_is_among_the_sources() -> None:
    root = Path(tractor_ems.__file__).parents[1]
    named = {path for pattern in _SOURCES for path in root.glob(pattern)}
    compiled = {
        path
        for package in PACKAGES
        for path in (root / package).rglob("*.py")
        if "import njit" in path.read_text() or "import register_jitable" in path.read_text()
    }
    assert compiled and compiled <= named
    constants_of = {
        root / f"{node.module.replace('.', '/')}.py"
        for path in compiled
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom)
        and (node.module or "").startswith(PACKAGES)
        and any(item.name.isupper() for item in node.names)
    }
    assert constants_of <= named


def test_the_cache_is_named_by_the_sources() -> None:
    assert sources_digest() in os.environ["NUMBA_CACHE_DIR"] or "numba-" not in os.environ.get(
        "NUMBA_CACHE_DIR", ""
    )


@pytest.mark.slow
def test_a_change_in_one_file_reaches_loops_compiled_from_another(tmp_path: Path) -> None:
    root = Path(tractor_ems.__file__).parents[1]
    for name in (*PACKAGES, "config"):
        shutil.copytree(root / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))

    def reward() -> float:
        environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
        environment.pop("NUMBA_CACHE_DIR", None)
        done = subprocess.run(
            [sys.executable, "-c", REWARD],
            env=environment,
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=200,
            check=True,
        )
        return float(done.stdout)

    assert reward() == 2.46
    mdp = tmp_path / "tractor_ems" / "learning" / "mdp.py"
    mdp.write_text(mdp.read_text().replace("return 0.46 + 2.0", "return 0.46 + 3.0"))
    assert reward() == 3.46
