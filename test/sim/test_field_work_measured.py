"""The doubles of two measured jobs have the statistics of the recording.

Expected values are those of the shipped CSV files, or the figures quoted for the recording:
passes of 33 s every 72 s and 50 s every 103 s, sd within a pass 0.06-0.07 with lag-1
autocorrelation 0.2-0.36, ramps of 0.23-0.29 per second, 55 % of the variance at 48-134 s.
"""

from typing import NamedTuple

import numpy as np
import pytest

from tractor_sim.duty_cycle.field_work.params import operations
from tractor_sim.duty_cycle.field_work.statistics import (
    PassTemplate,
    aligned,
    measured_states,
    measured_template,
    pass_bounds,
    variance_share,
    within_pass_noise,
)
from tractor_sim.duty_cycle.field_work.timeline import autoregressive
from tractor_sim.duty_cycle.generate import MEASURED_JOBS, work_of

SEEDS = range(101, 113)
SESSION_S = 7520
PASS_S = {"measured_job_a": 33, "measured_job_b": 50}
PERIOD_S = {"measured_job_a": 72, "measured_job_b": 103}
JOB = {"measured_job_a": "job_A", "measured_job_b": "job_B"}


class Sessions(NamedTuple):
    powers: list[np.ndarray]
    working: list[np.ndarray]
    bounds: list[np.ndarray]

    def at(self, work: bool) -> np.ndarray:
        pairs = zip(self.powers, self.working, strict=True)
        return np.concatenate([power[(share > 0.5) == work] for power, share in pairs])

    def windows(self, template: PassTemplate) -> np.ndarray:
        pairs = zip(self.powers, self.bounds, strict=True)
        return np.concatenate([aligned(p, b, template.time_s) for p, b in pairs])


@pytest.fixture(scope="module")
def sessions() -> dict[str, Sessions]:
    rated_w = operations().vehicle.rated_power_w
    runs = {}
    for job in MEASURED_JOBS:
        works = [work_of(job, seed, duration_s=SESSION_S) for seed in SEEDS]
        powers = [work.power_w / rated_w for work in works]
        working = [work.working for work in works]
        runs[job] = Sessions(powers, working, [pass_bounds(share) for share in working])
    return runs


def test_the_variance_share_of_a_sine_is_all_or_nothing():
    time_s = np.arange(7200)
    sine = np.sin(2 * np.pi * time_s / 72)
    assert variance_share(sine, 48, 134) == pytest.approx(1.0)
    assert variance_share(sine, 10, 48) == pytest.approx(0.0, abs=1e-9)


def test_white_noise_spreads_its_variance_evenly_over_frequency():
    noise = np.random.Generator(np.random.PCG64(1)).standard_normal(100_000)
    assert variance_share(noise, 4, 1e9) == pytest.approx(0.5, abs=0.01)


def test_the_noise_estimator_finds_sd_and_lag_of_known_noise():
    noise = 0.07 * autoregressive(np.random.Generator(np.random.PCG64(2)), 50_000, 0.3)
    bounds = np.array([[0, 50_000]])
    sd, lag1 = within_pass_noise(noise, bounds)
    assert sd == pytest.approx(0.07, rel=0.02)
    assert lag1 == pytest.approx(0.3, abs=0.02)


@pytest.mark.parametrize("job", MEASURED_JOBS)
def test_passes_last_and_return_as_measured(sessions, job):
    bounds = sessions[job].bounds
    lengths = np.concatenate([b[:, 1] - b[:, 0] for b in bounds])
    periods = np.concatenate([np.diff(b[:, 0]) for b in bounds])
    assert np.median(lengths) == pytest.approx(PASS_S[job], rel=0.1)
    assert np.median(periods[periods < 1.6 * PERIOD_S[job]]) == pytest.approx(
        PERIOD_S[job], rel=0.1
    )


def pooled(sessions, pick) -> tuple[float, float]:
    """Mean and sd of both jobs, weighted as recorded: number of passes x period."""
    weight = {job: measured_template(JOB[job]).passes * PERIOD_S[job] for job in MEASURED_JOBS}
    total = sum(weight.values())
    values = {job: pick(sessions[job]) for job in MEASURED_JOBS}
    mean = sum(weight[job] * values[job].mean() for job in values) / total
    square = sum(weight[job] * (values[job] ** 2).mean() for job in values) / total
    return float(mean), float(np.sqrt(square - mean**2))


@pytest.mark.parametrize("state", ["working", "turning", "all"])
def test_mean_and_sd_of_every_state_are_the_recordings_within_a_tenth(sessions, state):
    measured = measured_states()[state]
    if state == "all":
        mean, sd = pooled(sessions, lambda job: np.concatenate(job.powers))
    else:
        mean, sd = pooled(sessions, lambda job: job.at(state == "working"))
    assert mean == pytest.approx(measured["power_frac_mean"], rel=0.1)
    assert sd == pytest.approx(measured["power_frac_sd"], rel=0.1)


def test_the_share_of_time_at_work_is_the_recordings_within_a_tenth(sessions):
    share, _ = pooled(sessions, lambda job: np.concatenate(job.working))
    measured = measured_states()["working"]["share_of_engine_on_time"]
    assert share == pytest.approx(measured, rel=0.1)


@pytest.mark.parametrize("job", MEASURED_JOBS)
def test_the_pass_profile_is_the_recordings_within_a_tenth(sessions, job):
    template = measured_template(JOB[job])
    windows = sessions[job].windows(template)
    assert len(windows) > 100
    gap = windows.mean(axis=0) - template.mean
    assert np.sqrt((gap**2).mean()) <= 0.1 * (template.mean.max() - template.mean.min())
    # Phases without the flanks, which a few seconds of misalignment move.
    after = (PASS_S[job] + 9, min(74, PERIOD_S[job] - 8))
    phases = {"turn before": (-28, -10), "pass": (12, PASS_S[job] - 6), "turn after": after}
    for name, (first, end) in phases.items():
        inside = (template.time_s >= first) & (template.time_s <= end)
        made, want = windows[:, inside], template
        assert made.mean() == pytest.approx(want.mean[inside].mean(), rel=0.1), name
        # Spread between passes at the same second; root mean square over the phase.
        spread = np.sqrt((made.std(axis=0) ** 2).mean())
        measured = np.sqrt((want.sd[inside] ** 2).mean())
        assert spread == pytest.approx(measured, rel=0.1), name


@pytest.mark.parametrize("job", MEASURED_JOBS)
def test_noise_within_a_pass_is_as_strong_and_as_short_lived_as_measured(sessions, job):
    found = [
        within_pass_noise(power, bounds)
        for power, bounds in zip(sessions[job].powers, sessions[job].bounds, strict=True)
    ]
    sd, lag1 = np.mean(found, axis=0)
    assert 0.06 <= sd <= 0.07
    assert lag1 == pytest.approx((0.2 + 0.36) / 2, abs=0.1)


@pytest.mark.parametrize("job", MEASURED_JOBS)
def test_power_rises_at_the_start_of_a_pass_as_fast_as_measured(sessions, job):
    rises = [
        np.diff(power[start - 8 : start + 12]).max()
        for power, bounds in zip(sessions[job].powers, sessions[job].bounds, strict=True)
        for start in bounds[:, 0].tolist()
        if start >= 8
    ]
    assert 0.23 <= np.mean(rises) <= 0.29


@pytest.mark.parametrize("job", MEASURED_JOBS)
def test_half_the_variance_lies_at_the_period_of_passes(sessions, job):
    shares = [variance_share(power, 48, 134) for power in sessions[job].powers]
    assert np.mean(shares) == pytest.approx(0.55, abs=0.08)
