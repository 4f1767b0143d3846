"""Second stage of the held-out study: policy files from bags, each with what it took."""

import resource
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

from tractor_ems.learning.config import TrainConfig, load_train_config
from tractor_ems.learning.recordings import Recordings, distinct_demands, read_recordings
from tractor_ems.learning.train import train_on
from tractor_ems.policies.envelope import envelope_of
from tractor_ems.policies.sdp_file import save_sdp
from tractor_ems.study.held_out_record import Recorded
from tractor_ems.study.pieces import code_digest, digest_of, digest_of_file, load_piece, save_piece
from tractor_ems.tuning.sdp_bags import sdp_of_demand, sdp_settings
from tractor_msgs_py import __version__
from tractor_msgs_py.errors import RunAborted
from tractor_sim.config import load_powertrain
from tractor_sim.powertrain_json import powertrain_hash

_CODE = (
    "tractor_ems/learning",
    "tractor_ems/optimal",
    "tractor_ems/policies",
    "tractor_ems/tuning/sdp_bags.py",
    "tractor_ems/tuning/squeeze.py",
    "tractor_sim",
)

COMMAND = "ems study held-out"
"""What policy files name as the command that made them: workers have none of their own."""


@dataclass(frozen=True)
class Training:
    """One policy file to make.

    Attributes:
        name: of the policy; seed: of its training, None for a table.
        kind: ``learner`` (``preset`` of config/training) or ``table`` (``planned`` or not).
        powertrain: whom it is for; bags: what it learns from, ``bags_key`` their content.
        updates: gradient steps; None: the preset's.
        out: the policy file; its piece lies beside it.
    """

    name: str
    kind: Literal["learner", "table"]
    powertrain: str
    bags: tuple[Path, ...]
    bags_key: str
    transitions: int
    out: Path
    seed: int | None = None
    preset: str = ""
    planned: bool = True
    updates: int | None = None

    @property
    def piece(self) -> Path:
        """Where its figures are kept."""
        return self.out.with_suffix(".json")

    @property
    def key(self) -> str:
        """Hash of everything that decides the policy."""
        params = load_powertrain(self.powertrain)
        settings = (
            train_config(self).to_json()
            if self.kind == "learner"
            else asdict(sdp_settings(params, planned=self.planned))
        )
        powertrain = powertrain_hash(params)
        made = [self.name, self.kind, self.seed, settings, powertrain, self.bags_key]
        return digest_of([*made, code_digest(*_CODE)])


@dataclass(frozen=True)
class Trained:
    """A finished training.

    Attributes:
        training: what was asked for; file_sha256: of the policy file.
        seconds, cpu_s: from bags to policy file: reading them (once for all that a worker
            trains) and training; read_s: of this, reading.
        peak_rss_bytes: of the process, which also holds what it read before.
    """

    training: Training
    file_sha256: str
    seconds: float
    cpu_s: float
    read_s: float
    peak_rss_bytes: int

    def to_json(self) -> dict[str, Any]:
        """A row of the results; paths of this machine are left out."""
        return {
            "policy": self.training.name,
            "seed": self.training.seed,
            "powertrain": self.training.powertrain,
            "episodes": len(self.training.bags),
            "transitions": self.training.transitions,
            "seconds": round(self.seconds, 2),
            "cpu_s": round(self.cpu_s, 2),
            "read_s": round(self.read_s, 2),
            "peak_rss_bytes": self.peak_rss_bytes,
            "file_sha256": self.file_sha256,
        }


def training_of(name: str, recorded: Sequence[Recorded], **given: Any) -> Training:
    """A training from recorded bags; their order decides nothing."""
    return Training(
        name=name,
        bags=tuple(sorted(item.bag for item in recorded)),
        bags_key=digest_of(sorted(item.key for item in recorded)),
        transitions=sum(item.steps for item in recorded),
        **given,
    )


def train_config(task: Training) -> TrainConfig:
    """The resolved settings of a learner. Raises ConfigError where the preset does not fit."""
    overrides = {"powertrain": task.powertrain, "seed": task.seed, "updates": task.updates}
    return load_train_config(task.preset, overrides)


def train(task: Training) -> Trained:
    """Make the policy file, unless it is there."""
    key = task.key
    found = load_piece(task.piece, key)
    if found is None or not task.out.is_file():
        recordings, read_s, read_cpu_s = _recordings(task.bags, task.bags_key, task.powertrain)
        began, began_cpu = time.perf_counter(), time.process_time()
        if task.kind == "learner":
            for left in task.out.parent.glob(f"{task.out.stem}.*"):
                left.unlink()  # a checkpoint or log of another key
            report = train_on(
                train_config(task),
                load_powertrain(task.powertrain),
                recordings,
                task.out,
                command_line=COMMAND,
            )
            if report.policy is None:
                raise RunAborted(f"{task.name} seed {task.seed}: stopped before its end")
        else:
            _fit_table(task, recordings)
        found = {
            "file_sha256": digest_of_file(task.out),
            "seconds": read_s + time.perf_counter() - began,
            "cpu_s": read_cpu_s + time.process_time() - began_cpu,
            "read_s": read_s,
            "peak_rss_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
        }
        save_piece(task.piece, key, found)
    return Trained(
        task,
        str(found["file_sha256"]),
        float(found["seconds"]),
        float(found["cpu_s"]),
        float(found["read_s"]),
        int(found["peak_rss_bytes"]),
    )


def _fit_table(task: Training, recordings: Recordings) -> None:
    params = load_powertrain(task.powertrain)
    settings = sdp_settings(params, planned=task.planned)
    demands_w = distinct_demands(recordings.traces)
    policy = sdp_of_demand(params, demands_w, settings)
    window = (params.battery.soc_min, params.battery.soc_max)
    metadata = {
        "package_version": __version__,
        "command_line": COMMAND,
        "config": asdict(settings),
        "bag_hashes": recordings.bag_hashes,
        "cycle_hashes": recordings.cycle_hashes,
        "cycles": recordings.cycles,
        "envelope": envelope_of(policy.spec, demands_w, params.dt_s, window),
    }
    save_sdp(task.out, replace(policy, metadata=metadata))


@lru_cache(maxsize=1)
def _recordings(
    bags: tuple[Path, ...], bags_key: str, powertrain: str
) -> tuple[Recordings, float, float]:
    """The bags, read once by each worker for all that it trains, and the seconds it took."""
    began, began_cpu = time.perf_counter(), time.process_time()
    found = read_recordings(bags, [], load_powertrain(powertrain))
    return found, time.perf_counter() - began, time.process_time() - began_cpu
