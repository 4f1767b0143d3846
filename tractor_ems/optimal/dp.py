"""Backward dynamic programme over SOC: least fuel for a known cycle that ends at a target SOC.

For a powertrain without engine memory (no start fuel, minimum times or ramp limit) and battery
losses; any other is ``engine_dp``'s. What it drives on the real plant is ``rollout``; whether a
grid is fine enough is ``certificate``.
"""

import math
from dataclasses import dataclass

import numpy as np

from tractor_ems.optimal.kernel import backward
from tractor_msgs_py.errors import ConfigError, CycleError
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim import battery as _battery
from tractor_sim.engine import EngineParams, fuel_rate_kg_per_s
from tractor_sim.generator import to_bus_w, to_crank_w
from tractor_sim.powertrain import PowertrainParams, battery_power_grid_w
from tractor_sim.powertrain_json import powertrain_hash

TERMINAL_MULTIPLE = 2.0
"""Price of a missing joule at the end, in units of the largest marginal fuel. Above 1 it pays to
reach the target whenever it can be reached."""

SHORTFALL_MULTIPLE = 10.0
"""Price of a joule of unmet demand, in units of the terminal price: the programme misses the
target before it leaves work undone, and both are finite."""


NODE_GAP = 1e-6
"""Least width of a grid row and distance of its outermost nodes: well above the rounding of a
float32 SOC, well below anything that matters."""


@dataclass(frozen=True)
class DpSolution:
    """Cost to go of one cycle.

    Attributes:
        soc_grid: (T + 1, N), nodes of every step, each row increasing; ``soc_target`` is a node
            of the last row.
        values: (T + 1, N), V_k at the nodes [kg]: fuel from step k on, plus priced shortfall and
            missing energy at the end; finite everywhere.
        landing_soc: (T,), SOC after each step that is worth hitting exactly: the highest from
            which the target is still met, at the last step the target itself.
        power_demand_w: (T,), the cycle it holds for, auxiliaries included [W].
        soc_target: where the run should end.
        soc_initial: where it starts; None: anywhere in the battery's window.
        soc_points, actions: sizes of the SOC and battery power grids.
        terminal_price_kg_per_j: price of the energy missing at the end; 0 above the target.
        shortfall_price_kg_per_j: price of unmet demand.
        powertrain_hash: the powertrain it holds for.
    """

    soc_grid: FloatArray
    values: FloatArray
    landing_soc: FloatArray
    power_demand_w: FloatArray
    soc_target: float
    soc_initial: float | None
    soc_points: int
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
        soc_points: nodes of the SOC grid at every step, at least 4.
        actions: battery powers over -P_b,max..P_b,max, at least 2. Besides these, lb, ub,
            every knot of the engine curve and landing exactly on the target are candidates.
        soc_initial: lay the nodes of each step over what a run from here to the target can pass
            through then, bounds included. Finer, and exact where there is hardly any choice.

    Raises:
        ConfigError: the powertrain has engine memory, or a SOC or grid size is out of range.
        CycleError: the demand is empty or not finite.
    """
    demand_w = np.ascontiguousarray(power_demand_w, dtype=np.float64)
    check_problem(params, demand_w, soc_target, soc_initial, soc_points, actions)
    power_w = battery_power_grid_w(params, actions)
    soc_move = soc_moves(params, power_w)
    if soc_initial is None:
        row = _window_row(params, soc_target, soc_points)
        soc_grid = np.tile(row, (len(demand_w) + 1, 1))
        landing_soc = np.full(len(demand_w), soc_target)
    else:
        low, high = reachable_soc(params, demand_w, soc_initial, soc_target)
        soc_grid = tube_rows(low, high, soc_points)
        landing_soc = high[1:]
    price = terminal_price_kg_per_j(params)
    lb, ub, end_power_w, end_cost_kg = _node_candidates(
        params, demand_w, soc_grid, landing_soc, SHORTFALL_MULTIPLE * price
    )
    knot_w = engine_knots_w(params)
    values = np.empty_like(soc_grid)
    missing_j = params.battery.energy_j * np.maximum(soc_target - soc_grid[-1], 0.0)
    values[-1] = price * missing_j
    backward(
        values,
        soc_grid,
        demand_w,
        power_w,
        soc_move,
        engine_fuel_kg(params, demand_w[:, None] - power_w[None, :]),
        knot_w,
        engine_fuel_kg(params, knot_w),
        lb,
        ub,
        end_power_w,
        end_cost_kg,
    )
    return DpSolution(
        soc_grid=soc_grid,
        values=values,
        landing_soc=landing_soc,
        power_demand_w=demand_w,
        soc_target=soc_target,
        soc_initial=soc_initial,
        soc_points=soc_points,
        actions=actions,
        terminal_price_kg_per_j=price,
        shortfall_price_kg_per_j=SHORTFALL_MULTIPLE * price,
        powertrain_hash=powertrain_hash(params),
    )


def cost_to_go_kg(solution: DpSolution, k: int, soc: FloatArray | float) -> FloatArray:
    """V_k at any SOC (any shape): linear between nodes, the lowest slope below them, constant
    above: more SOC than a run can use is worth nothing."""
    grid, values = solution.soc_grid[k], solution.values[k]
    slope = (values[1] - values[0]) / (grid[1] - grid[0])
    cost: FloatArray = np.interp(soc, grid, values) + slope * np.minimum(soc - grid[0], 0.0)
    return cost


def co_state_kg_per_j(params: PowertrainParams, solution: DpSolution, k: int, soc: float) -> float:
    """What one more joule in the battery saves from step k on, -dV_k/dE [kg/J].

    The secant over one step at full battery power on either side, as far as the grid goes: the
    slope of one cell alone carries the ripple of whole on and off steps.
    """
    grid = solution.soc_grid[k]
    reach = params.battery.power_max_w * params.dt_s / params.battery.energy_j
    low, high = max(grid[0], soc - reach), min(grid[-1], soc + reach)
    cost = cost_to_go_kg(solution, k, np.array([low, high]))
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
    crank_w = np.union1d(crank_w, _idle_knots_w(params.engine))
    return to_bus_w(params.generator, crank_w, peak_w)


def _idle_knots_w(engine: EngineParams) -> FloatArray:
    """Crankshaft powers where the curve leaves the idle rate, which it never goes below [W].

    Efficiency is a + b P between two knots, so that P / (eta(P) LHV) = idle is linear in P.
    """
    idle_kg_per_s, power_w = engine.idle_fuel_kg_per_s, np.array(engine.curve_power_w)
    if idle_kg_per_s == 0.0:
        return np.empty(0)
    if engine.curve_fuel_kg_per_s:
        fuel = np.array(engine.curve_fuel_kg_per_s)
        inside = fuel[0] < idle_kg_per_s < fuel[-1]
        return np.interp([idle_kg_per_s], fuel, power_w) if inside else np.empty(0)
    efficiency, idle_w = (
        np.array(engine.curve_efficiency),
        idle_kg_per_s * engine.fuel_lhv_j_per_kg,
    )
    b = np.diff(efficiency) / np.diff(power_w)
    a = efficiency[:-1] - b * power_w[:-1]
    slope = 1.0 - idle_w * b
    crossing_w = idle_w * a / np.where(slope == 0.0, np.nan, slope)
    found: FloatArray = crossing_w[(power_w[:-1] < crossing_w) & (crossing_w < power_w[1:])]
    return found


def terminal_price_kg_per_j(params: PowertrainParams) -> float:
    """:data:`TERMINAL_MULTIPLE` times the largest marginal fuel of the running engine."""
    knots_w = engine_knots_w(params)
    power_w = np.union1d(np.linspace(0.0, knots_w[-1], 4096), knots_w)[1:]
    marginal = np.diff(engine_fuel_kg(params, power_w)) / (np.diff(power_w) * params.dt_s)
    return TERMINAL_MULTIPLE * float(marginal.max())


def check_problem(
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
    if not battery.lossless:
        raise ConfigError(
            f"powertrain {params.name}: battery has losses or current limits, this dynamic "
            "programme knows none"
        )
    for name, soc in (("soc_target", soc_target), ("soc_initial", soc_initial)):
        if soc is not None and not battery.soc_min <= soc <= battery.soc_max:
            raise ConfigError(f"{name}: {soc}, allowed {battery.soc_min}..{battery.soc_max}")
    if soc_points < 4:
        raise ConfigError(f"soc_points: {soc_points}, allowed >= 4")
    if actions < 2:
        raise ConfigError(f"actions: {actions}, allowed >= 2")
    if demand_w.ndim != 1 or not len(demand_w) or not np.all(np.isfinite(demand_w)):
        raise CycleError(f"power_demand_w: shape {demand_w.shape}, allowed (T,) and finite")


def reachable_soc(
    params: PowertrainParams, demand_w: FloatArray, soc_initial: float, soc_target: float
) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest SOC at every step, (T + 1,) each, of all runs between the two SOCs; the
    end is the nearest SOC that can be reached where the target cannot."""
    lower, upper = params.battery.soc_min, params.battery.soc_max
    fall, rise = _extreme_moves(params, demand_w)
    low, high = soc_tube(params, demand_w, soc_initial)
    from_low = from_high = min(max(soc_target, low[-1]), high[-1])
    low[-1] = high[-1] = from_low
    for k in range(len(demand_w) - 1, -1, -1):
        # At a limit the battery takes or gives less, so from there the limit itself is reached.
        from_low = max(from_low - rise[k], lower) if from_low > lower else lower
        from_high = min(from_high - fall[k], upper) if from_high < upper else upper
        low[k], high[k] = max(low[k], from_low), min(high[k], from_high)
    return low, np.maximum(low, high)


def soc_tube(
    params: PowertrainParams, demand_w: FloatArray, soc_initial: float
) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest SOC at every step, (T + 1,) each, of all runs from one SOC."""
    lower, upper = params.battery.soc_min, params.battery.soc_max
    fall, rise = _extreme_moves(params, demand_w)
    low, high = np.empty(len(demand_w) + 1), np.empty(len(demand_w) + 1)
    low[0] = high[0] = soc_initial
    for k in range(len(demand_w)):
        low[k + 1] = min(max(low[k] + fall[k], lower), upper)
        high[k + 1] = min(max(high[k] + rise[k], lower), upper)
    return low, high


def _extreme_moves(
    params: PowertrainParams, demand_w: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """SOC change of every step with the engine off and at its maximum, limits aside."""
    power_max_w = params.battery.power_max_w
    power_w = np.linspace(-power_max_w, power_max_w, 1025)
    moves = soc_moves(params, power_w)
    fall = np.interp(demand_w, power_w, moves)
    return fall, np.interp(demand_w - engine_knots_w(params)[-1], power_w, moves)


def tube_rows(low: FloatArray, high: FloatArray, soc_points: int) -> FloatArray:
    """Even nodes from low to high at every step, and one more just outside at either end: below,
    its slope prices what cannot reach the target; above, SOC that can only end beyond it."""
    width = np.maximum(high - low, NODE_GAP)
    inner = high[:, None] - width[:, None] * np.linspace(1.0, 0.0, soc_points)
    return np.concatenate([inner[:, :1] - NODE_GAP, inner, inner[:, -1:] + NODE_GAP], axis=1)


def _window_row(params: PowertrainParams, soc_target: float, soc_points: int) -> FloatArray:
    """Nodes over the battery's window; evenly spaced on either side of soc_target, a node."""
    low, high = params.battery.soc_min, params.battery.soc_max
    cells = soc_points - 1
    below = round(cells * (soc_target - low) / (high - low))
    below = min(max(below, int(soc_target > low)), cells - int(soc_target < high))
    return np.concatenate(
        [
            np.linspace(low, soc_target, below + 1)[:-1],
            np.linspace(soc_target, high, cells - below + 1),
        ]
    )


def _node_candidates(
    params: PowertrainParams,
    demand_w: FloatArray,
    soc_grid: FloatArray,
    landing_soc: FloatArray,
    shortfall_price_kg_per_j: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """lb and ub (T, N) of every node, and the candidates made for it with their cost (3, T, N):
    lb, ub, and what lands on ``landing_soc``. Shortfall is priced."""
    lb, ub, ends, short_w = end_powers_w(params, demand_w, soc_grid)
    landing = landing_power_w(params, soc_grid[:-1], landing_soc[:, None])
    power = np.concatenate([ends, landing[None]])
    cost = engine_fuel_kg(params, demand_w[:, None] - power)
    cost += shortfall_price_kg_per_j * params.dt_s * short_w
    cost[2] = np.where((lb <= landing) & (landing <= ub), cost[2], np.inf)
    return lb, ub, power, cost


def end_powers_w(
    params: PowertrainParams, demand_w: FloatArray, soc_grid: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """lb and ub (T, N) of every node, both again as candidates (2, T, N), and the demand that
    nothing can meet (T, N) [W].

    Where lb > ub no choice is left, and both ends become what the plant then does: everything
    for the load, or braking into the battery.
    """
    demand = demand_w[:, None]
    charge_w, discharge_w = _battery.power_limits_w(params.battery, soc_grid[:-1], params.dt_s)
    engine_max_w = engine_knots_w(params)[-1]
    lb = np.maximum(-charge_w, demand - engine_max_w)
    ub = np.minimum(discharge_w, demand)
    short_w = np.maximum(demand - engine_max_w - discharge_w, 0.0)
    only = np.where(short_w > 0.0, discharge_w, -charge_w)
    ends = np.where(lb > ub, only, np.stack([lb, ub]))
    return lb, ub, ends, short_w


def landing_power_w(
    params: PowertrainParams, soc: FloatArray, soc_after: FloatArray | float
) -> FloatArray:
    """Battery power that takes ``soc`` to ``soc_after`` in one step, limits aside [W]."""
    return (soc - soc_after) * params.battery.energy_j / params.dt_s


def soc_moves(params: PowertrainParams, power_w: FloatArray) -> FloatArray:
    """SOC change of each power, shape (A,): a lossless battery moves alike from every SOC.

    Discharging is taken from the window's top and charging from its bottom, where neither meets
    a limit before it would anywhere else.
    """
    battery = params.battery
    start = np.where(power_w > 0.0, battery.soc_max, battery.soc_min)
    return _battery.soc_after(battery, start, power_w, params.dt_s) - start
