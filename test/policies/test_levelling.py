"""Load levelling carries the mean, brings SOC back and stops the engine where work is light."""

import numpy as np
import pytest
from policies.work import ALL, FIELD, HEAVY, LIGHT, driven

from tractor_ems.policies.genset import power_max_w
from tractor_ems.policies.levelling import LoadLevelling
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.trajectory import trajectory_hash
from tractor_sim.config import load_powertrain

POLICY = LoadLevelling(FIELD)


def starts(trajectory):
    return np.count_nonzero(np.diff(trajectory.engine_on.astype(int), prepend=0) == 1)


def test_on_steady_work_at_the_target_the_engine_gives_the_demand():
    (run,) = driven(POLICY, np.full(300, 150e3))
    np.testing.assert_allclose(run.engine_power_w[-60:], 150e3, rtol=0.02)
    assert run.soc_final == pytest.approx(0.55, abs=0.01)


def test_the_engine_is_steadier_than_the_work():
    (run,) = driven(POLICY, HEAVY)
    later = slice(150, None)
    assert np.std(run.engine_power_w[later]) < 0.35 * np.std(HEAVY[later])
    assert starts(run) == 1
    assert run.shortfall_j.sum() == 0.0


def test_soc_comes_back_to_its_target_from_either_side():
    soc = np.array([0.40, 0.70])
    runs = driven(POLICY, np.full((2, 900), 150e3), soc=soc)
    for run, start in zip(runs, soc, strict=True):
        assert abs(run.soc_final - 0.55) < 0.1 * abs(start - 0.55)


def test_light_work_is_done_in_stretches_with_the_engine_off_between():
    (run,) = driven(POLICY, np.tile(LIGHT, 3))
    assert 2 <= starts(run) <= 6
    assert run.engine_on.mean() < 0.5
    level_w = POLICY.least_share * power_max_w(FIELD)
    used_w = run.engine_power_w[run.engine_power_w > 0]
    assert np.median(used_w) == pytest.approx(level_w, rel=1e-6)
    assert run.soc.min() > 0.40 and run.soc.max() < 0.70


def test_an_engine_that_is_only_held_does_not_flutter():
    peak = np.full(600, 20e3)
    peak[::40] = 170e3  # a loader's strokes: the battery should not carry them alone
    (run,) = driven(POLICY, peak, soc=0.66)
    steps_w = np.diff(run.engine_power_w)
    assert starts(run) <= 2
    assert np.count_nonzero(np.abs(steps_w) > 40e3) <= 2 * len(peak[::40])


def test_a_batch_acts_like_its_members():
    together = driven(POLICY, ALL[:, 300:600])
    for demand_w, run in zip(ALL[:, 300:600], together, strict=True):
        (alone,) = driven(POLICY, demand_w)
        assert trajectory_hash(run) == trajectory_hash(alone)


def test_on_the_papers_plant_the_engine_may_stop_under_peaks():
    paper = load_powertrain("paper")
    demand_w = np.where(np.arange(400) < 10, 240e3, 10e3)
    (run,) = driven(LoadLevelling(paper), demand_w, soc=0.88, params=paper)
    assert not run.engine_on[-1], "an engine that is back at once need not be held"
    assert run.shortfall_j.sum() == 0.0


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("mean_time_s", 0.0),
        ("soc_time_s", float("nan")),
        ("least_share", 1.5),
        ("stop_share", 0.5),
    ],
)
def test_a_setting_out_of_range_is_refused_by_name(field, value):
    with pytest.raises(PolicyError, match=field):
        LoadLevelling(FIELD, **{field: value})
