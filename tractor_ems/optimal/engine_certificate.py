"""The certificate of a plant with engine state: grid halving, roll-out on the relaxed plant, and
the bracket between that and what the real plant can drive."""

import numpy as np

from tractor_ems.optimal.bracket import drive_plan, largest_marginal_kg
from tractor_ems.optimal.certificate import (
    BRACKET_LIMIT,
    HALVING_LIMIT,
    NEGLIGIBLE_KG,
    RESIDUAL_LIMIT,
    ROLLOUT_LIMIT,
    Certificate,
)
from tractor_ems.optimal.engine_dp import (
    MAX_VALUES,
    EngineSolution,
    model_of,
    solve_engine,
    usual_cell_j,
)
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.powertrain import ROUNDING_W, PowertrainParams

HALVINGS = 4
"""Of the first pass's cell at most. The coarsest is twice the usual one, so that a certificate is
mostly about the solution that everybody else gets."""


def certify_engine(
    params: PowertrainParams,
    power_demand_w: FloatArray,
    soc_initial: float,
    soc_final: float,
    *,
    bracket: bool,
) -> tuple[Certificate, EngineSolution]:
    """Solve on ever finer grids until the result stands; both SOC checked by the caller.

    ``bracket``: also drive the real plant and report the width; without it that is None.
    """
    cell_j = 2.0 * usual_cell_j(len(power_demand_w))
    # Where a long cycle's tables widen the cells, half the values make them twice as wide.
    coarse = solve_engine(
        params,
        power_demand_w,
        soc_initial,
        soc_final,
        cell_j=cell_j,
        max_values=MAX_VALUES // 2,
    )
    best = coarse
    for halving in range(1, HALVINGS + 1):
        cell_j = 0.5 * cell_j
        fine = solve_engine(params, power_demand_w, soc_initial, soc_final, cell_j=cell_j)
        scale_kg = max(fine.lower_bound_kg, NEGLIGIBLE_KG)
        change = abs(fine.lower_bound_kg - coarse.lower_bound_kg) / scale_kg
        gap = (fine.cost_kg - fine.value_kg) / scale_kg
        residual = _residual_kg(params, fine, fine.plan.soc[-1]) / scale_kg
        finer = fine.cell_j < 0.75 * coarse.cell_j
        stands = finer and change < HALVING_LIMIT
        stands = stands and abs(gap) < ROLLOUT_LIMIT and residual < RESIDUAL_LIMIT
        # Any grid's run can be driven; a coarse one is rarely the cheapest, but it can be.
        best = min(fine, best, key=lambda solution: solution.cost_kg)
        if stands or not finer or halving == HALVINGS:
            break
        coarse = fine
    width = bracket_width(params, best) if bracket else None
    window = params.battery.soc_max - params.battery.soc_min
    certificate = Certificate(
        grid_halving_change=change,
        rollout_gap=gap,
        residual=residual,
        bracket_width=width,
        soc_points=round(window * params.battery.energy_j / fine.cell_j) + 1,
        actions=round(params.engine.power_max_w * params.dt_s / fine.cell_j) + 1,
        fuel_kg=best.lower_bound_kg,
        soc_initial=soc_initial,
        soc_final=float(best.plan.soc[-1]),
        starts=best.plan.starts,
        stops=best.plan.stops,
        ok=stands and (not bracket or (width is not None and width <= BRACKET_LIMIT)),
    )
    return certificate, best


def bracket_width(params: PowertrainParams, solution: EngineSolution) -> float | None:
    """(Fuel of a run of the real plant - lower bound) / lower bound, energy missing at its end
    priced; None where that run says nothing: it leaves demand unmet that the optimum meets, misses
    its end by more than :data:`RESIDUAL_LIMIT`, or burns less than a lower bound can let it."""
    run = drive_plan(params, solution)
    rounding_j = ROUNDING_W * params.dt_s * len(solution.power_demand_w)
    if run.shortfall_j.sum() > solution.plan.shortfall_j.sum() + rounding_j:
        return None
    scale_kg = max(solution.lower_bound_kg, NEGLIGIBLE_KG)
    residual_kg = _residual_kg(params, solution, run.soc_final)
    width = (float(run.fuel_kg.sum()) + residual_kg - solution.lower_bound_kg) / scale_kg
    if residual_kg >= RESIDUAL_LIMIT * scale_kg or width < -ROLLOUT_LIMIT:
        return None
    return width


def _residual_kg(params: PowertrainParams, solution: EngineSolution, soc_final: float) -> float:
    """Energy missing at the end, at the co-state or the largest marginal fuel if that is more:
    a run that never had a choice has a co-state of 0."""
    if solution.soc_target is None:
        return 0.0
    missing_j = max(solution.soc_target - soc_final, 0.0) * params.battery.energy_j
    marginal = largest_marginal_kg(model_of(params)) / params.battery.energy_j
    return float(missing_j * max(float(np.median(solution.co_state_kg_per_j)), marginal))
