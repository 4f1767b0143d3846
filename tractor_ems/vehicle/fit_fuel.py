"""Fuel rate over engine power at the bus, idle and start fuel from recorded steps.

Piecewise linear, rising and convex, as the plant needs it: a sum of hinges with coefficients
>= 0. What lies between crankshaft and bus is inside the curve.
"""

from dataclasses import dataclass, replace

import numpy as np

from tractor_ems.vehicle.estimate import Estimate
from tractor_ems.vehicle.least_squares import (
    Solution,
    hinges,
    knots_where_sampled,
    misfit_at,
    solve,
)
from tractor_ems.vehicle.recorded import Recorded
from tractor_msgs_py.trajectory import BoolArray, FloatArray

CELLS = 50
"""Most cells of the curve between least and largest power."""

LEAST_STEPS, LEAST_POWERS = 30, 10
GAP = 0.05
"""A range without a sample that is wider than this share of the largest power is a gap."""


@dataclass(frozen=True)
class FuelFit:
    """A fuel curve while on; arrays of shape (K,).

    Attributes:
        bus_w: knots, the outermost are the least and largest power visited [W].
        fuel_kg_per_s, error_kg_per_s: fuel there, and its error: the standard error and what
            the residuals around it are.
        slope_kg_per_j: of the first and last cell, for lines beyond the knots.
        rms_kg_per_s: of the residuals; free_rms_kg_per_s: of a curve that need not be convex.
        gaps_w: ranges of power without a sample.
        steps, starts: how many steps on, and how many of them started the engine.
        estimates: idle and start fuel, and the curve as a whole.
    """

    bus_w: FloatArray
    fuel_kg_per_s: FloatArray
    error_kg_per_s: FloatArray
    slope_kg_per_j: tuple[float, float]
    rms_kg_per_s: float
    free_rms_kg_per_s: float
    gaps_w: tuple[tuple[float, float], ...]
    steps: int
    starts: int
    estimates: tuple[Estimate, ...]

    @property
    def identified(self) -> bool:
        """There is a curve, not a point or nothing."""
        return len(self.bus_w) > 1

    def fuel_at(self, bus_w: FloatArray) -> FloatArray:
        """Fuel rate at bus powers; beyond the knots the outermost lines go on, shape as given."""
        inside = np.interp(bus_w, self.bus_w, self.fuel_kg_per_s)
        low = np.minimum(bus_w - self.bus_w[0], 0.0) * self.slope_kg_per_j[0]
        high = np.maximum(bus_w - self.bus_w[-1], 0.0) * self.slope_kg_per_j[1]
        fuel: FloatArray = inside + low + high
        return fuel


def fit_fuel(recorded: Recorded, lhv_j_per_kg: float) -> FuelFit:
    """The fuel curve that the steps with the engine on support.

    Args:
        lhv_j_per_kg: no marginal efficiency above 1 is fitted.
    """
    on = recorded.engine_on
    power_w, started = recorded.engine_w[on], recorded.started[on]
    rate = recorded.fuel_kg[on] / recorded.dt_s[on]
    starts = int(started.sum())
    running = ~started
    if running.sum() < LEAST_STEPS:
        return _nothing(
            f"{int(running.sum())} steps with the engine on, need {LEAST_STEPS}", len(rate), starts
        )
    low_w, high_w = float(power_w[running].min()), float(power_w[running].max())
    if high_w - low_w < 0.02 * high_w or high_w <= 0.0:
        return _point(power_w, rate, started, recorded.dt_s[on])
    powers = len(np.unique(np.round(power_w[running] / (0.005 * high_w))))
    if powers < LEAST_POWERS:
        why = f"the engine ran at {powers} different powers, need {LEAST_POWERS}"
        return _nothing(why, len(rate), starts)
    spacing_w = max((high_w - low_w) / CELLS, 0.01 * high_w)
    knots_w = knots_where_sampled(power_w[running], spacing_w)
    # Without a running step near it a start step says nothing about either: leave it out.
    comparable = _comparable(power_w, started, spacing_w)
    used = running | comparable
    start_rate = (started / recorded.dt_s[on])[used]
    design = _design(power_w[used], knots_w, start_rate)
    fixed = power_w[used] / lhv_j_per_kg
    solution = solve(design, rate[used] - fixed)
    free_rms = solve(design, rate[used] - fixed, np.ones(design.shape[1], dtype=bool)).rms
    fuel, error = solution.predict(_design(knots_w, knots_w, np.zeros(len(knots_w))))
    error = np.hypot(error, misfit_at(knots_w, power_w[used], solution.residual))
    slopes = np.cumsum(solution.coefficients[1:-1]) + 1.0 / lhv_j_per_kg
    gaps = _gaps(power_w[running], GAP * high_w)
    estimates = (
        _curve_estimate(knots_w, solution, free_rms, gaps, float(rate[running].mean())),
        _idle_estimate(solution, low_w, high_w, int(np.sum(running & (power_w <= 1.0)))),
        _start_estimate(solution, starts, int(comparable.sum())),
    )
    return FuelFit(
        bus_w=knots_w,
        fuel_kg_per_s=np.maximum(fuel, 0.0) + knots_w / lhv_j_per_kg,
        error_kg_per_s=error,
        slope_kg_per_j=(float(slopes[0]), float(slopes[-1])),
        rms_kg_per_s=solution.rms,
        free_rms_kg_per_s=free_rms,
        gaps_w=gaps,
        steps=len(rate),
        starts=starts,
        estimates=estimates,
    )


def _design(power_w: FloatArray, knots_w: FloatArray, start_rate: FloatArray) -> FloatArray:
    """Columns: fuel at power 0, slope from there on, a hinge per inner knot, a start."""
    return np.column_stack(
        (np.ones(len(power_w)), power_w, hinges(power_w, knots_w[1:-1]), start_rate)
    )


def _comparable(power_w: FloatArray, started: BoolArray, near_w: float) -> BoolArray:
    """Starts at powers at which the engine also ran: their fuel can be told from running fuel."""
    running_w = np.sort(power_w[~started])
    k = np.searchsorted(running_w, power_w)
    below = np.abs(power_w - running_w[np.maximum(k - 1, 0)])
    above = np.abs(power_w - running_w[np.minimum(k, len(running_w) - 1)])
    near: BoolArray = started & (np.minimum(below, above) <= near_w)
    return near


def _gaps(power_w: FloatArray, width_w: float) -> tuple[tuple[float, float], ...]:
    ordered = np.sort(power_w)
    wide = np.flatnonzero(np.diff(ordered) > width_w)
    return tuple((float(ordered[k]), float(ordered[k + 1])) for k in wide)


def _curve_estimate(
    knots_w: FloatArray,
    solution: Solution,
    free_rms: float,
    gaps: tuple[tuple[float, float], ...],
    mean_rate: float,
) -> Estimate:
    text = (
        f"over {knots_w[0] / 1e3:.1f}..{knots_w[-1] / 1e3:.1f} kW at the bus in "
        f"{len(knots_w) - 1} cells; beyond that a straight line"
    )
    if gaps:
        shown = ", ".join(f"{a / 1e3:.1f}..{b / 1e3:.1f}" for a, b in gaps[:4])
        text += f"; never visited: {shown} kW"
    if solution.rms > 2.0 * free_rms and solution.rms - free_rms > 1e-3 * mean_rate:
        text += (
            f"; the data are not convex: residual {solution.rms * 1e3:.3g} g/s, without that "
            f"condition {free_rms * 1e3:.3g} g/s"
        )
    return Estimate("engine: fuel curve, residual [kg/s]", solution.rms, None, "identified", text)


def _idle_estimate(solution: Solution, low_w: float, high_w: float, idling: int) -> Estimate:
    value = float(solution.coefficients[0])
    error = float(solution.error[0])
    name = "engine.idle_fuel_kg_per_s"
    if idling:
        return Estimate(name, value, error, "identified", f"{idling} steps idling")
    if low_w <= 0.02 * high_w:
        return Estimate(name, value, error, "identified", f"power down to {low_w / 1e3:.1f} kW")
    why = (
        f"the engine never ran below {low_w / 1e3:.1f} kW; the value is where the curve's first "
        "line meets 0 kW"
    )
    return Estimate(name, value, None, "not_identified", why)


def _start_estimate(solution: Solution, starts: int, comparable: int) -> Estimate:
    name = "engine.start_fuel_kg"
    if not starts:
        return Estimate(name, None, None, "not_identified", "the engine was never started")
    if not comparable:
        why = f"the engine ran at no power of its starts ({starts}) otherwise"
        return Estimate(name, None, None, "not_identified", why)
    error = float(solution.error[-1])
    value = float(solution.coefficients[-1])
    return Estimate(name, value, error, "identified", f"{comparable} of {starts} starts")


def _point(power_w: FloatArray, rate: FloatArray, started: BoolArray, dt_s: FloatArray) -> FuelFit:
    """One power: its fuel rate, and start fuel where starts were at that power too."""
    low_w, high_w = float(power_w[~started].min()), float(power_w[~started].max())
    why = f"the engine ran at {low_w / 1e3:.1f}..{high_w / 1e3:.1f} kW only: a point, no curve"
    nothing = _nothing(why, len(rate), int(started.sum()))
    comparable = _comparable(power_w, started, 1e-3 * high_w)
    used = ~started | comparable
    solution = solve(np.column_stack((np.ones(len(rate)), started / dt_s))[used], rate[used])
    there = Estimate(
        f"engine: fuel at {high_w / 1e3:.1f} kW at the bus [kg/s]",
        float(solution.coefficients[0]),
        float(solution.error[0]),
        "identified",
        f"{int(np.sum(~started))} steps",
    )
    start = _start_estimate(solution, nothing.starts, int(comparable.sum()))
    return replace(nothing, estimates=(there, *nothing.estimates[:2], start))


def _nothing(why: str, steps: int, starts: int) -> FuelFit:
    none = np.zeros(0)
    names = ("engine: fuel curve", "engine.idle_fuel_kg_per_s", "engine.start_fuel_kg")
    estimates = tuple(Estimate(name, None, None, "not_identified", why) for name in names)
    return FuelFit(none, none, none, (0.0, 0.0), 0.0, 0.0, (), steps, starts, estimates)
