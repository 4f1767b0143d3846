"""Proof by refinement that a grid is fine enough: halve every grid step until the fuel stands."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from tractor_ems.optimal.dp import (
    DpSolution,
    co_state_kg_per_j,
    cost_to_go_kg,
    reachable_soc,
    solve,
)
from tractor_ems.optimal.engine_dp import has_engine_state, nearest_end_soc
from tractor_ems.optimal.rollout import roll_out
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import FloatArray, Trajectory
from tractor_sim.powertrain import PowertrainParams

HALVING_LIMIT = 5e-4
"""Largest relative change of the optimal value when every grid step is halved."""

ROLLOUT_LIMIT = 1e-3
"""Largest relative distance of the roll-out on the real plant from the value."""

RESIDUAL_LIMIT = 2e-4
"""Largest priced energy missing at the end of the roll-out, relative to its fuel."""

BRACKET_LIMIT = 5e-3
"""Largest distance of a run of the real plant from the lower bound, relative to that."""

NEGLIGIBLE_KG = 1e-4
"""Fuel below which the three limits are absolute, in parts of this mass: a tenth of a gram."""

SOC_TOLERANCE = 1e-6
"""Slack for SOC that came over the wire as a float32."""

MAX_NODES = 2_500_000
"""Refinement ends before steps times SOC points passes this: 3,263 SOC points on 766 steps, some
200 MB and two seconds."""


@dataclass(frozen=True)
class Certificate:
    """How good the finer of two grids is.

    Attributes:
        grid_halving_change: relative change of the fuel from the grid with steps twice as large:
            of V, the optimal value at the start; where V still moves, of the roll-out. (V is
            linear between nodes and overestimates a short run of a few engine bursts, which the
            roll-out gets right long before.)
        rollout_gap: (roll-out - V) / V, the roll-out with its residual priced.
        residual: priced energy missing at the end of the roll-out, relative to its fuel.
        bracket_width: (a run of the real plant - fuel_kg) / fuel_kg, the run's residual priced.
            Where the plant has no engine state that run is the roll-out, set against V. None
            where it was not asked for, or (then not ok) where that run leaves demand unmet that
            the optimum meets.
        soc_points, actions: the finer grid; with engine state the nodes that the whole window
            would have, and engine powers as far apart as the nodes.
        fuel_kg: the reference of the score: fuel of the roll-out on the real plant, its residual
            priced at the co-state; with engine state the lower bound.
        soc_initial, soc_final: where the roll-out starts and really ends.
        starts, stops: of the engine in the optimum.
        ok: all of them within their limits.
    """

    grid_halving_change: float
    rollout_gap: float
    residual: float
    bracket_width: float | None
    soc_points: int
    actions: int
    fuel_kg: float
    soc_initial: float
    soc_final: float
    starts: int
    stops: int
    ok: bool

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)


def certify(
    params: PowertrainParams,
    power_demand_w: FloatArray,
    soc_initial: float,
    soc_final: float,
    *,
    soc_points: int = 401,
    actions: int = 1600,
    bracket: bool = True,
) -> Certificate:
    """Solve and roll out on ever finer grids until the result stands.

    Args:
        power_demand_w: (T,), demand at the bus, auxiliaries included [W].
        soc_initial, soc_final: both within the battery's window; float32 rounding is forgiven.
        soc_points, actions: the coarsest grid; refined as far as :data:`MAX_NODES` allows. A
            plant with engine state has grids of its own.
        bracket: with engine state, also drive the real plant.

    Raises:
        ConfigError: a SOC is outside the window, or soc_final cannot be reached on this cycle.
    """
    start, end = checked_soc(params, power_demand_w, soc_initial, soc_final)
    if has_engine_state(params):
        from tractor_ems.optimal.engine_certificate import certify_engine

        return certify_engine(params, power_demand_w, start, end, bracket=bracket)[0]
    coarse = solve(
        params, power_demand_w, end, soc_initial=start, soc_points=soc_points, actions=actions
    )
    while True:
        fine = solve(
            params,
            power_demand_w,
            end,
            soc_initial=start,
            soc_points=2 * coarse.soc_points - 1,
            actions=2 * coarse.actions - 1,
        )
        certificate = _compare(params, coarse, fine, start)
        if certificate.ok or 2 * fine.values.size > MAX_NODES:
            return certificate
        coarse = fine


def _compare(
    params: PowertrainParams, coarse: DpSolution, fine: DpSolution, soc_initial: float
) -> Certificate:
    run = roll_out(fine, params)
    fuel_kg, residual_kg, cost_kg = _priced(params, fine, run)
    value_kg = float(cost_to_go_kg(fine, 0, soc_initial))
    scale_kg = max(value_kg, NEGLIGIBLE_KG)
    change = abs(value_kg - float(cost_to_go_kg(coarse, 0, soc_initial))) / scale_kg
    if change >= HALVING_LIMIT:
        change = abs(cost_kg - _priced(params, coarse, roll_out(coarse, params))[2]) / scale_kg
    gap = (cost_kg - value_kg) / scale_kg
    residual = residual_kg / max(fuel_kg, NEGLIGIBLE_KG)
    on = run.engine_on
    return Certificate(
        grid_halving_change=change,
        rollout_gap=gap,
        residual=residual,
        bracket_width=max(gap, 0.0),
        soc_points=fine.soc_points,
        actions=fine.actions,
        fuel_kg=fuel_kg,
        soc_initial=soc_initial,
        soc_final=run.soc_final,
        starts=int(np.sum(on & ~np.append(False, on[:-1]))),
        stops=int(np.sum(on[:-1] & ~on[1:])),
        ok=change < HALVING_LIMIT and abs(gap) < ROLLOUT_LIMIT and residual < RESIDUAL_LIMIT,
    )


def _priced(
    params: PowertrainParams, solution: DpSolution, run: Trajectory
) -> tuple[float, float, float]:
    """Fuel of a roll-out with its residual, the residual alone, and the fuel with shortfall."""
    missing_j = max(solution.soc_target - run.soc_final, 0.0) * params.battery.energy_j
    residual_kg = missing_j * co_state_kg_per_j(params, solution, 0, float(run.soc[0]))
    fuel_kg = float(run.fuel_kg.sum()) + residual_kg
    shortfall_kg = solution.shortfall_price_kg_per_j * float(run.shortfall_j.sum())
    return fuel_kg, residual_kg, fuel_kg + shortfall_kg


def checked_soc(
    params: PowertrainParams, power_demand_w: FloatArray, soc_initial: float, soc_final: float
) -> tuple[float, float]:
    """Both SOC with float32 rounding forgiven.

    Raises:
        ConfigError: one is outside the window, or soc_final cannot be reached on this cycle.
    """
    battery = params.battery
    clipped = np.clip([soc_initial, soc_final], battery.soc_min, battery.soc_max)
    for name, given, inside in zip(
        ("soc_initial", "soc_final"), (soc_initial, soc_final), clipped, strict=True
    ):
        if not abs(given - inside) <= SOC_TOLERANCE:
            raise ConfigError(f"{name}: {given}, allowed {battery.soc_min}..{battery.soc_max}")
    start, end = float(clipped[0]), float(clipped[1])
    nearest = nearest_soc(params, power_demand_w, start, end)
    if abs(end - nearest) > SOC_TOLERANCE:
        raise ConfigError(
            f"soc_final: {soc_final} cannot be reached from {soc_initial} on this cycle, "
            f"the nearest is {nearest}"
        )
    return start, nearest


def nearest_soc(
    params: PowertrainParams, power_demand_w: FloatArray, soc_initial: float, soc_final: float
) -> float:
    """The SOC nearest to ``soc_final`` that a run from ``soc_initial`` can end at."""
    if has_engine_state(params):
        return nearest_end_soc(params, power_demand_w, soc_initial, soc_final)
    return float(reachable_soc(params, power_demand_w, soc_initial, soc_final)[1][-1])
