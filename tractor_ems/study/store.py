"""Finished runs on disk: what was found, apart from what it cost.

``result.json`` and ``result.safetensors`` of equal runs are equal to the byte; seconds and memory
are in ``cost.json``. ``result.json`` is written last, so a run is there whole or not at all.
"""

import json
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from tractor_ems.learning.tabular import TableStudy
from tractor_ems.study.results import Curve, Outcome, Run
from tractor_ems.study.rows import Row
from tractor_msgs_py.atomic import write_bytes, write_json
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import Trajectory

_TABLE_ARRAYS = ("state_visits", "sample_q", "sample_reward")


def run_folder(out: Path, row: Row, seed: int, config_hash: str) -> Path:
    """Where a run lies: row, seed and the first of its hash."""
    return out / "runs" / f"{row.key}-{seed}-{config_hash[:12]}"


def save_run(folder: Path, run: Run) -> None:
    """Write a finished run."""
    arrays = {f"curve.{name}": value for name, value in vars(run.curve).items()}
    trajectory = vars(run.outcome.trajectory)
    arrays |= {f"drive.{n}": v for n, v in trajectory.items() if n != "soc_final"}
    if run.table is not None:
        arrays |= {f"table.{name}": getattr(run.table, name) for name in _TABLE_ARRAYS}
    write_bytes(
        folder / "result.safetensors",
        save({name: np.ascontiguousarray(value) for name, value in arrays.items()}),
    )
    write_json(
        folder / "cost.json", {"seconds": run.seconds, "peak_rss_bytes": run.peak_rss_bytes}
    )
    outcome = {n: v for n, v in vars(run.outcome).items() if n != "trajectory"}
    table = None
    if run.table is not None:
        table = {n: v for n, v in vars(run.table).items() if n not in _TABLE_ARRAYS}
    document = {
        "row": asdict(run.row),
        "seed": run.seed,
        "config_hash": run.config_hash,
        "episodes": run.episodes,
        "steps": run.steps,
        "updates": run.updates,
        "outcome": outcome,
        "seeding": run.seeding,
        "table": table,
    }
    write_json(folder / "result.json", document)


def is_done(folder: Path, config_hash: str) -> bool:
    """The folder holds the finished run of this hash."""
    path = folder / "result.json"
    if not path.is_file():
        return False
    return bool(_read_json(path).get("config_hash") == config_hash)


def load_run(folder: Path, row: Row, config_hash: str) -> Run:
    """Inverse of :func:`save_run`; label and role are ``row``'s, which decide no result.

    Raises:
        ConfigError: a file is missing, damaged or of another run.
    """
    document, cost = _read_json(folder / "result.json"), _read_json(folder / "cost.json")
    if document.get("config_hash") != config_hash:
        raise ConfigError(f"{folder}: config_hash is of another run; remove it and run again")
    path = folder / "result.safetensors"
    try:
        arrays = load(path.read_bytes())
        trajectory = Trajectory(
            **{f.name: arrays[f"drive.{f.name}"] for f in fields(Trajectory)[:-1]},
            soc_final=document["outcome"]["soc_final"],
        )
        table: TableStudy | None = None
        if document["table"] is not None:
            pictures: dict[str, Any] = {n: arrays[f"table.{n}"] for n in _TABLE_ARRAYS}
            table = TableStudy(**document["table"], **pictures)
        return Run(
            row=row,
            seed=document["seed"],
            config_hash=document["config_hash"],
            episodes=document["episodes"],
            steps=document["steps"],
            updates=document["updates"],
            curve=Curve(**{f.name: arrays[f"curve.{f.name}"] for f in fields(Curve)}),
            outcome=Outcome(**document["outcome"], trajectory=trajectory),
            seeding=document["seeding"],
            table=table,
            seconds=cost["seconds"],
            peak_rss_bytes=cost["peak_rss_bytes"],
        )
    except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"{folder}: damaged run ({error!r}); remove it and run again") from None


def _read_json(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from None
    if not isinstance(document, dict):
        raise ConfigError(f"{path}: not a JSON object")
    return document
