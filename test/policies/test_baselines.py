"""Baselines by name: what a name fixes, what a file tunes, what is refused."""

import math

import numpy as np
import pytest
from policies.work import FIELD, HEAVY, MEDIUM, driven

from tractor_ems.policies import baselines
from tractor_ems.policies.baselines import BASELINES, make_baseline, read_tuned
from tractor_ems.policies.registry import make_rule
from tractor_msgs_py.errors import ConfigError, PolicyError
from tractor_sim.config import load_powertrain


@pytest.fixture
def tuned_file(tmp_path, monkeypatch):
    """A file in place of config/baseline/field.yaml."""
    folder = tmp_path / "config" / "baseline"
    folder.mkdir(parents=True)
    monkeypatch.setattr(baselines, "share_dir", lambda: tmp_path)
    return folder / "field.yaml"


def test_settings_come_from_the_file_of_the_powertrain(tuned_file):
    tuned_file.write_text("policies:\n  a_ecms: {equivalence: 2.5, stiffen_s: 7}\n")
    policy = make_rule("a_ecms", FIELD)
    assert (policy.equivalence, policy.stiffen_s, policy.name) == (2.5, 7.0, "a_ecms")
    assert make_rule("a_ecms_unplanned", FIELD).stiffen_s == 0.0
    assert make_rule("a_ecms", load_powertrain("utility_150kw")).equivalence == 2.40


def test_a_changed_powertrain_has_the_settings_of_the_one_it_was(tuned_file):
    tuned_file.write_text("policies:\n  ecms: {equivalence: 2.5}\n")
    changed = load_powertrain("field:engine.start_fuel_kg=0.06")
    assert make_rule("ecms", changed).equivalence == 2.5


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("policies: {a_ecms: {gain: 1}}", "policies.a_ecms.gain: unknown"),
        ("policies: {a_ecms: {soc_gain: .nan}}", "policies.a_ecms.soc_gain: nan"),
        ("policies: {a_ecms: {soc_gain: high}}", "policies.a_ecms.soc_gain: 'high'"),
        ("policies: {ecms: {write_off_s: 60}}", "policies.ecms.write_off_s: unknown"),
        ("policies: {best: {}}", "policies.best: unknown"),
        ("policies: 3", "no `policies`"),
        ("[]", "no `policies`"),
    ],
)
def test_a_damaged_file_is_refused_by_name(tuned_file, text, named):
    tuned_file.write_text(text)
    with pytest.raises(ConfigError, match=r"field\.yaml") as raised:
        make_rule("a_ecms", FIELD)
    assert named in str(raised.value)


def test_what_ships_for_field_can_be_read_and_made():
    path = baselines.tuned_path(FIELD)
    assert path is None or read_tuned(path)
    for name in BASELINES:
        assert make_rule(name, FIELD).name == name


def test_the_classic_ecms_counts_no_start_and_decides_on_present_demand():
    policy = make_baseline("ecms", FIELD, {})
    assert math.isinf(policy.write_off_s) and not policy.spec.filters


def test_an_unknown_baseline_is_refused():
    with pytest.raises(PolicyError, match="best"):
        make_baseline("best", FIELD)


@pytest.mark.slow
def test_a_planned_end_brings_soc_to_its_target_and_leaves_it_free_before():
    settings = {"equivalence": 2.4, "soc_gain": 0.0}
    soc = np.array([0.50, 0.60])
    work = np.tile(HEAVY, (2, 1))
    planned = driven(make_baseline("a_ecms", FIELD, {**settings, "stiffen_s": 110.0}), work, soc)
    free = driven(make_baseline("a_ecms_unplanned", FIELD, settings), work, soc)
    for start, run, loose in zip(soc, planned, free, strict=True):
        assert abs(run.soc_final - 0.55) < 0.01 < abs(loose.soc_final - 0.55)
        assert abs(run.soc[len(run.soc) // 4] - start) < 0.06
        assert run.shortfall_j.sum() == 0.0


@pytest.mark.slow
def test_the_longer_a_start_is_thought_about_the_fewer_there_are():
    def starts(name):
        (run,) = driven(make_baseline(name, FIELD, {"equivalence": 2.42, "soc_gain": 1.0}), MEDIUM)
        return np.count_nonzero(np.diff(run.engine_on.astype(int), prepend=0) == 1)

    assert starts("a_ecms_unplanned") <= starts("ecms")


def test_they_drive_a_lossless_plant():
    paper = load_powertrain("paper")
    for name in ("ecms", "a_ecms"):
        (run,) = driven(make_rule(name, paper), np.full(60, 150e3), soc=0.8, params=paper)
        assert run.shortfall_j.sum() == 0.0
