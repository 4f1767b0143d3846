"""A finished run on disk: ``trajectory.csv``, then ``result.json``, whose presence says "done".

Floats are written so that reading them back gives the same bits: the trajectory hash of what
was read equals the one that was written.
"""

import csv
import io
import json
import tempfile
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from tractor_msgs_py.atomic import write_bytes, write_json
from tractor_msgs_py.errors import ConfigError, RunAborted
from tractor_msgs_py.trajectory import Trajectory, trajectory_hash
from tractor_sim.figures import run_figures
from tractor_sim.plant_run import PlantRun

TABLE, RESULT = "trajectory.csv", "result.json"
COLUMNS = tuple(field.name for field in fields(Trajectory) if field.name != "soc_final")
_TYPES: dict[str, Any] = {"stamp_ns": np.int64, "engine_on": np.bool_}


def summary(run: PlantRun, counters: Mapping[str, int | str]) -> dict[str, Any]:
    """A finished run in numbers, as plain JSON data; efficiency is null when no fuel was burnt."""
    return {
        "run_id": run.info.run_id,
        "cycle": run.info.cycle,
        "cycle_hash": run.info.cycle_hash,
        "powertrain": run.info.powertrain,
        "powertrain_hash": run.info.powertrain_hash,
        "lockstep": run.info.lockstep,
        "soc_initial": run.info.soc_initial,
        "soc_target": run.info.soc_target,
        **run_figures(run.trajectory(), run.params),
        "counters": dict(counters),
        "package_version": run.info.package_version,
        "command_line": run.info.command_line,
    }


def line_of(result: dict[str, Any]) -> str:
    """The summary in one line, for people."""
    efficiency = result["efficiency"]
    shown = "no fuel burnt" if efficiency is None else f"efficiency {efficiency:.2%}"
    counts = {name: n for name, n in result["counters"].items() if not isinstance(n, str)}
    troubles = [f"{name} {count}" for name, count in counts.items() if count]
    return (
        f"{result['cycle']} on {result['powertrain']}: {result['steps']} steps, "
        f"fuel {result['fuel_kg']:.4f} kg ({result['fuel_gal']:.4f} gal), {shown}, "
        f"final SOC {result['soc_final']:.4f}, hash {result['trajectory_hash'][:16]}"
        + (f", {', '.join(troubles)}" if troubles else "")
    )


def clear_run(folder: Path) -> None:
    """Make ``folder`` ready for a result: it exists, can be written to and holds no old result.

    Raises:
        ConfigError: it cannot be made so.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in (RESULT, TABLE):  # the result first: its presence says "done"
            (folder / name).unlink(missing_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise ConfigError(f"{folder}: no place for a result ({error.strerror or error})") from None


def write_run(folder: Path, trajectory: Trajectory, result: dict[str, Any]) -> None:
    """Write both files into ``folder``, each whole or not at all.

    Raises:
        RunAborted: the folder cannot be written to (any more).
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows(zip(*(getattr(trajectory, name).tolist() for name in COLUMNS), strict=True))
    try:
        write_bytes(folder / TABLE, text.getvalue().encode())
        write_json(folder / RESULT, result)
    except ConfigError as error:
        raise RunAborted(str(error)) from None


def read_run(folder: Path) -> tuple[Trajectory, dict[str, Any]]:
    """What :func:`write_run` wrote.

    Raises:
        RunAborted: the run left no result, or one whose hash is not that of its trajectory.
    """
    try:
        result = json.loads((folder / RESULT).read_text(encoding="utf-8"))
        with (folder / TABLE).open(newline="", encoding="utf-8") as file:
            header, *rows = csv.reader(file)
        if tuple(header) != COLUMNS:
            raise ValueError(f"columns {header}")
        columns = {
            name: _column(name, texts)
            for name, texts in zip(COLUMNS, zip(*rows, strict=True), strict=True)
        }
        trajectory = Trajectory(**columns, soc_final=float(result["soc_final"]))
        if trajectory_hash(trajectory) != result["trajectory_hash"]:
            raise ValueError("trajectory.csv does not have the hash of result.json")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RunAborted(f"{folder}: no readable result of a run ({error})") from None
    return trajectory, result


def _column(name: str, texts: tuple[str, ...]) -> Any:
    if name == "engine_on":
        return np.array([text == "True" for text in texts])
    return np.array([_TYPES.get(name, float)(text) for text in texts])
