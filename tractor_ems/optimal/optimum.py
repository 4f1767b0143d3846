"""The optimum of a cycle as it is reported: what the plant drives, what a joule was worth at each
step, and the certificate. One function for every plant; and a trace of it as CSV."""

import csv
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tractor_ems.drive import drive
from tractor_ems.optimal.bracket import plan_policy
from tractor_ems.optimal.certificate import Certificate, certify, checked_soc
from tractor_ems.optimal.dp import co_state_kg_per_j, solve
from tractor_ems.optimal.engine_certificate import certify_engine
from tractor_ems.optimal.engine_dp import has_engine_state, solve_engine
from tractor_ems.policies.dp import DpPolicy
from tractor_ems.policies.protocol import Policy
from tractor_msgs_py.atomic import write_bytes
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import FloatArray, Trajectory
from tractor_sim.powertrain import PowertrainParams


@dataclass(frozen=True)
class Optimum:
    """One optimum.

    Attributes:
        policy: drives it, named ``dp``.
        trajectory: the run on the real plant.
        reference_kg: the least fuel known to be possible: what a score would be measured by; with
            a price at the end, net of the energy gained.
        co_state_kg_per_j: (T,), what one more joule in the battery saved at each step, >= 0.
        starts, stops: of the engine in the optimum; with engine state that is the relaxed one.
        certificate: None where it was not asked for.
    """

    policy: Policy
    trajectory: Trajectory
    reference_kg: float
    co_state_kg_per_j: FloatArray
    starts: int
    stops: int
    certificate: Certificate | None


def find_optimum(
    params: PowertrainParams,
    power_demand_w: FloatArray,
    soc_initial: float,
    soc_target: float | None,
    *,
    end_price_kg_per_j: float | None = None,
    certified: bool = False,
) -> Optimum:
    """Solve, drive and, where asked, certify.

    Args:
        power_demand_w: (T,), demand at the bus, auxiliaries included [W].
        soc_target: SOC to end at; None: the end is free, on plants with engine state only.
        end_price_kg_per_j: with a free end, what a joule left there is worth.
        certified: also halve the grid and report the gaps; needs a target.

    Raises:
        ConfigError: a SOC is out of range or reach, or the plant cannot be solved as asked.
        CycleError: the demand is empty or not finite.
    """
    if soc_target is not None:
        soc_initial, soc_target = checked_soc(params, power_demand_w, soc_initial, soc_target)
    elif certified:
        raise ConfigError("certify: a certificate needs an SOC to end at")
    if not has_engine_state(params):
        if soc_target is None:
            raise ConfigError(
                f"powertrain {params.name}: a free end needs a plant with engine state"
            )
        return _without_engine_state(params, power_demand_w, soc_initial, soc_target, certified)
    certificate = None
    if certified and soc_target is not None:
        certificate, solution = certify_engine(
            params, power_demand_w, soc_initial, soc_target, bracket=True
        )
    else:
        solution = solve_engine(
            params,
            power_demand_w,
            soc_initial,
            soc_target,
            end_price_kg_per_j=end_price_kg_per_j,
        )
    policy = plan_policy(params, solution)
    return Optimum(
        policy=policy,
        trajectory=_driven(policy, params, power_demand_w, soc_initial, soc_target),
        reference_kg=solution.lower_bound_kg,
        co_state_kg_per_j=solution.co_state_kg_per_j,
        starts=solution.plan.starts,
        stops=solution.plan.stops,
        certificate=certificate,
    )


def _without_engine_state(
    params: PowertrainParams,
    power_demand_w: FloatArray,
    soc_initial: float,
    soc_target: float,
    certified: bool,
) -> Optimum:
    solution = solve(params, power_demand_w, soc_target, soc_initial=soc_initial)
    policy = DpPolicy(params, solution)
    run = _driven(policy, params, power_demand_w, soc_initial, soc_target)
    on = run.engine_on
    certificate = None
    if certified:
        certificate = certify(params, power_demand_w, soc_initial, soc_target)
    return Optimum(
        policy=policy,
        trajectory=run,
        reference_kg=float(run.fuel_kg.sum()) if certificate is None else certificate.fuel_kg,
        co_state_kg_per_j=np.array(
            [co_state_kg_per_j(params, solution, k, float(soc)) for k, soc in enumerate(run.soc)]
        ),
        starts=int(np.sum(on & ~np.append(False, on[:-1]))),
        stops=int(np.sum(on[:-1] & ~on[1:])),
        certificate=certificate,
    )


def _driven(
    policy: Policy,
    params: PowertrainParams,
    power_demand_w: FloatArray,
    soc_initial: float,
    soc_target: float | None,
) -> Trajectory:
    target = soc_initial if soc_target is None else soc_target
    return drive(policy, params, power_demand_w[None, :], soc_initial, target)[0]


TRACE_COLUMNS = (
    "time_s",
    "power_demand_w",
    "soc",
    "battery_power_w",
    "engine_power_w",
    "engine_on",
    "fuel_kg",
    "co_state_kg_per_j",
)


def write_trace(path: Path, optimum: Optimum, dt_s: float) -> None:
    """Write the run step by step: SOC before the step, powers at the bus during it, fuel of the
    step with a start's, co-state of the optimum before the step.

    Raises:
        ConfigError: the file cannot be written.
    """
    run = optimum.trajectory
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(TRACE_COLUMNS)
    columns = (
        (dt_s * np.arange(len(run.soc))).tolist(),
        run.power_demand_w.tolist(),
        run.soc.tolist(),
        run.battery_power_w.tolist(),
        run.engine_power_w.tolist(),
        run.engine_on.astype(int).tolist(),
        run.fuel_kg.tolist(),
        optimum.co_state_kg_per_j.tolist(),
    )
    writer.writerows(zip(*columns, strict=True))
    write_bytes(path, text.getvalue().encode())
