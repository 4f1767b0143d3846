"""Many runs on all cores: a process per run, finished runs kept, one stop flag for all.

A run that is killed or diverges takes nothing else with it: the others are finished first. The
same call goes on from what is on disk, checkpoints included.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.connection import wait as wait_for
from types import FrameType
from typing import Any, TypeAlias, cast

from tractor_ems.study.config import StudyConfig
from tractor_ems.study.experts import Demonstration, record
from tractor_ems.study.run import Task, execute
from tractor_msgs_py.errors import RunAborted, TractorEmsError

POLL_S = 0.5

Progress: TypeAlias = Callable[[int, Sequence[float]], None]
"""Called with the jobs done and the shares, 0..1, of all jobs."""

Work: TypeAlias = "Demonstration | Task"


def workers_of(requested: int | None) -> int:
    """As many as asked for; None: one per core that this process may use."""
    if requested is not None:
        return requested
    return (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )


def run_all(
    config: StudyConfig,
    work: Sequence[Work],
    *,
    workers: int,
    progress: Progress = lambda done, shares: None,
) -> None:
    """Do all of ``work``; what is already on disk is quick.

    Raises:
        KeyboardInterrupt: Ctrl-C or SIGTERM, after every run has left its checkpoint.
        RunAborted: runs were killed, diverged or failed; the first is named, all others are done.
    """
    # A server that has imported everything forks a fresh process per run in milliseconds.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    # Without locks: a process that is killed while it holds one would hang all others.
    stop, shares = context.RawValue("b", 0), context.RawArray("d", max(len(work), 1))
    waiting = list(range(len(work)))[::-1]
    running: dict[int, tuple[int, Any, Connection]] = {}
    failed: list[str] = []
    done = 0
    with _interruptible():
        try:
            while waiting or running:
                while waiting and len(running) < workers:
                    number = waiting.pop()
                    ours, theirs = context.Pipe(duplex=False)
                    process = context.Process(
                        target=_do, args=(config, work[number], number, stop, shares, theirs)
                    )
                    process.start()
                    theirs.close()
                    running[process.sentinel] = (number, process, ours)
                for sentinel in wait_for(list(running), timeout=POLL_S):
                    number, process, ours = running.pop(cast(int, sentinel))
                    process.join()
                    failed += _failure(work[number], process.exitcode, ours)
                    done += 1
                progress(done, shares[: len(work)])
        finally:
            stop.value = 1
            for _, process, _ in running.values():
                process.join()
    if failed:
        more = f" (and {len(failed) - 1} more)" if len(failed) > 1 else ""
        raise RunAborted(f"study: {failed[0]}{more}; the same command goes on from what is done")


def _failure(item: Work, exit_code: int | None, ours: Connection) -> list[str]:
    """What went wrong, if anything: as the run says, or else by its exit code."""
    message = ""
    if ours.poll():
        try:
            message = ours.recv_bytes().decode()
        except EOFError:
            pass
    ours.close()
    if exit_code == 0:
        return []
    name = item.bag.name if isinstance(item, Demonstration) else f"{item.row.key} seed {item.seed}"
    return [f"{name}: {message or f'its process ended with {exit_code} (out of memory?)'}"]


@contextmanager
def _interruptible() -> Iterator[None]:
    """SIGTERM as Ctrl-C: both leave checkpoints."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _do(
    config: StudyConfig, item: Work, number: int, stop: Any, shares: Any, report: Connection
) -> None:
    """In a process of its own. Ctrl-C is the parent's business, which then sets the flag."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        if stop.value:
            return
        if isinstance(item, Demonstration):
            record(item, config)
        else:
            execute(item, report=partial(_share, shares, number), stop=lambda: bool(stop.value))
        shares[number] = 0.0 if stop.value else 1.0
    except TractorEmsError as error:
        report.send_bytes(str(error).encode())
        raise SystemExit(error.exit_code) from None


def _share(shares: Any, number: int, share: float) -> None:
    shares[number] = share


def _end_with_parent() -> None:
    """A run whose parent was killed would go on for hours; its last checkpoint stays."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait_for([parent.sentinel])
    os._exit(1)
