"""Many runs on all cores: a process per worker, finished runs kept, one stop flag for all.

Workers leave a checkpoint and end when asked to stop. A worker that is killed takes its own piece
of work with it and nothing else; the next call goes on from what is on disk.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing.connection import wait as wait_for
from typing import Any, TypeAlias

from tractor_ems.study.config import StudyConfig
from tractor_ems.study.experts import Demonstration, record
from tractor_ems.study.run import Task, execute
from tractor_msgs_py.errors import RunAborted

POLL_S = 0.5

Progress: TypeAlias = Callable[[int, Sequence[float]], None]
"""Called with the jobs done and the shares, 0..1, of all jobs."""

_shared: dict[str, Any] = {}
"""What a worker was given at its start: the stop flag and everybody's progress."""


def workers_of(requested: int | None) -> int:
    """As many as asked for; None: one per core that this process may use."""
    if requested is not None:
        return requested
    return (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )


def run_all(
    config: StudyConfig,
    work: Sequence[Demonstration | Task],
    *,
    workers: int,
    progress: Progress = lambda done, shares: None,
) -> None:
    """Do all of ``work``; what is already on disk is quick.

    Raises:
        KeyboardInterrupt: Ctrl-C, after every worker has left its checkpoint.
        RunAborted: a worker was killed, or a run diverged; what is finished stays.
    """
    if not work:
        return
    context = multiprocessing.get_context("spawn")
    stop, shares = context.Event(), context.Array("d", len(work))
    pool = ProcessPoolExecutor(
        workers, mp_context=context, initializer=_begin, initargs=(stop, shares)
    )
    try:
        pending = {pool.submit(_do, config, item, n) for n, item in enumerate(work)}
        count = 0
        while pending:
            done, pending = wait(pending, timeout=POLL_S, return_when=FIRST_COMPLETED)
            for future in done:
                future.result()
                count += 1
            progress(count, shares[:])
    except BrokenProcessPool:
        raise RunAborted(
            "study: a worker process was killed (out of memory?); the same command goes on from "
            "what is finished"
        ) from None
    finally:
        stop.set()
        pool.shutdown(wait=True, cancel_futures=True)


def _begin(stop: Any, shares: Any) -> None:
    """In every worker: Ctrl-C is the parent's business, which then sets the flag."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _shared.update(stop=stop, shares=shares)


def _end_with_parent() -> None:
    """A worker whose parent was killed would go on for hours; its last checkpoint stays."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait_for([parent.sentinel])
    os._exit(1)


def _do(config: StudyConfig, item: Demonstration | Task, number: int) -> None:
    stop, shares = _shared["stop"], _shared["shares"]
    if stop.is_set():
        return
    if isinstance(item, Demonstration):
        record(item, config)
    else:
        execute(item, report=partial(_share, shares, number), stop=stop.is_set)
    shares[number] = 1.0


def _share(shares: Any, number: int, share: float) -> None:
    shares[number] = share
