"""The held-out study: its settings, its pieces on disk, and all of it once with tiny budgets."""

import os

import numpy as np
import pytest
import yaml

from tractor_ems.policies.mlp import Mlp
from tractor_ems.policies.q_policy import Normalisation, demand_inputs
from tractor_ems.policies.run_or_stand import RunOrStand, prices_of
from tractor_ems.study import pieces
from tractor_ems.study.held_out import run_held_out
from tractor_ems.study.held_out_config import load_held_out
from tractor_ems.study.held_out_policies import refitted
from tractor_ems.study.held_out_record import scenario_of
from tractor_ems.study.held_out_report import write_report
from tractor_ems.study.held_out_results import read_results, results_of
from tractor_ems.study.held_out_score import scored
from tractor_msgs_py.errors import ConfigError, PolicyError, RunAborted
from tractor_msgs_py.observation import DemandFilter, ObservationSpec
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import cycle_names
from tractor_sim.resources import resource_path


def shipped():
    path = resource_path("config", "study") / "held_out.yaml"
    return yaml.safe_load(path.read_text())


def changed(tmp_path, **changes):
    """A settings file that differs from the shipped one; ``smoke`` updates that preset."""
    document = shipped()
    document["presets"]["smoke"].update(changes.pop("smoke", {}))
    document.update(changes)
    path = tmp_path / "study.yaml"
    path.write_text(yaml.safe_dump(document))
    return str(path)


def test_full_scores_the_whole_held_out_split_and_trains_on_none_of_it():
    config = load_held_out("held_out", "full")
    assert config.scored == cycle_names("held_out") and len(config.scored) == 65
    assert not set(config.training) & set(config.scored)
    assert config.budget.seeds >= 5


def test_smoke_touches_no_held_out_cycle():
    config = load_held_out("held_out", "smoke")
    used = {*config.scored, *config.training, *config.budget.dev, *config.transfer_training}
    assert not used & set(cycle_names("held_out"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"train_operations": ["rotary_hoe"]}, "rotary_hoe_1"),
        ({"smoke": {"train_cycles": ["loader_2001"]}}, "loader_2001 is held_out"),
        ({"smoke": {"dev": ["loader_2001"]}}, "dev cycle loader_2001"),
        ({"smoke": {"traces": ["whtc"]}}, "whtc is not among"),
        ({"subject": "nobody"}, "subject: 'nobody'"),
        ({"disturbances": [{"name": "a", "fuel": 99.0}]}, "fuel"),
        ({"disturbances": [{"name": "none"}]}, "disturbances"),
        ({"rules": ["sdp"]}, "a name twice"),
        ({"surprise": 1}, "surprise"),
        ({"bars": {**shipped()["bars"], "median": float("nan")}}, "bars.median"),
        ({"smoke": {"cycles": ["nowhere_1"]}}, "nowhere_1"),
        ({"smoke": {"train_seeds": [3, 1]}}, r"train_seeds: \[3, 1\]"),
        ({"recorders": ["nobody"]}, "recorders: 'nobody', allowed conventional"),
        ({"rules": [*shipped()["rules"], "nobody"]}, "rules: 'nobody'"),
        ({"powertrain": "nothing"}, "powertrain 'nothing'"),
        ({"vehicles": [{"powertrain": "nothing", "scale": 1.0}]}, "powertrain 'nothing'"),
        ({"learners": [{"name": "ddqn_counterfactual", "preset": "no"}]}, "preset 'no'"),
    ],
)
def test_settings_that_make_no_study_are_refused_by_name(tmp_path, change, message):
    with pytest.raises(ConfigError, match=message):
        load_held_out(changed(tmp_path, **change), "smoke")


def test_an_unknown_preset_is_refused_with_those_there_are():
    with pytest.raises(ConfigError, match="allowed full, smoke"):
        load_held_out("held_out", "huge")


def test_a_scaled_cycle_asks_for_its_share_and_has_a_name_of_its_own():
    plain, half = scenario_of("field", "planter"), scenario_of("field", "planter", 0.5)
    asked = half.cycle.power_demand_w / plain.cycle.power_demand_w
    assert asked == pytest.approx(0.5, rel=1e-4)
    assert half.cycle.name != plain.cycle.name


def test_a_run_that_beats_the_optimum_ends_the_study():
    row = {"policy": "a", "seed": 0, "cycle": "c", "shortfall_j": 0.0}
    assert scored(row, {"dp_ratio": 1.0004, "note": None}, 1.0005)["dp_ratio"] == 1.0004
    with pytest.raises(RunAborted, match="a seed 0 on c"):
        scored(row, {"dp_ratio": 1.0006, "note": None}, 1.0005)


def test_work_that_was_not_delivered_does_not_score():
    row = {"policy": "a", "seed": 0, "cycle": "c", "shortfall_j": 5.0}
    found = scored(row, {"dp_ratio": 1.2, "note": None}, 1.0005)
    assert found["dp_ratio"] is None and "5 J" in found["note"]


def test_a_piece_counts_for_its_key_only_and_whole(tmp_path):
    path = tmp_path / "piece.json"
    pieces.save_piece(path, "one", {"value": 3})
    assert pieces.load_piece(path, "one")["value"] == 3
    assert pieces.load_piece(path, "two") is None
    path.write_text(path.read_text()[:10])
    assert pieces.load_piece(path, "one") is None


def test_comments_change_no_digest_of_code_and_code_does(tmp_path, monkeypatch):
    def digest(text):
        (tmp_path / "m.py").write_text(text)
        pieces.code_digest.cache_clear()
        return pieces.code_digest("m.py")

    monkeypatch.setattr(pieces, "ROOT", tmp_path)
    plain = digest("def f():\n    return 1\n")
    assert digest('"""Doc."""\ndef f():\n    """Doc."""\n    return 1  # why\n') == plain
    assert digest("def f():\n    return 2\n") != plain
    pieces.code_digest.cache_clear()


def run_or_stand(params, spec, scaling):
    """A policy whose network says nothing, of however many inputs it has to have."""
    for inputs in range(3, 20):
        net = Mlp((np.zeros((2, inputs), np.float32),), (np.zeros(2, np.float32),), "tanh")
        try:
            return RunOrStand(params, spec, (net,), scaling, prices_of(params, 1.0, 0.0))
        except PolicyError:
            continue
    raise AssertionError("no number of inputs fits")


def test_a_refitted_policy_sees_the_same_in_units_of_the_new_vehicle():
    field, small = load_powertrain("field"), load_powertrain("utility_150kw")
    share = small.engine.power_max_w / field.engine.power_max_w
    scaling = Normalisation(60e3, 50e3)
    spec = ObservationSpec(dt_s=1.0, filters=(DemandFilter("running_mean", 120.0, 60e3),))
    made = refitted(run_or_stand(field, spec, scaling), small)
    demand_w, slow_w = np.array([90e3]), np.array([[70e3]])
    np.testing.assert_allclose(
        demand_inputs(made.scaling, share * demand_w, share * slow_w),
        demand_inputs(scaling, demand_w, slow_w),
        rtol=1e-5,
    )
    assert made.spec.filters[0].prior_w == pytest.approx(share * 60e3)
    assert made.prices.soc_kg == pytest.approx(prices_of(small, 1.0, 0.0).soc_kg)
    assert made.params == small and made.prices.start_kg == small.engine.start_fuel_kg


@pytest.mark.slow
def test_all_of_it_once_goes_on_from_its_pieces_and_is_told_again_from_its_data(tmp_path):
    settings = changed(
        tmp_path,
        train_operations=["planter"],
        vehicles=[{"powertrain": "utility_150kw", "scale": 0.5}],
        disturbances=[{"name": "delay_1", "delay_steps": 1}, {"name": "weak", "capacity": 0.8}],
        smoke={"cycles": ["nrtc_1_256"], "updates": 4, "resamples": 50},
    )
    config, out = load_held_out(settings, "smoke"), tmp_path / "out"

    def study():
        stages = []

        def stage(name, jobs):
            stages.append((name, jobs))
            return lambda done: None

        return results_of(run_held_out(config, out, workers=1, stage=stage)), stages

    results, stages = study()
    names = {name for name, _ in stages}
    assert {"record", "train", "drive", "score", "disturb", "score other vehicles"} <= names
    assert set(results["policies"]) == set(config.settings.names)
    assert all(found["violations"] == 0 for found in results["policies"].values())
    assert set(results["robustness"]["sdp"]) == {"delay_1", "weak"}
    assert {row["way"] for row in results["transfer"]} == {
        "as it is", "right plant model", "trained anew", "rule"
    }  # fmt: skip
    assert len(results["curve"]) == 2

    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    os.unlink(out / "drives" / "sdp.json")
    again, _ = study()
    assert again == results
    after = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    assert {path for path in after if after[path] != before[path]} == {out / "drives" / "sdp.json"}

    data = write_report(results, tmp_path / "held_out.md")
    assert "its figures mean nothing" in (tmp_path / "held_out.md").read_text()
    assert read_results(data)["verdicts"] == results["verdicts"]
