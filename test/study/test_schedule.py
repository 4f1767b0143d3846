"""Many runs at once: a killed worker and a Ctrl-C lose nothing that was finished."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from study.tiny import tiny

from tractor_ems.study.run import config_hash
from tractor_ems.study.schedule import run_all, workers_of
from tractor_ems.study.store import is_done
from tractor_ems.study.study import all_tasks
from tractor_msgs_py.errors import RunAborted

SCRIPT = """
import signal
import sys
from pathlib import Path
from study.tiny import tiny
from tractor_ems.study.schedule import run_all
from tractor_ems.study.study import all_tasks
from tractor_msgs_py.errors import RunAborted

def main():
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job has it ignored
    config = tiny("ddqn_shaped", episodes=100_000, seeds=2, actions=65)
    def progress(done, shares):
        if min(shares) > 0:
            print("both run", flush=True)
    try:
        run_all(config, all_tasks(config, Path(sys.argv[1])), workers=2, progress=progress)
    except RunAborted as error:
        print(error, flush=True)
        sys.exit(3)
    except KeyboardInterrupt:
        sys.exit(130)

if __name__ == "__main__":
    main()
"""


def started(tmp_path: Path) -> subprocess.Popen[str]:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    process = subprocess.Popen(
        [sys.executable, str(script), str(tmp_path / "out")],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    assert "both run" in process.stdout.readline()
    return process


def learning(process: psutil.Process) -> bool:
    """Still at work; a zombie only waits for its parent."""
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def test_every_run_is_done_and_found_again(tmp_path: Path) -> None:
    config = tiny("q", episodes=2, seeds=2, actions=65)
    tasks = all_tasks(config, tmp_path)
    heard = []
    run_all(config, tasks, workers=2, progress=lambda done, shares: heard.append(done))
    assert heard[-1] == 2
    for task in tasks:
        assert is_done(task.folder, config_hash(config, task.row, task.seed))


@pytest.mark.slow
def test_ctrl_c_leaves_a_checkpoint_of_every_running_agent(tmp_path: Path) -> None:
    process = started(tmp_path)
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(60) == 130
    left = list((tmp_path / "out").rglob("checkpoint.safetensors"))
    assert len(left) == 2
    assert not list((tmp_path / "out").rglob("result.json"))


@pytest.mark.slow
def test_a_killed_run_leaves_the_others_at_work(tmp_path: Path) -> None:
    process = started(tmp_path)
    children = psutil.Process(process.pid).children(recursive=True)
    runs = [child for child in children if child.ppid() != process.pid]  # forked by the server
    assert len(runs) == 2
    runs[0].kill()
    psutil.wait_procs([runs[0]], timeout=20)
    spent = sum(runs[1].cpu_times()[:2])
    time.sleep(3)
    assert learning(runs[1]) and sum(runs[1].cpu_times()[:2]) > spent
    os.killpg(process.pid, signal.SIGKILL)
    process.wait(20)


def test_failed_runs_are_named_after_all_others_were_tried(tmp_path: Path) -> None:
    config = tiny("ddqn_shaped_dp", episodes=1, seeds=2, actions=65)
    with pytest.raises(RunAborted, match=r"ddqn_shaped_dp@0\.836 seed 0: .*\(and 1 more\)"):
        run_all(config, all_tasks(config, tmp_path), workers=1)  # no bags were recorded


@pytest.mark.slow
def test_workers_end_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    process = started(tmp_path)
    children = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    process.wait(10)
    _, alive = psutil.wait_procs([c for c in children if learning(c)], timeout=20)
    assert not [child for child in alive if learning(child)]


def test_there_is_a_worker_per_core_unless_told_otherwise() -> None:
    assert workers_of(3) == 3
    assert 1 <= workers_of(None) <= (os.cpu_count() or 1)
