"""The search: what may be searched, what counts as best, and that it says so in its log."""

import json
from pathlib import Path

import numpy as np
import pytest

from tractor_ems.cli import main
from tractor_ems.policies import baselines
from tractor_ems.tuning import grid_search
from tractor_ems.tuning.chosen_report import chosen_json, page, settings_yaml
from tractor_ems.tuning.closed_loop import FUEL, SHORTFALL, SOC_FINAL, STARTS
from tractor_ems.tuning.grid import combinations, load_grid
from tractor_ems.tuning.grid_search import search
from tractor_msgs_py.errors import ConfigError, CycleError
from tractor_sim.config import load_powertrain

ROOT = Path(__file__).resolve().parents[2]
FIELD = load_powertrain("field")
TINY = """
dev: {operations: [], seeds: [1, 1], others: [planter_1001, planter_1002]}
train: {operations: [], seeds: [1, 1], others: [planter]}
squeezed: {operations: [planter], seeds: [1001, 1001], seed: 1}
soc_mean: 0.03
soc_max: 0.05
presets:
  full:
    policies:
      a_ecms: {equivalence: [2.36, 2.40], stiffen_s: [0, 50]}
"""


@pytest.fixture
def grid_of(tmp_path):
    """A grid from the tiny file with a change."""

    def made(old="", new=""):
        assert old in TINY
        path = tmp_path / "grid.yaml"
        path.write_text(TINY.replace(old, new) if old else TINY)
        return load_grid(FIELD, path)

    return made


@pytest.fixture
def driven(monkeypatch):
    """Drives that cost nothing: a table of (SOC error, fuel, shortfall) by setting."""
    outcomes = {}

    def drive(task):
        totals = np.zeros((len(task.demands_w), 9))
        key = (task.settings["equivalence"], task.settings["stiffen_s"])
        error, fuel_kg, short_j = outcomes.get(key, (0.0, 11.0, 0.0))
        totals[:, SOC_FINAL], totals[:, FUEL] = task.soc + error, fuel_kg
        totals[0, SHORTFALL], totals[:, STARTS] = short_j, 2
        return totals

    monkeypatch.setattr(grid_search, "_drive", drive)
    monkeypatch.setattr(grid_search, "_score", lambda task: [10.0] * len(task.ends))
    return outcomes


def test_the_last_axis_runs_fastest():
    found = combinations({"a": [1, 2], "b": [3, 4]})
    assert found == [{"a": 1, "b": 3}, {"a": 1, "b": 4}, {"a": 2, "b": 3}, {"a": 2, "b": 4}]


def test_a_grid_of_millions_is_refused():
    with pytest.raises(ConfigError, match="combinations"):
        combinations({name: list(range(50)) for name in "abc"})


def test_the_grid_that_ships_can_be_made():
    grid = load_grid(FIELD)
    assert {"smoke", "full"} <= set(grid.presets)
    assert len(grid.dev.names) == 33
    assert set(grid.preset("full").policies) == {*baselines.BASELINES, *baselines.TUNED_ONLY}


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("a_ecms:", "b_ecms:", "policies.b_ecms: unknown"),
        ("stiffen_s: [0, 50]", "stiffen: [1]", "stiffen: unknown"),
        ("stiffen_s: [0, 50]", "stiffen_s: [-1]", "stiffen_s: -1"),
        ("stiffen_s: [0, 50]", "stiffen_s: []", "stiffen_s"),
        ("soc_max: 0.05", "soc_max: 5", "soc_max"),
        ("soc_max: 0.05", "soc_max: 0.05\nbars: 1", "bars"),
        ("a_ecms: {equivalence", "sdp: {price: [dear], equivalence", "price: 'dear'"),
    ],
)
def test_a_bad_grid_is_refused_by_name(grid_of, old, new, named):
    with pytest.raises(ConfigError, match=r"grid\.yaml") as raised:
        grid_of(old, new)
    assert named in str(raised.value)


def test_a_held_out_cycle_is_refused(grid_of):
    with pytest.raises(CycleError, match="held-out"):
        grid_of("planter_1002", "loader_2001")


def test_the_best_median_wins_among_those_that_hold_the_bars(grid_of, driven, tmp_path):
    driven[2.36, 0] = (0.06, 10.1, 0.0)  # least fuel, but SOC ends too far
    driven[2.36, 50] = (0.0, 10.2, 9.0)  # demand left unmet
    driven[2.40, 50] = (-0.02, 10.5, 0.0)
    grid = grid_of()
    found = search(FIELD, grid, grid.preset("full"), tmp_path)["a_ecms"]
    assert found.dev.settings == {"equivalence": 2.40, "stiffen_s": 50}
    assert found.dev.summary()["median"] == pytest.approx(10.0 / 10.5, abs=1e-5)
    assert (found.feasible, found.tried) == (2, 4)


def test_where_none_holds_the_bars_the_least_miss_wins(grid_of, driven, tmp_path):
    driven[2.36, 0] = (0.07, 10.1, 0.0)
    driven[2.36, 50] = (0.06, 10.4, 0.0)
    driven[2.40, 0] = driven[2.40, 50] = (0.0, 10.0, 9.0)
    grid = grid_of()
    found = search(FIELD, grid, grid.preset("full"), tmp_path)["a_ecms"]
    assert found.dev.settings == {"equivalence": 2.36, "stiffen_s": 50}
    assert found.feasible == 0


def test_the_log_holds_every_setting_and_cycle_and_is_the_same_again(grid_of, driven, tmp_path):
    driven[2.40, 50] = (-0.02, 10.5, 0.0)
    grid = grid_of()
    search(FIELD, grid, grid.preset("full"), tmp_path / "a")
    search(FIELD, grid, grid.preset("full"), tmp_path / "b")
    text = (tmp_path / "a" / "a_ecms.jsonl").read_text()
    assert text == (tmp_path / "b" / "a_ecms.jsonl").read_text()
    head, *lines = (json.loads(line) for line in text.splitlines())
    assert head["cycles"] == ["planter_1001", "planter_1002"]
    assert [line["settings"] for line in lines] == combinations(
        grid.preset("full").policies["a_ecms"]
    )
    assert lines[3]["dp_ratio"] == [pytest.approx(10.0 / 10.5, abs=1e-5)] * 2


def test_what_is_chosen_is_what_policies_read(grid_of, driven, tmp_path):
    grid = grid_of()
    found = search(FIELD, grid, grid.preset("full"), tmp_path)
    path = tmp_path / "field.yaml"
    path.write_text(settings_yaml(FIELD, chosen_json(grid, found)))
    assert baselines.read_tuned(path)["a_ecms"] == found["a_ecms"].dev.settings
    text = page(FIELD, grid, grid.preset("full"), chosen_json(grid, found), "ems tune baselines")
    assert "| a_ecms | 0.9091 | 0.9091 | 0.9091 | 4 | 0.0 | 0.0 | 0 | held |" in text


def test_a_policy_outside_the_preset_is_refused(capsys, tmp_path):
    code = main(["tune", "baselines", "--policy", "dp", "--out", str(tmp_path)])
    assert code == 2 and "--policy: 'dp'" in capsys.readouterr().err


def test_what_ships_for_field_is_the_best_of_the_committed_log():
    path = baselines.tuned_path(FIELD)
    assert path is not None
    grid = load_grid(FIELD)
    for name, settings in baselines.read_tuned(path).items():
        log = ROOT / "docs" / "data" / "tuning" / f"{name}.jsonl"
        head, *lines = (json.loads(line) for line in log.read_text().splitlines())
        assert head["cycles"] == list(grid.dev.names)

        def rank(line):
            beyond = max(line["soc_mean"] - grid.soc_mean, 0.0)
            beyond += max(line["soc_max"] - grid.soc_max, 0.0)
            return line["short"], round(beyond, 4), -line.get("median", 0.0)

        best = min(rank(line) for line in lines)
        (chosen,) = (line for line in lines if line["settings"] == settings)
        assert rank(chosen) == pytest.approx(best, abs=2e-4), name


@pytest.mark.slow
def test_two_workers_find_what_one_does(grid_of, tmp_path):
    grid = grid_of("equivalence: [2.36, 2.40], stiffen_s: [0, 50]", "equivalence: [2.36, 2.40]")
    for workers in (1, 2):
        search(FIELD, grid, grid.preset("full"), tmp_path / str(workers), workers=workers)
    one, two = ((tmp_path / str(n) / "a_ecms.jsonl").read_bytes() for n in (1, 2))
    assert one == two
    ratios = [r for line in one.splitlines()[1:] for r in json.loads(line).get("dp_ratio", [])]
    assert ratios and 0.9 < max(ratios) <= 1.0005
