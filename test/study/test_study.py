"""The study from settings to results, cut down to one row."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from study.tiny import tiny

from tractor_ems.study.config import load_study
from tractor_ems.study.study import all_tasks, collect, run_study
from tractor_msgs_py.errors import ConfigError


def quiet(name: str, jobs: int):
    return lambda done, shares: None


def without_baselines(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half a minute of dynamic programming that other tests hold."""
    monkeypatch.setattr("tractor_ems.study.study.make_baselines", lambda *args, **kwargs: ())


@pytest.mark.slow
def test_a_study_counts_its_sittings_and_a_second_call_trains_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_baselines(monkeypatch)
    config = tiny("ddqn_shaped_dp", episodes=2, seeds=2, actions=65)
    results = run_study(config, tmp_path, workers=2, stage=quiet)
    assert [run.seed for run in results.runs] == [0, 1]
    assert results.runs[0].seeding["dp"]["seeded"] == 1000
    assert results.provenance["sittings"] == 1
    heard: list[tuple[str, int]] = []

    def stage(name: str, jobs: int):
        heard.append((name, jobs))
        return quiet(name, jobs)

    again = run_study(config, tmp_path, workers=2, stage=stage)
    assert heard == [("recording experts", 0), ("training agents", 0)]
    assert again.provenance["sittings"] == 1, "reading results is no sitting"
    assert again.provenance["wall_s_all_sittings"] == results.provenance["wall_s_all_sittings"]
    one, other = results.runs[0].outcome, again.runs[0].outcome
    assert (one.fuel_kg, one.dp_ratio) == (other.fuel_kg, other.dp_ratio)


@pytest.mark.slow
def test_more_seeds_train_only_the_new_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_baselines(monkeypatch)
    config = tiny("q", episodes=2, seeds=1, actions=65)
    run_study(config, tmp_path, workers=1, stage=quiet)
    more = replace(config, budget=replace(config.budget, seeds=2))
    heard: list[int] = []

    def stage(name: str, jobs: int):
        heard.append(jobs)
        return quiet(name, jobs)

    assert len(run_study(more, tmp_path, workers=1, stage=stage).runs) == 2
    assert heard == [0, 1]


def test_ablations_may_have_fewer_seeds_and_are_run_last_seed_by_seed(tmp_path: Path) -> None:
    config = load_study("paper", "standard")
    config = replace(config, budget=replace(config.budget, ablation_seeds=3))
    tasks = all_tasks(config, tmp_path)
    roles = [task.row.role for task in tasks if not task.row.tabular]
    assert roles == sorted(roles, reverse=True), "what the paper reports comes first"
    ablations = [task for task in tasks if task.row.role == "ablation"]
    assert {task.seed for task in ablations} == {0, 1, 2}
    networks = [task.seed for task in ablations if not task.row.tabular]
    assert networks == sorted(networks)
    assert {task.seed for task in tasks if task.row.role == "paper"} == set(range(5))


def test_a_missing_run_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"q@0\.7-0-.*result\.json: cannot be read"):
        collect(tiny("q", episodes=2, actions=65), tmp_path)


@pytest.mark.parametrize("below", ["", "study", "bags"])
def test_a_folder_that_cannot_be_is_refused_before_any_work(below: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    blocked = out if below in ("", "study") else out / below
    blocked.parent.mkdir(parents=True, exist_ok=True)
    blocked.write_text("a file")
    with pytest.raises(ConfigError, match="cannot be written"):
        run_study(tiny("q"), out / below if below == "study" else out, workers=1, stage=quiet)


@pytest.mark.slow
def test_sittings_that_are_damaged_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_baselines(monkeypatch)
    config = tiny("q", episodes=1, actions=65)
    run_study(config, tmp_path, workers=1, stage=quiet)
    assert json.loads((tmp_path / "sittings.json").read_text())[0]["preset"] == "smoke"
    (tmp_path / "sittings.json").write_text("{")
    with pytest.raises(ConfigError, match=r"sittings\.json: cannot be read"):
        collect(config, tmp_path)
