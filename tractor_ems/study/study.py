"""The study from settings to results: experts' bags, trained agents, baselines, Table 1."""

import hashlib
import json
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from tractor_ems.study.baselines import make_baselines
from tractor_ems.study.config import StudyConfig
from tractor_ems.study.experts import demonstrations, plant
from tractor_ems.study.results import StudyResults
from tractor_ems.study.run import ALGORITHM, Task, bus_demand_w, config_hash
from tractor_ems.study.schedule import Progress, run_all
from tractor_ems.study.speed import measure
from tractor_ems.study.store import is_done, load_run, run_folder
from tractor_ems.study.table1 import table1_rows
from tractor_msgs_py import __version__
from tractor_msgs_py.atomic import write_bytes, write_json
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.provenance import command_line
from tractor_sim.duty_cycle.cycle import cycle_hash
from tractor_sim.duty_cycle.library import load_cycle
from tractor_sim.powertrain_json import powertrain_hash

RANDOM_DRIVES_SEED = 0
"""Of the baseline that takes random feasible actions."""

Stage = Callable[[str, int], Progress]
"""Called with the name of a stage and how many jobs it has; returns who hears of them."""


def run_study(config: StudyConfig, out: Path, *, workers: int, stage: Stage) -> StudyResults:
    """Everything that is not on disk yet, then the results.

    Args:
        out: folder of bags, runs and checkpoints. Runs are found again by the hash of everything
            that decides them, so presets and sittings share one folder.
        workers: processes at a time.

    Raises:
        KeyboardInterrupt: Ctrl-C; the same call goes on.
        TractorEmsError: bad settings, a damaged file, or a run that was aborted.
    """
    bags = out / "bags"
    for folder in (bags, out / "runs"):  # refuse before hours of work, not after
        write_bytes(folder / ".writable", b"")
        (folder / ".writable").unlink()
    tasks = [task for task in all_tasks(config, out) if not is_done(*_finished(task))]
    seeded = {task.row.soc_min for task in tasks if task.row.seeding != "none"}
    needed = [
        item
        for item in demonstrations(config, bags)
        if item.soc_min in seeded and not item.bag.exists()
    ]
    with _sitting(out, config.preset, len(tasks)):
        run_all(config, needed, workers=workers, progress=stage("recording experts", len(needed)))
        run_all(config, tasks, workers=workers, progress=stage("training agents", len(tasks)))
    return collect(config, out)


def all_tasks(config: StudyConfig, out: Path) -> list[Task]:
    """Every run of the study, long ones first, so that no core waits for a late one; ablations
    last, seed by seed, so that an interrupted study has the same number of all of them."""
    found = []
    for row in config.rows:
        for seed in config.budget.seeds_of(row):
            folder = run_folder(out, row, seed, config_hash(config, row, seed))
            found.append(Task(config, row, seed, folder, out / "bags"))
    return sorted(found, key=_order)


def _order(task: Task) -> tuple[bool, bool, int]:
    ablation = task.row.role == "ablation"
    return not task.row.tabular, ablation, task.seed if ablation else 0


def collect(config: StudyConfig, out: Path) -> StudyResults:
    """Results of finished runs; baselines, Table 1 and the speed of this machine are new.

    Raises:
        ConfigError: a run is missing or damaged.
    """
    runs = []
    for row in config.rows:
        for seed in config.budget.seeds_of(row):
            digest = config_hash(config, row, seed)
            runs.append(load_run(run_folder(out, row, seed, digest), row, digest))
    plants = {
        soc_min: plant(config, soc_min) for soc_min in sorted({r.soc_min for r in config.rows})
    }
    demand_w = bus_demand_w(config, next(iter(plants.values())))
    return StudyResults(
        preset=config.preset,
        episodes_deep=config.budget.network_episodes,
        episodes_tabular=config.budget.table_episodes,
        steps_per_update=config.budget.steps_per_update,
        runs=tuple(runs),
        baselines=make_baselines(
            plants,
            demand_w,
            np.random.default_rng(RANDOM_DRIVES_SEED),
            soc_initial=config.soc_initial,
            soc_target=config.soc_target,
        ),
        table1=table1_rows(),
        differences=config.differences,
        provenance=_provenance(config, out),
    )


def _finished(task: Task) -> tuple[Path, str]:
    return task.folder, config_hash(task.config, task.row, task.seed)


@contextmanager
def _sitting(out: Path, preset: str, jobs: int) -> Iterator[None]:
    """Note how long this call trained, also when it is interrupted; one without work is none."""
    began, start = time.monotonic(), datetime.now(timezone.utc)
    try:
        yield
    finally:
        if jobs:
            sittings = _sittings(out)
            sittings.append(
                {
                    "preset": preset,
                    "began": start.isoformat(timespec="seconds"),
                    "wall_s": round(time.monotonic() - began, 1),
                }
            )
            write_json(out / "sittings.json", sittings)


def _sittings(out: Path) -> list[dict[str, Any]]:
    path = out / "sittings.json"
    try:
        return list(json.loads(path.read_text())) if path.exists() else []
    except ValueError as error:
        raise ConfigError(f"{path}: cannot be read ({error}); remove it") from None


def _source_hash() -> str:
    """SHA-256 of this package's Python sources, in the order of their names."""
    digest = hashlib.sha256()
    root = Path(__file__).resolve().parents[2]
    for package in ("tractor_ems", "tractor_msgs_py", "tractor_sim"):
        for path in sorted((root / package).rglob("*.py")):
            digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


def _provenance(config: StudyConfig, out: Path) -> dict[str, Any]:
    sittings = [item for item in _sittings(out) if item["preset"] == config.preset]
    return {
        "command": command_line(),
        "package_version": __version__,
        "preset": config.preset,
        "seeds": list(range(config.budget.seeds)),
        "powertrain_hash": powertrain_hash(plant(config, config.rows[0].soc_min)),
        "cycle_hash": cycle_hash(load_cycle(config.cycle)),
        "epsilon_decay_share": config.networks.epsilon_decay_share,
        "algorithm_version": ALGORITHM,
        "source_hash": _source_hash(),
        "sittings": len(sittings),
        "wall_s_all_sittings": sum(item["wall_s"] for item in sittings),
        "speed": [item.to_json() for item in measure(config)],
        "python": platform.python_version(),
        "machine": platform.machine(),
    }
