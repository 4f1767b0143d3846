"""Statistics of pass and turn work, and the measured ones: what a generated job is held to."""

import csv
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.resources import resource_path

PASS_MIN_S = 25
"""A pass is a run of the state "working" at least as long (SOURCES of the recording)."""

EDGE_S = (12, 6)
"""Seconds left out at the start and the end of a pass where its noise is taken."""


@dataclass(frozen=True)
class PassTemplate:
    """Power around the start of a pass, as fractions of rated power, shape (K,) each.

    Attributes:
        time_s: from the first second of the pass.
        mean, sd, p10, p90: over the passes.
        passes: how many.
    """

    time_s: FloatArray
    mean: FloatArray
    sd: FloatArray
    p10: FloatArray
    p90: FloatArray
    passes: int


def measured_template(job: str) -> PassTemplate:
    """The recording's template of ``job_A`` or ``job_B``."""
    rows = [row for row in _rows("tractor_field_measured_pass_template.csv") if row["job"] == job]

    def column(name: str) -> FloatArray:
        return np.array([float(row[name]) for row in rows])

    return PassTemplate(
        column("t_rel_to_pass_start_s"),
        column("power_frac_mean"),
        column("power_frac_sd"),
        column("power_frac_p10"),
        column("power_frac_p90"),
        int(rows[0]["passes"]),
    )


def measured_states() -> dict[str, dict[str, float]]:
    """The recording's statistics by state: working, turning, moving and all."""
    return {
        row.pop("state"): {name: float(value) for name, value in row.items()}
        for row in _rows("tractor_field_measured_state_stats.csv")
    }


def pass_bounds(working: FloatArray) -> NDArray[np.intp]:
    """First second and end of every pass, shape (P, 2), from the share of each second at work."""
    edges = np.diff(np.concatenate([[0], (working > 0.5).astype(int), [0]]))
    bounds = np.stack([np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)], axis=1)
    long: NDArray[np.intp] = bounds[bounds[:, 1] - bounds[:, 0] >= PASS_MIN_S]
    return long


def aligned(power: FloatArray, bounds: NDArray[np.intp], time_s: FloatArray) -> FloatArray:
    """Power around the starts of those passes whose window is inside, shape (P', K)."""
    first, last = int(time_s[0]), int(time_s[-1])
    starts = bounds[:, 0]
    starts = starts[(starts + first >= 0) & (starts + last < len(power))]
    windows: FloatArray = power[starts[:, None] + np.arange(first, last + 1)]
    return windows


def within_pass_noise(power: FloatArray, bounds: NDArray[np.intp]) -> tuple[float, float]:
    """Standard deviation and lag-1 autocorrelation about each pass's own mean, edges left out.

    Sums over passes, sd with n - 1. The lag-1 figure is low by about 1/n in passes of n seconds.
    """
    products = squares = 0.0
    count = 0
    for start, end in bounds.tolist():
        inside = power[start + EDGE_S[0] : end - EDGE_S[1]]
        if len(inside) < 8:
            continue
        residual = inside - inside.mean()
        products += float(residual[1:] @ residual[:-1])
        squares += float(residual @ residual)
        count += len(inside) - 1
    return float(np.sqrt(squares / count)), products / squares


def variance_share(power: FloatArray, shortest_s: float, longest_s: float) -> float:
    """Share of the variance at periods in [shortest, longest]; plain periodogram of 1 Hz data."""
    density = np.abs(np.fft.rfft(power - power.mean())) ** 2
    density[1 : (len(power) + 1) // 2] *= 2.0
    frequency = np.fft.rfftfreq(len(power))
    inside = (frequency >= 1.0 / longest_s) & (frequency <= 1.0 / shortest_s)
    return float(density[inside].sum() / density[1:].sum())


def _rows(name: str) -> list[dict[str, str]]:
    path = resource_path("data", "cycle", name)
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))
