"""Backward dynamic programme over SOC: least fuel for a known cycle that ends at a target SOC.

For a powertrain without engine memory (no start fuel, minimum times or ramp limit). What it
drives on the real plant is ``rollout``; whether a grid is fine enough is ``certificate``.
"""

import math
from dataclasses import dataclass

import numpy as np

from tractor_ems.optimal.kernel import backward
from tractor_msgs_py.errors import ConfigError, CycleError
from tractor_msgs_py.trajectory import FloatArray, IntArray
from tractor_sim import battery as _battery
from tractor_sim.engine import fuel_rate_kg_per_s
from tractor_sim.generator import to_bus_w, to_crank_w
from tractor_sim.powertrain import PowertrainParams, battery_power_grid_w
from tractor_sim.powertrain_json import powertrain_hash

TERMINAL_MULTIPLE = 2.0
"""Price of a missing joule at the end, in units of the largest marginal fuel. Above 1 it pays to
reach the target whenever it can be reached."""

SHORTFALL_MULTIPLE = 10.0
"""Price of a joule of unmet demand, in units of the terminal price: the programme misses the
target before it leaves work undone, and both are finite."""


@dataclass(frozen=True)
class DpSolution:
    """Cost to go of one cycle.

    Attributes:
        soc_grid: (N,), increasing; ``soc_target`` is a node.
        values: (T + 1, N), V_k [kg]: fuel from step k on, plus priced shortfall and missing
            energy at the end; finite everywhere.
        power_demand_w: (T,), the cycle it holds for, auxiliaries included [W].
        soc_target: where the run should end.
        soc_initial: where it starts; None: anywhere in the battery's window.
        actions: size of the battery power grid.
        terminal_price_kg_per_j: price of the energy missing at the end; 0 above the target.
        shortfall_price_kg_per_j: price of unmet demand.
        powertrain_hash: the powertrain it holds for.
    """

    soc_grid: FloatArray
    values: FloatArray
    power_demand_w: FloatArray
    soc_target: float
    soc_initial: float | None
    actions: int
    terminal_price_kg_per_j: float
    shortfall_price_kg_per_j: float
    powertrain_hash: str


def solve(
    params: PowertrainParams,
    power_demand_w: FloatArray,
    soc_target: float,
    *,
    soc_points: int = 401,
    actions: int = 1600,
    soc_initial: float | None = None,
) -> DpSolution:
    """Solve one cycle.

    Args:
        params: a powertrain without engine memory.
        power_demand_w: (T,), demand at the bus, auxiliaries included [W].
        soc_target: SOC to end at, within the battery's window. Ending above it costs nothing,
            ending below it costs more than any way to avoid it.
        soc_points: nodes of the SOC grid, at least 3.
        actions: battery powers over -P_b,max..P_b,max, at least 2. Besides these, lb, ub,
            every knot of the engine curve and landing exactly on the target are candidates.
        soc_initial: spend all nodes on what a run from here to the target can pass through.

    Raises:
        ConfigError: the powertrain has engine memory, or a SOC or grid size is out of range.
        CycleError: the demand is empty or not finite.
    """
    demand_w = np.ascontiguousarray(power_demand_w, dtype=np.float64)
    _check(params, demand_w, soc_target, soc_initial, soc_points, actions)
    battery, dt_s = params.battery, params.dt_s
    low, high = (battery.soc_min, battery.soc_max)
    if soc_initial is not None:
        low, high = _window(params, demand_w, soc_initial, soc_target)
    soc_grid = _grid(low, high, soc_target, soc_points)
    charge_w, discharge_w = _battery.power_limits_w(battery, soc_grid, dt_s)
    power_w = _candidate_powers_w(params, soc_grid, soc_target, actions, charge_w, discharge_w)
    soc_move = _soc_moves(params, power_w)
    top_cell, cell_start = _cells(soc_grid, soc_move)
    knot_w = engine_knots_w(params)
    price = terminal_price_kg_per_j(params)
    values = np.empty((len(demand_w) + 1, len(soc_grid)))
    values[-1] = price * battery.energy_j * np.maximum(soc_target - soc_grid, 0.0)
    backward(
        values,
        soc_grid,
        power_w,
        soc_move[None, :],
        top_cell,
        cell_start,
        engine_fuel_kg(params, demand_w[:, None] - power_w[None, :]),
        demand_w,
        charge_w,
        discharge_w,
        knot_w,
        engine_fuel_kg(params, knot_w),
        SHORTFALL_MULTIPLE * price * dt_s,
    )
    return DpSolution(
        soc_grid=soc_grid,
        values=values,
        power_demand_w=demand_w,
        soc_target=soc_target,
        soc_initial=soc_initial,
        actions=actions,
        terminal_price_kg_per_j=price,
        shortfall_price_kg_per_j=SHORTFALL_MULTIPLE * price,
        powertrain_hash=powertrain_hash(params),
    )


def co_state_kg_per_j(params: PowertrainParams, solution: DpSolution, k: int, soc: float) -> float:
    """What one more joule in the battery saves from step k on, -dV_k/dE [kg/J].

    The secant over the nodes one step at full battery power away, or over the whole grid where
    that is less: the slope of one cell alone carries the ripple of whole on and off steps.
    """
    grid = solution.soc_grid
    reach = params.battery.power_max_w * params.dt_s / params.battery.energy_j
    low, high = max(grid[0], soc - reach), min(grid[-1], soc + reach)
    cost = np.interp([low, high], grid, solution.values[k])
    return float((cost[0] - cost[1]) / ((high - low) * params.battery.energy_j))


def engine_fuel_kg(params: PowertrainParams, engine_power_w: FloatArray) -> FloatArray:
    """Fuel of one step at an engine power at the bus, any shape; 0 and below is off."""
    peak_w = params.engine.power_max_w
    limit_w = to_bus_w(params.generator, np.array(peak_w), peak_w)
    power_w = np.clip(engine_power_w, 0.0, limit_w)
    crank_w = to_crank_w(params.generator, power_w, peak_w)
    return fuel_rate_kg_per_s(params.engine, crank_w) * params.dt_s


def engine_knots_w(params: PowertrainParams) -> FloatArray:
    """Bus powers where the fuel curve may have a kink, from 0 (off) to the maximum [W]."""
    peak_w = params.engine.power_max_w
    crank_w = np.array(params.engine.curve_power_w)
    if not params.generator.ideal:
        crank_w = np.union1d(crank_w, np.array(params.generator.load_fraction) * peak_w)
    return to_bus_w(params.generator, crank_w, peak_w)


def terminal_price_kg_per_j(params: PowertrainParams) -> float:
    """:data:`TERMINAL_MULTIPLE` times the largest marginal fuel of the running engine."""
    knots_w = engine_knots_w(params)
    power_w = np.union1d(np.linspace(0.0, knots_w[-1], 4096), knots_w)[1:]
    marginal = np.diff(engine_fuel_kg(params, power_w)) / (np.diff(power_w) * params.dt_s)
    return TERMINAL_MULTIPLE * float(marginal.max())


def _check(
    params: PowertrainParams,
    demand_w: FloatArray,
    soc_target: float,
    soc_initial: float | None,
    soc_points: int,
    actions: int,
) -> None:
    engine, battery = params.engine, params.battery
    for name, free in (
        ("start_fuel_kg", 0.0),
        ("min_on_s", 0.0),
        ("min_off_s", 0.0),
        ("ramp_w_per_s", math.inf),
    ):
        value = getattr(engine, name)
        if value != free:
            raise ConfigError(
                f"powertrain {params.name}: engine.{name} is {value}, dynamic programming "
                f"allows {free} (it has no engine state)"
            )
    for name, soc in (("soc_target", soc_target), ("soc_initial", soc_initial)):
        if soc is not None and not battery.soc_min <= soc <= battery.soc_max:
            raise ConfigError(f"{name}: {soc}, allowed {battery.soc_min}..{battery.soc_max}")
    if soc_points < 3:
        raise ConfigError(f"soc_points: {soc_points}, allowed >= 3")
    if actions < 2:
        raise ConfigError(f"actions: {actions}, allowed >= 2")
    if demand_w.ndim != 1 or not len(demand_w) or not np.all(np.isfinite(demand_w)):
        raise CycleError(f"power_demand_w: shape {demand_w.shape}, allowed (T,) and finite")


def _window(
    params: PowertrainParams, demand_w: FloatArray, soc_initial: float, soc_target: float
) -> tuple[float, float]:
    """SOC range of all runs from soc_initial to soc_target, or to the nearest reachable SOC.

    A little too wide: what one step can do is taken without the SOC limits, and two steps at
    full battery power are added at either end, so that leaving the range is never mispriced.
    """
    battery = params.battery
    engine_max_w = engine_knots_w(params)[-1]
    power_w = np.linspace(-battery.power_max_w, battery.power_max_w, 1025)
    move = _soc_moves(params, power_w)
    full = (-battery.power_max_w, battery.power_max_w)
    rise = np.interp(np.clip(demand_w - engine_max_w, *full), power_w, move)
    fall = np.interp(np.clip(demand_w, *full), power_w, move)
    steps = len(demand_w)
    lowest, highest = np.empty(steps + 1), np.empty(steps + 1)
    lowest[0] = highest[0] = soc_initial
    for k in range(steps):
        lowest[k + 1] = min(max(lowest[k] + fall[k], battery.soc_min), battery.soc_max)
        highest[k + 1] = min(max(highest[k] + rise[k], battery.soc_min), battery.soc_max)
    end = min(max(soc_target, lowest[-1]), highest[-1])
    to_end_rise = np.concatenate([np.cumsum(rise[::-1])[::-1], [0.0]])
    to_end_fall = np.concatenate([np.cumsum(fall[::-1])[::-1], [0.0]])
    lowest = np.maximum(lowest, np.minimum(end - to_end_rise, highest))
    highest = np.minimum(highest, np.maximum(end - to_end_fall, lowest))
    margin = 2.0 * float(move[0])
    low = max(min(lowest.min(), soc_target) - margin, battery.soc_min)
    high = min(max(highest.max(), soc_target) + margin, battery.soc_max)
    return float(low), float(high)


def _grid(low: float, high: float, soc_target: float, soc_points: int) -> FloatArray:
    """``soc_points`` nodes from low to high; evenly spaced on either side of soc_target, which
    is one of them."""
    cells = soc_points - 1
    below = round(cells * (soc_target - low) / (high - low))
    below = min(max(below, int(soc_target > low)), cells - int(soc_target < high))
    return np.concatenate(
        [
            np.linspace(low, soc_target, below + 1)[:-1],
            np.linspace(soc_target, high, cells - below + 1),
        ]
    )


def _candidate_powers_w(
    params: PowertrainParams,
    soc_grid: FloatArray,
    soc_target: float,
    actions: int,
    charge_w: FloatArray,
    discharge_w: FloatArray,
) -> FloatArray:
    """The action grid, every node's battery limits, and what lands a node on the target."""
    grid_w = battery_power_grid_w(params, actions)
    landing_w = landing_power_w(params, soc_grid, soc_target)
    landing_w = landing_w[(landing_w > grid_w[0]) & (landing_w < grid_w[-1])]
    return np.unique(np.concatenate([grid_w, -charge_w, discharge_w, landing_w]))


def landing_power_w(params: PowertrainParams, soc: FloatArray, soc_target: float) -> FloatArray:
    """Battery power that takes ``soc`` to the target in one step, limits aside [W]."""
    return (soc - soc_target) * params.battery.energy_j / params.dt_s


def _soc_moves(params: PowertrainParams, power_w: FloatArray) -> FloatArray:
    """SOC change of each power, shape (A,): a lossless battery moves alike from every node.

    Discharging is taken from the window's top and charging from its bottom, where neither meets
    a limit before any other node would.
    """
    battery = params.battery
    start = np.where(power_w > 0.0, battery.soc_max, battery.soc_min)
    return _battery.soc_after(battery, start, power_w, params.dt_s) - start


def _cells(soc_grid: FloatArray, soc_move: FloatArray) -> tuple[IntArray, IntArray]:
    """``top_cell`` (N,) and ``cell_start`` (N, C + 1) of the kernel."""
    last_cell = len(soc_grid) - 2

    def cell(soc: FloatArray) -> IntArray:
        return np.clip(np.searchsorted(soc_grid, soc, side="right") - 1, 0, last_cell)

    top = cell(soc_grid + soc_move[0])
    bottom = cell(soc_grid + soc_move[-1])
    cells = int((top - bottom).max()) + 1
    wanted = top[:, None] - np.arange(cells + 1)[None, :]
    threshold = soc_grid[np.clip(wanted + 1, 0, last_cell + 1)] - soc_grid[:, None]
    start = len(soc_move) - np.searchsorted(soc_move[::-1], threshold)
    start[:, 0] = 0
    start[wanted < 0] = len(soc_move)
    return top, start
