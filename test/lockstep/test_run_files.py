"""A finished run on disk reads back bit for bit, and only a whole one reads back."""

import json
import math

import pytest

from tractor_msgs_py.errors import ConfigError, RunAborted
from tractor_msgs_py.trajectory import trajectory_hash
from tractor_msgs_py.types import BatteryPowerCommand
from tractor_sim.run_files import clear_run, line_of, read_run, summary, write_run


@pytest.fixture
def finished(make_run):
    run = make_run()
    while not run.done:
        battery_w = math.nan if run.k == 2 else run.power_demand_w[run.k] / 3.0
        run.apply(BatteryPowerCommand(run.stamp_ns, battery_w))
    return run


@pytest.fixture
def folder(finished, tmp_path):
    write_run(tmp_path / "run", finished.trajectory(), summary(finished, {"resends": 0}))
    return tmp_path / "run"


def test_run_reads_back_to_the_same_hash_and_numbers(finished, folder):
    trajectory, result = read_run(folder)
    assert trajectory_hash(trajectory) == trajectory_hash(finished.trajectory())
    assert trajectory.soc_final == finished.trajectory().soc_final
    assert result == json.loads((folder / "result.json").read_text())
    assert sorted(p.name for p in folder.iterdir()) == ["result.json", "trajectory.csv"]


def test_summary_counts_fuel_work_and_starts(finished):
    result, trajectory = summary(finished, {}), finished.trajectory()
    fuel_j = trajectory.fuel_kg.sum() * 42.8e6
    assert result["efficiency"] == pytest.approx(trajectory.engine_power_w.sum() / fuel_j)
    assert result["engine_starts"] == 1 and result["steps"] == 6
    assert "efficiency" in line_of(result) and "\n" not in line_of(result)


def test_a_run_without_fuel_has_no_efficiency(make_run):
    run = make_run()
    while not run.done:
        run.apply(BatteryPowerCommand(run.stamp_ns, 0.0, 0.0))
    result = summary(run, {})
    assert result["efficiency"] is None and "no fuel burnt" in line_of(result)


def test_a_cut_or_altered_trajectory_is_refused(folder):
    table = folder / "trajectory.csv"
    whole = table.read_text()
    for broken in (whole[: len(whole) // 2], whole.replace("150000.0", "150001.0"), ""):
        assert broken != whole
        table.write_text(broken)
        with pytest.raises(RunAborted, match="no readable result"):
            read_run(folder)


def test_a_run_that_never_finished_is_refused(tmp_path):
    with pytest.raises(RunAborted, match="no readable result"):
        read_run(tmp_path)


def test_a_new_run_does_not_leave_the_result_of_the_last_one(folder):
    (folder / "notes.txt").write_text("mine")
    clear_run(folder)
    assert [path.name for path in folder.iterdir()] == ["notes.txt"]
    with pytest.raises(RunAborted, match="no readable result"):
        read_run(folder)


def test_a_folder_that_cannot_take_a_result_is_bad_input_at_the_start(tmp_path):
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file", tmp_path / "file" / "run"):
        with pytest.raises(ConfigError, match="no place for a result"):
            clear_run(place)


def test_a_folder_lost_during_the_run_aborts_it(finished, folder):
    (folder / "trajectory.csv").unlink()
    (folder / "trajectory.csv").mkdir()
    with pytest.raises(RunAborted, match=r"trajectory.csv: cannot be written"):
        write_run(folder, finished.trajectory(), summary(finished, {}))
