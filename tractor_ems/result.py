"""One run as one row: what it burnt, where it ended, what it broke, how close to DP it came."""

from collections.abc import Collection
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from tractor_msgs_py.trajectory import BoolArray, FloatArray, Trajectory
from tractor_sim.battery import discharge_current_a, soc_after
from tractor_sim.duty_cycle.cycle import DutyCycle, Split, cycle_hash
from tractor_sim.engine import fuel_rate_kg_per_s
from tractor_sim.figures import run_figures
from tractor_sim.generator import to_bus_w, to_crank_w
from tractor_sim.powertrain import PowertrainParams

Transport = Literal["in_process", "ros"]

UNSEEN = ("validation", "held_out")
"""Splits that no policy learns from."""

NOT_ASKED_FOR = "not asked for"
"""``dp_note`` of a run that was not to be scored."""

POWER_TOLERANCE_W = 1e-3
SOC_TOLERANCE = 1e-9
CURRENT_TOLERANCE_A = 1e-3
TIME_TOLERANCE_S = 1e-6
FUEL_TOLERANCE_KG = 1e-9


@dataclass(frozen=True)
class Result:
    """Summary of one run; docs/metrics.md defines every figure with its unit.

    Attributes:
        policy, cycle, powertrain: names.
        operation, split: of the cycle; split is None for a user's own.
        held_out: the cycle is kept from training (its split is validation or held_out), and
            this policy's training did not see it either.
        fuel_kg, fuel_l, fuel_gal: fuel burnt, start fuel included.
        fuel_l_per_h: over the whole run; fuel_l_per_ha: None where the cycle knows no area.
        efficiency: crankshaft work over fuel energy; None when nothing was burnt.
        bus_efficiency: engine energy that reached the bus over fuel energy; None likewise.
        soc_initial, soc_final, soc_target: fractions; soc_deviation: final less target.
        soc_min, soc_max, soc_excursion: extremes over the run and their distance.
        engine_starts, engine_starts_per_h: starts, per hour of the whole run.
        engine_h: time the engine was on [h]; below_60kw_s: of this, below 60 kW crankshaft [s].
        battery_throughput_kwh: energy into and out of the terminals.
        equivalent_full_cycles: throughput over twice the nominal energy.
        shortfall_j, dissipated_j: undelivered demand, braked-away energy [J].
        violations: steps that broke a limit or the bus balance; 0 or a bug.
        dp_note: why there is no dp_ratio, or None.
        dp_ratio: fuel of DP to the run's own final SOC over the run's fuel, at most 1 up to grid
            error; None where there was shortfall, because undelivered work must not score.
        duration_s, steps: what was driven.
        trajectory_hash: SHA-256 of the run, equal across transports.
        transport: ``ros`` or ``in_process``.
    """

    policy: str
    cycle: str
    operation: str
    split: Split | None
    powertrain: str
    held_out: bool
    fuel_kg: float
    fuel_l: float
    fuel_gal: float
    fuel_l_per_h: float
    fuel_l_per_ha: float | None
    efficiency: float | None
    bus_efficiency: float | None
    soc_initial: float
    soc_final: float
    soc_target: float
    soc_deviation: float
    soc_min: float
    soc_max: float
    soc_excursion: float
    engine_starts: int
    engine_starts_per_h: float
    engine_h: float
    below_60kw_s: float
    battery_throughput_kwh: float
    equivalent_full_cycles: float
    shortfall_j: float
    dissipated_j: float
    violations: int
    dp_ratio: float | None
    dp_note: str | None
    duration_s: float
    steps: int
    trajectory_hash: str
    transport: Transport

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)


def summarise(
    trajectory: Trajectory,
    *,
    policy: str,
    cycle: DutyCycle,
    params: PowertrainParams,
    soc_target: float,
    transport: Transport,
    dp_ratio: float | None,
    dp_note: str | None = None,
    trained_on: Collection[str] = (),
) -> Result:
    """The row of one run, computed from its trajectory alone.

    ``trained_on`` holds the hashes of the cycles that the policy learnt from.
    """
    figures = run_figures(trajectory, params)
    area_ha = cycle.area_ha
    return Result(
        policy=policy,
        cycle=cycle.name,
        operation=cycle.operation,
        split=cycle.split,
        powertrain=params.name,
        held_out=cycle.split in UNSEEN and cycle_hash(cycle) not in trained_on,
        soc_initial=float(trajectory.soc[0]),
        soc_target=soc_target,
        soc_deviation=trajectory.soc_final - soc_target,
        fuel_l_per_ha=figures["fuel_l"] / area_ha if area_ha else None,
        violations=count_violations(trajectory, params),
        dp_ratio=dp_ratio,
        dp_note=dp_note,
        transport=transport,
        **figures,
    )


def count_violations(trajectory: Trajectory, params: PowertrainParams) -> int:
    """Steps that break the SOC window, a limit of the battery's power or current, of the engine's
    power, ramp or minimum times, or the bus balance; whose SOC or fuel does not follow from
    their powers; or that hold a negative loss or a number that is not finite.

    Judged from the columns, not by the plant's own limit code.
    """
    battery = params.battery
    soc = np.append(trajectory.soc, trajectory.soc_final)
    outside = (soc < battery.soc_min - SOC_TOLERANCE) | (soc > battery.soc_max + SOC_TOLERANCE)
    battery_w, engine_w = trajectory.battery_power_w, trajectory.engine_power_w
    amps = discharge_current_a(battery, trajectory.soc, battery_w)
    too_much = (
        (np.abs(battery_w) > battery.power_max_w + POWER_TOLERANCE_W)
        | (amps > battery.current_max_discharge_a + CURRENT_TOLERANCE_A)
        | (amps < -battery.current_max_charge_a - CURRENT_TOLERANCE_A)
    )
    residual_w = (
        trajectory.power_demand_w
        - battery_w
        - engine_w
        - (trajectory.shortfall_j - trajectory.dissipated_j) / params.dt_s
    )
    unbalanced = np.abs(residual_w) > POWER_TOLERANCE_W
    columns = (trajectory.power_demand_w, battery_w, engine_w, trajectory.fuel_kg, soc[1:])
    not_finite = ~np.isfinite(np.sum(columns, axis=0) + trajectory.shortfall_j)
    not_finite |= ~np.isfinite(trajectory.soc + trajectory.dissipated_j)
    moved = soc_after(battery, trajectory.soc, battery_w, params.dt_s)
    broken = outside[1:] | too_much | unbalanced | not_finite
    broken |= np.abs(soc[1:] - moved) > SOC_TOLERANCE
    broken |= (trajectory.shortfall_j < 0.0) | (trajectory.dissipated_j < 0.0)
    broken |= np.abs(trajectory.fuel_kg - _fuel_kg(trajectory, params)) > FUEL_TOLERANCE_KG
    return int(np.count_nonzero(broken | _engine_limits_broken(trajectory, params)))


def _fuel_kg(trajectory: Trajectory, params: PowertrainParams) -> FloatArray:
    """Fuel of every step by the engine's curve, and of its start, shape (T,)."""
    engine, on = params.engine, trajectory.engine_on
    crank_w = to_crank_w(params.generator, trajectory.engine_power_w, engine.power_max_w)
    started = on & ~np.append(False, on[:-1])
    burnt_kg = fuel_rate_kg_per_s(engine, crank_w, on) * params.dt_s
    fuel_kg: FloatArray = burnt_kg + started * engine.start_fuel_kg
    return fuel_kg


def _engine_limits_broken(trajectory: Trajectory, params: PowertrainParams) -> BoolArray:
    """Steps whose engine power or state its limits forbid, shape (T,). A run begins with an
    engine that has been off for long enough."""
    engine, generator = params.engine, params.generator
    bus_w, on = trajectory.engine_power_w, trajectory.engine_on
    most_w = float(to_bus_w(generator, np.array(engine.power_max_w), engine.power_max_w))
    broken = (bus_w < 0.0) | (bus_w > most_w + POWER_TOLERANCE_W)
    broken |= ~on & (bus_w > POWER_TOLERANCE_W)
    crank_w = to_crank_w(generator, bus_w, engine.power_max_w)
    ramp_w = np.diff(crank_w, prepend=0.0)
    broken |= on & (np.abs(ramp_w) > engine.ramp_w_per_s * params.dt_s + POWER_TOLERANCE_W)
    changes = np.flatnonzero(np.diff(on))  # a stretch begins after each
    for first, last in pairwise(changes):
        least_s = engine.min_on_s if on[last] else engine.min_off_s
        broken[last + 1] |= (last - first) * params.dt_s < least_s - TIME_TOLERANCE_S
    if on[0] and len(changes):  # started at once
        stood_s = (changes[0] + 1) * params.dt_s
        broken[changes[0] + 1] |= stood_s < engine.min_on_s - TIME_TOLERANCE_S
    return broken
