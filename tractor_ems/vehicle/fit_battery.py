"""Charge, open-circuit voltage and resistance from recorded SOC, voltage and current.

SOC counts current, dSOC = I dt / Q, and V = OCV(SOC) + R I with I > 0 charging: both linear in
what is sought.
"""

from dataclasses import dataclass

import numpy as np

from tractor_ems.vehicle.estimate import Estimate
from tractor_ems.vehicle.least_squares import Solution, knots_where_sampled, misfit_at, solve
from tractor_ems.vehicle.recorded import Recorded
from tractor_msgs_py.trajectory import FloatArray

SOC_CELL = 0.01
LEAST_SWING = 0.005
"""SOC must move by as much for a capacity to be read from it."""

LEAST_STEPS = 30
LEAST_VOLTAGE_V = 0.01
"""A voltage that moves less is a nominal value that somebody reports, not a measured one."""

LEAST_CURRENT_SHARE = 0.05
"""Spread of the current at one SOC, as a share of the largest current, to see a resistance."""


LEAST_TELLING = 10
"""Steps in which the current is off what SOC explains by as much."""


@dataclass(frozen=True)
class BatteryFit:
    """What SOC, voltage and current say.

    Attributes:
        charge_c: from SOC 0 to 1 [C]; None where it is not identified.
        ocv_soc, ocv_v, ocv_error_v: knots of the open-circuit voltage, shape (K,); empty where
            it is not identified.
        resistance_ohm: None where it is not identified.
        rms_v: residual of the voltage; rms_soc: of the SOC.
        estimates: charge, resistance, OCV.
        notes: what the recording lacks.
    """

    charge_c: float | None
    ocv_soc: FloatArray
    ocv_v: FloatArray
    ocv_error_v: FloatArray
    resistance_ohm: float | None
    rms_v: float | None
    rms_soc: float | None
    estimates: tuple[Estimate, ...]
    notes: tuple[str, ...]


def fit_battery(recorded: Recorded) -> BatteryFit:
    """The battery that the recorded steps support."""
    charge, rms_soc = _charge(recorded)
    notes = list(_soc_notes(recorded))
    known = np.isfinite(recorded.voltage_v) & np.isfinite(recorded.current_a)
    voltage_v, current, soc = (
        column[known] for column in (recorded.voltage_v, recorded.current_a, recorded.soc)
    )
    why = _why_no_resistance(voltage_v, current)
    if why:
        estimates = (charge, *_no_voltage(voltage_v, why))
        none = np.zeros(0)
        return BatteryFit(
            charge.value, none, none, none, None, None, rms_soc, estimates, tuple(notes)
        )
    knots = knots_where_sampled(soc, SOC_CELL)
    design = np.column_stack((_ocv_columns(soc, knots), current))
    solution = solve(design, voltage_v, resolution=_resolution(voltage_v))
    rows = np.column_stack((_ocv_columns(knots, knots), np.zeros(len(knots))))
    ocv_v, error_v = solution.predict(rows)
    error_v = np.hypot(error_v, misfit_at(knots, soc, solution.residual))
    resistance = _resistance(solution, soc, knots, current)
    notes += _voltage_notes(solution, current, charge.value)
    identified = resistance.verdict == "identified"
    ocv = Estimate(
        "battery.ocv_v, residual [V]",
        solution.rms,
        None,
        "identified" if identified else "not_identified",
        f"SOC {knots[0]:.4f}..{knots[-1]:.4f}, {ocv_v[0]:.2f}..{ocv_v[-1]:.2f} V at rest"
        if identified
        else "voltage under load, from which the drop cannot be taken off",
    )
    if not identified:
        knots = ocv_v = error_v = np.zeros(0)
    return BatteryFit(
        charge_c=charge.value,
        ocv_soc=knots,
        ocv_v=ocv_v,
        ocv_error_v=error_v,
        resistance_ohm=resistance.value if identified else None,
        rms_v=solution.rms,
        rms_soc=rms_soc,
        estimates=(charge, resistance, ocv),
        notes=tuple(notes),
    )


def _charge(recorded: Recorded) -> tuple[Estimate, float | None]:
    """Q from SOC over counted current, and the residual in SOC.

    Each stretch starts anywhere, and the current may have an offset: a sensor's, or that of a
    reading at the end of a step against its mean.
    """
    name = "battery: charge [C]"
    moved = float(np.ptp(np.append(recorded.soc, recorded.soc_before[:1])))
    current = recorded.current_a
    if not np.all(np.isfinite(current)):
        return Estimate(name, None, None, "not_identified", "current was not recorded"), None
    if moved < LEAST_SWING:
        why = f"SOC moved by {moved:.2g}, need {LEAST_SWING:g}"
        return Estimate(name, None, None, "not_identified", why), None
    columns = []
    for number in np.unique(recorded.stretch):
        inside = recorded.stretch == number
        dt_s = recorded.dt_s[inside]
        stretch = (np.cumsum(current[inside] * dt_s), np.cumsum(dt_s), recorded.soc[inside])
        columns.append([column - column.mean() for column in stretch])
    counted, time_s, soc = (np.concatenate(column) for column in zip(*columns, strict=True))
    drift = float(counted @ time_s) / float(time_s @ time_s)
    rest = counted - drift * time_s
    if float(rest @ rest) < LEAST_CURRENT_SHARE**2 * float(counted @ counted):
        why = "the current hardly varies: an offset of its sensor cannot be told from capacity"
        return Estimate(name, None, None, "not_identified", why), None
    design = np.column_stack((counted, time_s))
    solution = solve(design, soc, np.array([True, True]), _resolution(recorded.soc))
    slope = float(solution.coefficients[0])
    if slope <= 0.0:
        return Estimate(name, None, None, "not_identified", "SOC does not follow current"), None
    offset = float(solution.coefficients[1]) / slope
    why = (
        f"SOC moved by {moved:.3f}; efficiency of charging taken as 1; offset of the current "
        f"{offset:.2g} A"
    )
    estimate = Estimate(name, 1.0 / slope, float(solution.error[0]) / slope**2, "identified", why)
    return estimate, solution.rms


def _why_no_resistance(voltage_v: FloatArray, current: FloatArray) -> str:
    """Why voltage and current cannot tell a resistance, or empty."""
    if len(voltage_v) < LEAST_STEPS:
        return f"{len(voltage_v)} steps with voltage and current, need {LEAST_STEPS}"
    if np.ptp(voltage_v) < LEAST_VOLTAGE_V:
        return (
            f"voltage stays at {voltage_v[0]:.2f} V under {current.min():.4g}.."
            f"{current.max():.4g} A: a nominal value, or no resistance to see"
        )
    if np.ptp(current) == 0.0:
        return f"current stays at {current[0]:.4g} A"
    return ""


def _resolution(values: FloatArray) -> float:
    """Step of float32, as which the wire carries voltage, current and SOC."""
    return float(np.spacing(np.float32(np.abs(values).max())))


def _no_voltage(voltage_v: FloatArray, why: str) -> tuple[Estimate, Estimate]:
    mean_v = float(voltage_v.mean()) if len(voltage_v) else None
    return (
        Estimate("battery.resistance_ohm", None, None, "not_identified", why),
        Estimate("battery.ocv_v, mean [V]", mean_v, None, "not_identified", why),
    )


def _ocv_columns(soc: FloatArray, knots: FloatArray) -> FloatArray:
    """A constant, and per cell of the knots a ramp from 0 to 1: a sum of these never falls."""
    width = np.maximum(np.diff(knots), 1e-12)
    ramps = np.clip((soc[:, None] - knots[None, :-1]) / width, 0.0, 1.0)
    return np.column_stack((np.ones(len(soc)), ramps))


def _resistance(
    solution: Solution, soc: FloatArray, knots: FloatArray, current: FloatArray
) -> Estimate:
    name = "battery.resistance_ohm"
    others = _ocv_columns(soc, knots)
    moves = np.abs(current - others @ np.linalg.lstsq(others, current, rcond=None)[0])
    spread = float(np.sqrt(np.mean(moves**2)))
    largest = float(np.abs(current).max())
    telling = int(np.sum(moves > LEAST_CURRENT_SHARE * largest))
    value = float(solution.coefficients[-1])
    error = float(solution.error[-1])
    if telling < LEAST_TELLING or spread < LEAST_CURRENT_SHARE * largest:
        why = (
            f"current at one SOC varies by {spread:.3g} A only, by more than "
            f"{LEAST_CURRENT_SHARE:.0%} of its largest {largest:.4g} A in {telling} steps (need "
            f"{LEAST_TELLING}): its voltage drop cannot be told from OCV"
        )
        return Estimate(name, None, None, "not_identified", why)
    if value <= 0.0:
        why = "voltage does not fall with discharge current"
        return Estimate(name, None, None, "not_identified", why)
    why = f"current varies by {spread:.4g} A at one SOC, {current.min():.4g}..{current.max():.4g}"
    return Estimate(name, value, error, "identified", why)


def _soc_notes(recorded: Recorded) -> list[str]:
    values = np.unique(recorded.soc)
    if len(values) < 2:
        return [f"SOC never moves from {values[0]:.6f}"]
    current = np.abs(np.nan_to_num(recorded.current_a))
    flowing = current[1:] > 0.02 * current.max()
    stuck = np.mean((np.diff(recorded.soc) == 0.0)[flowing]) if flowing.any() else 0.0
    if stuck < 0.5:
        return []
    step = float(np.median(np.diff(values)))
    return [f"SOC comes in {len(values)} values about {step:.2g} apart"]


def _voltage_notes(solution: Solution, current: FloatArray, charge_c: float | None) -> list[str]:
    notes = []
    largest = float(np.abs(current).max())
    resting = int(np.sum(np.abs(current) < 0.02 * largest))
    if not (current.min() < 0.0 < current.max()) and not resting:
        way = "charged" if current.min() >= 0.0 else "discharged"
        notes.append(f"the battery is only ever {way} and never rests: OCV is an extrapolation")
    elif not resting:
        notes.append("no rest periods: OCV rests on charge and discharge being symmetric")
    if charge_c is not None and largest < 0.1 * charge_c / 3600.0:
        notes.append(f"current stays below 0.1 C ({largest:.3g} A): resistance at power unseen")
    if solution.correlation > 0.9 and solution.rms > 0.1:
        notes.append(
            f"voltage residuals ({solution.rms:.2g} V) are correlated in time: the cells have "
            "dynamics or temperature that one resistance does not describe"
        )
    return notes
