"""A training run from bags to policy file: the one core behind ``ems train`` and the trainer node.

torch is imported when a run on a known plant begins; sampled ones do without.
"""

import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from tractor_ems.learning.checkpoint import checkpoint_path, load_checkpoint, save_checkpoint
from tractor_ems.learning.config import SampledConfig, TrainConfig, learning_rate
from tractor_ems.learning.recordings import Recordings, read_recordings
from tractor_ems.learning.training_log import Report, training_log
from tractor_msgs_py import __version__
from tractor_msgs_py.errors import ConfigError, RunAborted
from tractor_msgs_py.provenance import command_line as own_command_line
from tractor_msgs_py.signals import SignalMap
from tractor_sim.config import load_powertrain
from tractor_sim.powertrain import PowertrainParams
from tractor_sim.powertrain_json import powertrain_hash

LOG_EVERY = 100
"""Updates between two reports."""


@dataclass(frozen=True)
class TrainReport:
    """What a run did.

    Attributes:
        policy: the policy file; None when the run was stopped before its last update.
        checkpoint: the checkpoint to resume from; None when the run is finished.
        targets, reward, powertrain, seed: of the run.
        updates: gradient steps done, those before a resume included.
        seconds: wall time, since a resume.
        bags, cycles: hashes of the bags and names of the cycles learned from.
        details: what the mode reports: seeding counts and shares, or demand ticks; episodes.
        metrics: the last ones.
    """

    policy: str | None
    checkpoint: str | None
    targets: str
    reward: str
    powertrain: str
    seed: int
    updates: int
    seconds: float
    bags: list[str]
    cycles: list[str]
    details: dict[str, Any]
    metrics: dict[str, float]

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)


def train(
    config: TrainConfig,
    bags: Sequence[Path],
    rule_bags: Sequence[Path],
    out: Path,
    *,
    progress: Report | None = None,
    stop: Callable[[], bool] | None = None,
    resume: bool = False,
    tensorboard: Path | None = None,
    command_line: str | None = None,
    signals: SignalMap | None = None,
    namespace: str | None = None,
) -> TrainReport:
    """Train from bags and write the policy file ``out``, with its log ``STEM.jsonl`` beside it.

    Args:
        bags: bags, or folders of bags. In ``sampled`` mode those that DP drove seed the replay.
        rule_bags: more bags, driven by rules.
        out: where the policy goes; written whole at the end or not at all.
        progress: called every LOG_EVERY updates and at the end.
        stop: asked after every update; True leaves a checkpoint and ends the run.
        resume: continue from the checkpoint beside ``out``.
        tensorboard: folder for TensorBoard logs.
        command_line: what to record as the command that made the policy; None: this process's.
            A resumed run records that of the run it goes on from.
        signals: the map of a vehicle whose bags these are; the policy then drives ``sampled``,
            every step of the powertrain. None: bags of the project's own topics.
        namespace: of the map's relative topics; None: the only one that fits.

    Raises:
        BagError: a bag cannot be read or does not fit.
        ConfigError: nothing to learn from, torch is needed and missing, ``out`` is no name for a
            policy file, or the checkpoint does not fit.
        RunAborted: the loss or a weight is not finite any more; nothing of that is saved.
        KeyboardInterrupt: Ctrl-C, after a checkpoint was written.
    """
    check_output(out)
    params = load_powertrain(config.powertrain)
    recordings = read_recordings(
        bags,
        rule_bags,
        params,
        allow_other_powertrain=config.allow_other_powertrain,
        allow_held_out=config.allow_held_out,
        signals=signals,
        namespace=namespace,
        driven=config.targets == "sampled",
    )
    return train_on(
        config,
        params,
        recordings,
        out,
        progress=progress,
        stop=stop,
        resume=resume,
        tensorboard=tensorboard,
        command_line=command_line,
    )


def train_on(
    config: TrainConfig,
    params: PowertrainParams,
    recordings: Recordings,
    out: Path,
    *,
    progress: Report | None = None,
    stop: Callable[[], bool] | None = None,
    resume: bool = False,
    tensorboard: Path | None = None,
    command_line: str | None = None,
) -> TrainReport:
    """:func:`train` on recordings that are already read."""
    check_output(out)
    one_thread = _one_thread(config)
    # numba, on which the sampled learner runs, is slow to import.
    from tractor_ems.learning.experiment import begin, make_generators, prepare

    generators = make_generators(config.seed)
    experiment = prepare(config, params, recordings, generators.episodes)
    identity = {
        "config": config.to_json(),
        "powertrain_hash": powertrain_hash(params),
        **recordings.identity,
        "package_version": __version__,
    }
    saved = checkpoint_path(out)
    began = time.perf_counter()
    with one_thread, _deferred_interrupt() as interrupted:
        run = begin(experiment, generators)
        learner = run.learner
        metrics: dict[str, float] = {}
        origin = own_command_line() if command_line is None else command_line
        if resume:
            tensors, state = load_checkpoint(saved, identity)
            run.restore(tensors, state)
            metrics, origin = dict(state["metrics"]), str(state["command_line"])
        stopped = False
        with training_log(out.with_suffix(".jsonl"), learner.step, tensorboard) as log:
            reported, since = learner.step, began
            while learner.step < config.updates and not stopped:
                run.before_update()
                latest = learner.update()
                step = learner.step
                _refuse_divergence(step, {"loss": latest["losses/td_loss"]})
                if step % LOG_EVERY == 0 or step == config.updates:
                    now = time.perf_counter()
                    metrics = {name: float(value) for name, value in latest.items()}
                    metrics["charts/SPS"] = (step - reported) / max(now - since, 1e-9)
                    metrics["charts/learning_rate"] = learning_rate(config.mode, step - 1)
                    metrics["charts/seconds"] = now - began
                    reported, since = step, now
                    for report in (log, progress):
                        if report is not None:
                            report(step, metrics)
                stopped = bool(interrupted) or (stop is not None and stop())
                if step % config.checkpoint_every == 0 or stopped:
                    tensors = learner.tensors()
                    _refuse_divergence(step, tensors)
                    state = {**run.state(), "metrics": metrics, "command_line": origin}
                    save_checkpoint(saved, tensors, state, identity)
        finished = learner.step == config.updates
        if finished:
            metadata = {
                "package_version": __version__,
                "command_line": origin,
                "config": config.to_json(),
                "seed": config.seed,
                **recordings.map_json,
                "bag_hashes": recordings.bag_hashes,
                "cycle_hashes": recordings.cycle_hashes,
                "cycles": sorted({*recordings.cycles, *experiment.episodes}),
                "training": {
                    "updates": learner.step,
                    "episodes": len(experiment.episodes),
                    "final_td_loss": metrics.get("losses/td_loss"),
                    **run.summary,
                },
            }
            run.save(out, metadata)
            saved.unlink(missing_ok=True)
    if interrupted and not finished:
        raise KeyboardInterrupt
    return TrainReport(
        policy=str(out) if finished else None,
        checkpoint=None if finished else str(saved),
        targets=config.targets,
        reward=config.reward.kind,
        powertrain=params.name,
        seed=config.seed,
        updates=learner.step,
        seconds=time.perf_counter() - began,
        bags=recordings.bag_hashes,
        cycles=sorted({*recordings.cycles, *experiment.episodes}),
        details={**run.summary, "episodes": len(experiment.episodes)},
        metrics=metrics,
    )


def check_output(out: Path) -> None:
    """Refuse a name that no policy can be written to, or be found by afterwards.

    Raises:
        ConfigError: not ``.safetensors``, or a folder.
    """
    if out.suffix != ".safetensors":
        raise ConfigError(f"{out}: the policy file must end in .safetensors")
    if out.is_dir():
        raise ConfigError(f"{out}: is a folder, give the policy file to write")


def _one_thread(config: TrainConfig) -> AbstractContextManager[None]:
    """torch on one thread, where it is needed: bytes are repeatable then.

    Raises:
        ConfigError: torch is missing.
    """
    if isinstance(config.mode, SampledConfig):
        return nullcontext()
    try:
        from tractor_ems.learning.networks import one_thread
    except ImportError as error:
        if error.name != "torch":
            raise
        raise ConfigError(
            f"targets {config.targets}: training needs torch: pip install 'tractor_ems[train]'"
        ) from None
    return one_thread()


def _refuse_divergence(step: int, values: Mapping[str, Any]) -> None:
    for name, value in values.items():
        if not np.all(np.isfinite(np.asarray(value))):
            shown = f"{float(value)}" if np.ndim(value) == 0 else "not finite"
            raise RunAborted(f"training diverged at update {step}: {name} is {shown}")


@contextmanager
def _deferred_interrupt() -> Iterator[list[int]]:
    """Turn Ctrl-C into a flag, so that it never falls into the middle of an update.

    In other threads than the main one Python delivers no signals and nothing changes.
    """
    caught: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield caught
        return

    def remember(number: int, _frame: FrameType | None) -> None:
        caught.append(number)

    before = signal.signal(signal.SIGINT, remember)
    try:
        yield caught
    finally:
        signal.signal(signal.SIGINT, before)
