"""One function over many tasks on all cores. Tasks write what they find themselves, so that
nothing that is finished is lost when the study is ended."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, cast

from tractor_ems.evaluate_set import FailedRun, Options, evaluate_all
from tractor_msgs_py.errors import RunAborted

Task = TypeVar("Task")


@dataclass(frozen=True)
class _Call:
    function: Callable[[Any], Any]
    task: Any


def do_all(
    function: Callable[[Task], Any],
    tasks: Sequence[Task],
    *,
    workers: int,
    progress: Callable[[int], None] = lambda done: None,
) -> list[Any]:
    """``function`` of every task, in order; a module's own function of plain data.

    Raises:
        KeyboardInterrupt: Ctrl-C; no process is left behind.
        RunAborted: a task's process was killed.
        TractorEmsError: what a task raised; other tasks under way are lost, finished ones are
            not.
    """
    # Batches here are small: a second BLAS thread would only take the other worker's core.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    calls = [_Call(function, task) for task in tasks]
    found = evaluate_all(
        cast(Any, calls), Options(), jobs=workers, progress=progress, make=cast(Any, _do)
    )
    for call, result in zip(calls, found, strict=True):
        if isinstance(result, FailedRun):
            raise RunAborted(f"study: {call.task}: {result.reason}")
    return list(found)


def _do(call: _Call, _options: Options) -> Any:
    return call.function(call.task)
