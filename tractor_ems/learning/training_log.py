"""Logs of a training run: JSON lines beside the policy, TensorBoard where it is asked for."""

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

from tractor_msgs_py.atomic import write_bytes
from tractor_msgs_py.errors import ConfigError

Report: TypeAlias = Callable[[int, dict[str, float]], None]
"""Called with the updates done and the metrics by name.

    losses/td_loss        loss of the last batch
    losses/q_values       mean value of its states and actions, in reward units
    charts/SPS            updates per second since the last report
    charts/learning_rate  of the last update
    charts/seconds        wall time since the run began, or began again
"""


@contextmanager
def training_log(path: Path, resumed_at: int, tensorboard: Path | None) -> Iterator[Report]:
    """A JSONL log, one object per report, and TensorBoard logs where a folder is given.

    On resuming, lines after the checkpoint are dropped: they are about to be written again.

    Raises:
        ConfigError: the log cannot be written, or tensorboard is not installed.
    """
    kept: list[bytes] = []
    if resumed_at and path.is_file():
        for line in path.read_bytes().splitlines(keepends=True):
            try:
                if json.loads(line)["step"] <= resumed_at:
                    kept.append(line)
            except (ValueError, KeyError, TypeError):
                continue
    write_bytes(path, b"".join(kept))
    writer = _tensorboard(tensorboard)
    with path.open("a", encoding="utf-8") as file:

        def report(step: int, metrics: dict[str, float]) -> None:
            file.write(json.dumps({"step": step, **metrics}, allow_nan=False) + "\n")
            file.flush()
            if writer is not None:
                for name, value in metrics.items():
                    writer.add_scalar(name, value, step)

        try:
            yield report
        finally:
            os.fsync(file.fileno())
            if writer is not None:
                writer.close()


def _tensorboard(folder: Path | None) -> Any:
    if folder is None:
        return None
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise ConfigError(
            "tensorboard logs need the tensorboard package: pip install 'tractor_ems[tensorboard]'"
        ) from None
    return SummaryWriter(str(folder))
