"""One run of the study: what a stop, a kill and a resume leave."""

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from study.tiny import row_of, tiny

from tractor_ems.study import run as study_run
from tractor_ems.study.config import StudyConfig
from tractor_ems.study.experts import demonstrations, plant, record
from tractor_ems.study.run import (
    Task,
    config_hash,
    drive_again,
    epsilon_schedule,
    execute,
    process_of,
)
from tractor_ems.study.store import is_done, load_run
from tractor_msgs_py.errors import ConfigError, RunAborted
from tractor_sim.duty_cycle.library import load_cycle

RESULT = ("result.json", "result.safetensors")


def task_of(config: StudyConfig, folder: Path, bags: Path | None = None) -> Task:
    return Task(config, row_of(config), 0, folder, bags or folder / "bags")


def result_bytes(folder: Path) -> list[bytes]:
    return [(folder / name).read_bytes() for name in RESULT]


def stop_after(pieces: int):
    asked = []

    def stop() -> bool:
        asked.append(True)
        return len(asked) >= pieces

    return stop


@pytest.mark.parametrize(
    "row",
    [
        pytest.param("ddqn_shaped", marks=pytest.mark.slow),
        pytest.param("dqn", marks=pytest.mark.slow),
        pytest.param("ddqn_soft_target", marks=pytest.mark.slow),
        pytest.param("ddqn_shaped_dp", marks=pytest.mark.slow),
        pytest.param("ddqn_shaped_dp_margin", marks=pytest.mark.slow),
        pytest.param("q", marks=pytest.mark.slow),
        "double_q",
        pytest.param("double_q_interpolated", marks=pytest.mark.slow),
    ],
)
def test_a_stopped_and_resumed_run_gives_the_same_bytes(row: str, tmp_path: Path) -> None:
    config = tiny(row, actions=65)
    for item in demonstrations(config, tmp_path / "bags"):
        record(item, config)
    bags = tmp_path / "bags"
    whole = task_of(config, tmp_path / "whole", bags)
    parts = task_of(config, tmp_path / "parts", bags)
    assert execute(whole) is not None
    assert execute(parts, stop=stop_after(1)) is None
    assert not (tmp_path / "parts" / "result.json").exists()
    assert execute(parts, stop=stop_after(2)) is None
    assert execute(parts) is not None
    assert result_bytes(tmp_path / "parts") == result_bytes(tmp_path / "whole")
    assert not (tmp_path / "parts" / "checkpoint.safetensors").exists()


KILLED = """
import os, signal, sys
from pathlib import Path
from study.test_run import task_of
from study.tiny import tiny
from tractor_ems.study import run
run.CHECKPOINT_EVERY_S = 0.0
pieces = []
def report(share):
    pieces.append(share)
    if len(pieces) == 3:
        os.kill(os.getpid(), signal.SIGKILL)
run.execute(task_of(tiny("ddqn_shaped", actions=65), Path(sys.argv[1])), report=report)
"""


@pytest.mark.slow
def test_a_killed_and_resumed_run_gives_the_same_bytes(tmp_path: Path) -> None:
    config = tiny("ddqn_shaped", actions=65)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    killed = subprocess.run(
        [sys.executable, "-c", KILLED, str(tmp_path / "killed")],
        env=environment,
        timeout=120,
        check=False,
    )
    assert killed.returncode == -signal.SIGKILL
    assert (tmp_path / "killed" / "checkpoint.safetensors").exists()
    execute(task_of(config, tmp_path / "killed"))
    execute(task_of(config, tmp_path / "whole"))
    assert result_bytes(tmp_path / "killed") == result_bytes(tmp_path / "whole")


def test_a_saved_run_is_read_back_as_it_was(tmp_path: Path) -> None:
    config = tiny("double_q", actions=65)
    task = task_of(config, tmp_path / "run")
    run = execute(task)
    assert run is not None and run.table is not None
    back = load_run(task.folder, task.row, run.config_hash)
    assert back.outcome.fuel_kg == run.outcome.fuel_kg
    assert back.table is not None
    np.testing.assert_array_equal(back.table.state_visits, run.table.state_visits)
    np.testing.assert_array_equal(back.curve.train_return, run.curve.train_return)
    assert is_done(task.folder, run.config_hash)
    assert not is_done(task.folder, "another")


def test_a_damaged_run_is_refused_by_name(tmp_path: Path) -> None:
    task = task_of(tiny("q", actions=65, episodes=1), tmp_path / "run")
    run = execute(task)
    assert run is not None
    with pytest.raises(ConfigError, match="config_hash is of another run"):
        load_run(task.folder, task.row, "another")
    (task.folder / "result.safetensors").write_bytes(b"cut short")
    with pytest.raises(ConfigError, match="run: damaged run"):
        load_run(task.folder, task.row, run.config_hash)


def test_a_checkpoint_of_other_settings_is_refused(tmp_path: Path) -> None:
    task = task_of(tiny("ddqn_shaped", actions=65), tmp_path / "run")
    execute(task, stop=stop_after(1))
    other = replace(task, seed=1)
    with pytest.raises(ConfigError, match="config_hash differs"):
        execute(other)


def test_seeds_of_a_run_decide_it_and_names_do_not(tmp_path: Path) -> None:
    config = tiny("ddqn_shaped")
    row = row_of(config)
    digest = config_hash(config, row, 0)
    assert config_hash(config, row, 1) != digest
    assert config_hash(config, replace(row, soc_min=0.75), 0) != digest
    slower = replace(config, budget=replace(config.budget, steps_per_update=9))
    assert config_hash(slower, row, 0) != digest
    renamed = replace(row, label="another label", role="ablation")
    assert config_hash(config, renamed, 0) == digest
    more_seeds = replace(config, budget=replace(config.budget, seeds=9))
    assert config_hash(more_seeds, row, 0) == digest, "seed 0 is the same run in a larger study"


@pytest.mark.slow
@pytest.mark.parametrize(("replay", "kept"), [("fifo", 0), ("kept", 2000)])
def test_seeds_are_overwritten_in_a_fifo_and_stay_where_they_are_kept(
    replay: str, kept: int, tmp_path: Path
) -> None:
    config = tiny("ddqn_shaped_dp", episodes=6, replay=replay, actions=65, mapping="p_batt_grid")
    config = replace(config, experts=replace(config.experts, dp_share=0.5))
    for item in demonstrations(config, tmp_path / "bags"):
        record(item, config)
    task = task_of(config, tmp_path / "run", tmp_path / "bags")
    run = execute(task)
    assert run is not None
    assert run.seeding["dp"]["seeded"] == 2000
    trainer = study_run._NetworkTrainer(task, process_of(task.config, task.row))
    before = trainer.agent.replay.columns["action"][:2000].copy()
    assert trainer.agent.demonstrations.size == kept
    assert trainer.agent.replay.size == 2000 - kept
    for episode in range(6):  # 765 driven transitions each into 4,000 places
        trainer.train(np.ones(1))
        still_there = np.array_equal(trainer.agent.replay.columns["action"][:2000], before)
        if not kept:
            assert still_there == (episode < 2), "driven ones fill the rest first, then overwrite"
    assert trainer.agent.demonstrations.size == kept


def test_a_greedy_episode_the_production_plant_drives_otherwise_is_a_bug(tmp_path: Path) -> None:
    config = tiny("ddqn_shaped", actions=65)
    task = task_of(config, tmp_path / "run")
    trainer = study_run._NetworkTrainer(task, process_of(task.config, task.row))
    greedy, params = trainer.greedy(), plant(config, task.row.soc_min)
    demand_w = load_cycle(config.cycle).power_demand_w
    drive_again(greedy, params, demand_w, config)
    wrong = greedy._replace(soc=greedy.soc + 1e-6)
    with pytest.raises(RunAborted, match="compiled plant"):
        drive_again(wrong, params, demand_w, config)


def test_exploration_falls_linearly_and_is_then_held() -> None:
    epsilon = epsilon_schedule(1.0, 0.05, 0.5, 100)
    assert epsilon[0] == 1.0
    assert epsilon[25] == pytest.approx(0.525)
    np.testing.assert_allclose(epsilon[50:], 0.05)
    assert np.all(epsilon_schedule(0.02, 0.05, 0.5, 10) == 0.02), "never rises"
