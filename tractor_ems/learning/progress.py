"""How a training run tells where it stands: a record, a bar, a JSONL log, TensorBoard logs."""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from tractor_msgs_py.atomic import write_bytes
from tractor_msgs_py.errors import ConfigError


@dataclass(frozen=True)
class Progress:
    """Where a run stands.

    Attributes:
        step, updates: gradient steps done and wanted.
        metrics: name to value: ``losses/td_loss``, mean loss of the last batch;
            ``losses/q_values``, mean value of its states and actions, in reward units;
            ``charts/SPS``, updates per second since the last report; ``charts/learning_rate``.
        seconds: since the run began, or began again.
    """

    step: int
    updates: int
    metrics: Mapping[str, float]
    seconds: float

    def to_json(self) -> dict[str, Any]:
        """Plain data, one flat object."""
        return {
            "step": self.step,
            "updates": self.updates,
            "seconds": round(self.seconds, 3),
            **self.metrics,
        }


Report = Callable[[Progress], None]


@contextmanager
def progress_bar(console: Console | None = None) -> Iterator[Report]:
    """A rich bar on stderr; yields the callback that moves it."""
    columns = (
        TextColumn("training"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f} updates"),
        TextColumn("loss {task.fields[loss]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Bar(*columns, console=console or Console(stderr=True), transient=True) as bar:
        task = bar.add_task("training", total=None, loss="-")

        def report(progress: Progress) -> None:
            loss = f"{progress.metrics.get('losses/td_loss', float('nan')):.4f}"
            bar.update(task, completed=progress.step, total=progress.updates, loss=loss)

        yield report


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

        def report(progress: Progress) -> None:
            file.write(json.dumps(progress.to_json(), allow_nan=False) + "\n")
            file.flush()
            if writer is not None:
                for name, value in progress.metrics.items():
                    writer.add_scalar(name, value, progress.step)

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
