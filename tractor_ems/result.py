"""One run as one row: what it burnt, where it ended, what it broke, how close to DP it came."""

from collections.abc import Collection
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from tractor_msgs_py.trajectory import Trajectory
from tractor_sim.duty_cycle.cycle import DutyCycle, cycle_hash
from tractor_sim.figures import run_figures
from tractor_sim.powertrain import PowertrainParams

Transport = Literal["in_process", "ros"]

POWER_TOLERANCE_W = 1e-3
SOC_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Result:
    """Summary of one run.

    Attributes:
        policy, cycle, powertrain: names.
        held_out: the cycle is one that training must never see, and this policy's did not.
        fuel_kg, fuel_gal: fuel burnt, start fuel included.
        efficiency: crankshaft work over fuel energy; None when nothing was burnt.
        soc_initial, soc_final, soc_target: fractions.
        engine_starts: number of engine starts.
        shortfall_j, dissipated_j: undelivered demand, braked-away energy [J].
        violations: steps that broke a SOC or power limit or the bus balance; 0 or a bug.
        dp_note: why there is no dp_ratio, or None.
        dp_ratio: fuel of DP to the run's own final SOC over the run's fuel, at most 1 up to grid
            error; None where there was shortfall, because undelivered work must not score.
        steps: steps driven.
        trajectory_hash: SHA-256 of the run, equal across transports.
        transport: ``ros`` or ``in_process``.
    """

    policy: str
    cycle: str
    powertrain: str
    held_out: bool
    fuel_kg: float
    fuel_gal: float
    efficiency: float | None
    soc_initial: float
    soc_final: float
    soc_target: float
    engine_starts: int
    shortfall_j: float
    dissipated_j: float
    violations: int
    dp_ratio: float | None
    dp_note: str | None
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
    return Result(
        policy=policy,
        cycle=cycle.name,
        powertrain=params.name,
        held_out=cycle.split == "held_out" and cycle_hash(cycle) not in trained_on,
        soc_initial=float(trajectory.soc[0]),
        soc_target=soc_target,
        violations=count_violations(trajectory, params),
        dp_ratio=dp_ratio,
        dp_note=dp_note,
        transport=transport,
        **run_figures(trajectory, params),
    )


def count_violations(trajectory: Trajectory, params: PowertrainParams) -> int:
    """Steps that break the SOC window, a power limit or the bus balance.

    Judged from the columns, not by the plant's own limit code.
    """
    battery = params.battery
    soc = np.append(trajectory.soc, trajectory.soc_final)
    outside = (soc < battery.soc_min - SOC_TOLERANCE) | (soc > battery.soc_max + SOC_TOLERANCE)
    battery_w, engine_w = trajectory.battery_power_w, trajectory.engine_power_w
    too_much = (np.abs(battery_w) > battery.power_max_w + POWER_TOLERANCE_W) | (
        (engine_w < 0.0) | (engine_w > params.engine.power_max_w + POWER_TOLERANCE_W)
    )
    residual_w = (
        trajectory.power_demand_w
        - battery_w
        - engine_w
        - (trajectory.shortfall_j - trajectory.dissipated_j) / params.dt_s
    )
    unbalanced = np.abs(residual_w) > POWER_TOLERANCE_W
    not_finite = ~np.isfinite(battery_w + engine_w + trajectory.fuel_kg)
    return int(np.count_nonzero(outside[1:] | too_much | unbalanced | not_finite))
