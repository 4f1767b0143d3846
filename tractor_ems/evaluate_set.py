"""Many runs on all cores: every policy over every cycle, rows in the order they were asked for.

A run that fails, or takes its process with it, is a row that says so; none is dropped.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, fields
from multiprocessing.connection import Connection
from typing import Any, TypeAlias

from tractor_ems.evaluate import evaluate
from tractor_ems.result import UNSEEN, Result, Transport
from tractor_ems.scenario import Scenario
from tractor_msgs_py.errors import TractorEmsError


@dataclass(frozen=True)
class Run:
    """One run to make: a policy by name or file, and what it drives."""

    policy: str
    scenario: Scenario


@dataclass(frozen=True)
class FailedRun:
    """A run that could not be made, in place of its result."""

    run: Run
    reason: str

    def to_json(self) -> dict[str, Any]:
        """The keys of a result: names are filled in, figures are None, ``dp_note`` says why."""
        cycle = self.run.scenario.cycle
        return dict.fromkeys((field.name for field in fields(Result)), None) | {
            "policy": self.run.policy,
            "cycle": cycle.name,
            "operation": cycle.operation,
            "split": cycle.split,
            "powertrain": self.run.scenario.params.name,
            "held_out": cycle.split in UNSEEN,
            "dp_note": f"not driven: {self.reason}",
        }

    def __str__(self) -> str:
        return f"{self.run.policy} on {self.run.scenario.cycle.name}: {self.reason}"


@dataclass(frozen=True)
class Options:
    """How every run is made, see ``tractor_ems.evaluate.evaluate``."""

    transport: Transport = "in_process"
    allow_other_powertrain: bool = False
    soc_guard: bool = True
    with_dp: bool = True


Row: TypeAlias = Result | FailedRun
Make: TypeAlias = Callable[[Run, Options], Row]


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def pairs(policies: Sequence[str], scenarios: Sequence[Scenario]) -> list[Run]:
    """Every policy over every cycle: all policies of the first cycle, then of the second."""
    return [Run(policy, scenario) for scenario in scenarios for policy in policies]


def evaluate_all(
    runs: Sequence[Run],
    options: Options,
    *,
    jobs: int,
    progress: Callable[[int], None] = lambda done: None,
    make: Make | None = None,
) -> list[Row]:
    """Make all runs.

    Args:
        runs: what to drive; their order is the order of the rows.
        options: for all of them.
        jobs: processes, >= 1; 1 makes the runs in this process. Runs through ROS nodes are
            processes already and are made one after the other, whatever ``jobs`` says.
        progress: called with the number of runs done.
        make: makes one run, :func:`make_run` unless told otherwise; a module's own function.

    Raises:
        KeyboardInterrupt: Ctrl-C; no process is left behind.
    """
    make = make or make_run
    if min(jobs, len(runs)) <= 1 or options.transport == "ros":
        rows: list[Row] = []
        for run in runs:
            rows.append(make(run, options))
            progress(len(rows))
        return rows
    made: dict[int, Row] = {}

    def keep(number: int, row: Row) -> None:
        made[number] = row
        progress(len(made))

    def do(run: Run) -> Callable[[ProcessPoolExecutor], Future[Row]]:
        return lambda pool: pool.submit(make, run, options)

    tasks = {number: do(run) for number, run in enumerate(runs)}
    waiting = list(tasks)[::-1]
    while waiting:
        suspects = _in_pool(tasks, min(jobs, len(waiting)), waiting, keep)
        for number in suspects:  # one of them killed the pool: each gets a process of its own
            if _in_pool(tasks, 1, [number], keep):
                keep(number, FailedRun(runs[number], "its process was killed (out of memory?)"))
    return [made[number] for number in range(len(runs))]


def _in_pool(
    tasks: Mapping[int, Callable[[ProcessPoolExecutor], Future[Row]]],
    jobs: int,
    waiting: list[int],
    keep: Callable[[int, Row], None],
) -> list[int]:
    """Do tasks of ``waiting``, its end first, which shrinks; returns those that were under way
    when a process of the pool died."""
    under_way: dict[Future[Row], int] = {}
    with _pool(jobs) as pool:
        try:
            while waiting or under_way:
                while waiting and len(under_way) < jobs:
                    under_way[tasks[waiting[-1]](pool)] = waiting[-1]
                    waiting.pop()
                for future in wait(under_way, return_when=FIRST_COMPLETED).done:
                    keep(under_way[future], future.result())
                    del under_way[future]
        except BrokenProcessPool:
            pass
    return sorted(under_way.values())


def make_run(run: Run, options: Options) -> Row:
    """One run; whatever it raises is its row."""
    try:
        return evaluate(
            run.policy,
            run.scenario,
            transport=options.transport,
            allow_other_powertrain=options.allow_other_powertrain,
            soc_guard=options.soc_guard,
            with_dp=options.with_dp,
        )[0]
    except TractorEmsError as error:
        return FailedRun(run, " ".join(str(error).split()))
    except Exception as error:
        return FailedRun(run, " ".join(f"{type(error).__name__}: {error}".split()))


@contextmanager
def _pool(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """Workers that end at once when this process leaves the block, for whatever reason."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    theirs, ours = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(jobs, context, initializer=_begin, initargs=(theirs,))
    try:
        yield pool
    except BaseException:
        ours.close()  # the workers see the end of the pipe, also where this process was killed
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        ours.close()
        theirs.close()


def _begin(parent: Connection) -> None:
    """In a worker. Ctrl-C is the parent's business, which then ends the workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: Connection) -> None:
    try:
        parent.recv_bytes()
    except (EOFError, OSError):
        pass
    os._exit(1)
