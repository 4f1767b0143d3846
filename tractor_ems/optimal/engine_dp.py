"""Least fuel for a known cycle on a plant with engine memory or battery losses: state (SOC, on).

The model is relaxed: a start costs its fuel, but there is no ramp limit and no minimum time, so
what it finds no run of the plant can beat. What the plant makes of it is ``bracket``; whether the
grid is fine enough is ``certificate``; plants without memory and losses are ``dp``.
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from tractor_ems.optimal.dp import engine_knots_w
from tractor_ems.optimal.engine_kernel import (
    Model,
    Numbers,
    Rows,
    backward,
    co_states,
    forward,
    row_of,
    value_at,
)
from tractor_ems.optimal.engine_plan import EnginePlan, driven
from tractor_ems.optimal.engine_reach import of_use, reachable
from tractor_msgs_py.errors import ConfigError, CycleError
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.engine import fuel_rate_kg_per_s
from tractor_sim.generator import to_crank_w
from tractor_sim.powertrain import PowertrainParams
from tractor_sim.powertrain_json import powertrain_hash

CELL_J, FULL_STEPS, LEAST_CELL_J = 80e3, 1800, 5e3
"""Distance of SOC nodes in the first pass over the whole window, for a cycle of so many steps or
more; a shorter one gets finer nodes in proportion, which cost no more."""

REFINEMENT = 4
"""How much finer the nodes of the second pass are, in a band around the first one's optimum."""

BAND_CELLS = 120
"""Half width of that band in cells of the first pass; doubled for as long as the optimum of the
second pass touches its edge."""

FUEL_POINTS = 4097
"""Entries of the fuel table: 62 W apart on "field"."""

PRICE_MULTIPLE = 2e4
"""Price of a joule missing at the end in units of the largest marginal fuel: a few hundred joules
too little cost more than a start, so the end is met wherever it can be."""

SHORTFALL_MULTIPLE = 10.0
"""Price of unmet demand in units of that price."""

EVERY_NODE = 8_000_000
"""Up to so many landings in a pass (steps times nodes times the nodes that one step reaches) all
are tried; beyond, every node that is :data:`STRIDE_J` from the next, then all around the best."""

STRIDE_J = 20e3

MAX_VALUES = 24_000_000
"""Entries of the two value tables together, 190 MB. A longer cycle gets wider cells."""


@dataclass(frozen=True)
class EngineSolution:
    """The optimum of the relaxed model.

    Attributes:
        plan: the optimal run, as ``powertrain.step`` without ramp and minimum times drives it.
        value_kg: V at the start; with a price at the end, net of the energy gained.
        cost_kg: what ``plan`` costs in the same terms.
        co_state_kg_per_j: (T,), what one more joule in the battery saves from step k on,
            -dV_k/dE along the optimum, with E = SOC times nominal energy.
        power_demand_w: (T,), the cycle it holds for, auxiliaries included [W].
        soc_target: where it had to end, or None.
        end_price_kg_per_j: what a joule at the end was worth, or None.
        cell_j: real distance of the finer nodes [J]; band: (2, T + 1), where they were laid.
        powertrain_hash: the powertrain it holds for.
    """

    plan: EnginePlan
    value_kg: float
    cost_kg: float
    co_state_kg_per_j: FloatArray
    power_demand_w: FloatArray
    soc_target: float | None
    end_price_kg_per_j: float | None
    cell_j: float
    band: FloatArray
    powertrain_hash: str

    @property
    def lower_bound_kg(self) -> float:
        """The least of value and cost: interpolation may overestimate the one, and the other is
        a run that can be driven on the relaxed plant."""
        return min(self.value_kg, self.cost_kg)


def has_engine_state(params: PowertrainParams) -> bool:
    """Whether a plant needs this module: engine memory, or a battery that is not lossless."""
    engine = params.engine
    memory = engine.start_fuel_kg > 0.0 or math.isfinite(engine.ramp_w_per_s)
    return memory or engine.min_on_s > 0.0 or engine.min_off_s > 0.0 or not params.battery.lossless


def relaxed(params: PowertrainParams) -> PowertrainParams:
    """The plant without ramp limit and minimum times."""
    engine = dataclasses.replace(params.engine, ramp_w_per_s=math.inf, min_on_s=0.0, min_off_s=0.0)
    return dataclasses.replace(params, engine=engine)


def usual_cell_j(steps: int) -> float:
    """Distance of the nodes of the first pass for a cycle of that many steps [J]."""
    return min(max(CELL_J * steps / FULL_STEPS, LEAST_CELL_J), CELL_J)


def solve_engine(
    params: PowertrainParams,
    power_demand_w: FloatArray,
    soc_initial: float,
    soc_target: float | None,
    *,
    end_price_kg_per_j: float | None = None,
    cell_j: float | None = None,
    max_values: int = MAX_VALUES,
) -> EngineSolution:
    """Solve one cycle from ``soc_initial`` with the engine off.

    Args:
        power_demand_w: (T,), demand at the bus, auxiliaries included [W].
        soc_target: SOC to end at (the nearest where it cannot be reached): ending above costs
            nothing, below more than any way to avoid it. None: the end is free.
        end_price_kg_per_j: only with a free end: what a joule left at the end is worth, >= 0.
        cell_j: distance of the nodes of the first pass, > 0, by default :func:`usual_cell_j`; a
            second one is :data:`REFINEMENT` times finer.
        max_values: entries of the value tables together; more makes the cells wider.

    Raises:
        ConfigError: a SOC, price or cell is out of range.
        CycleError: the demand is empty or not finite.
    """
    demand_w = np.ascontiguousarray(power_demand_w, dtype=np.float64)
    cell_j = usual_cell_j(demand_w.size) if cell_j is None else cell_j
    _check(params, demand_w, soc_initial, soc_target, end_price_kg_per_j, cell_j)
    model = model_of(params)
    low, high = soc_of_use(model, demand_w, soc_initial, soc_target, end_price_kg_per_j)
    price_kg = (end_price_kg_per_j or 0.0) * params.battery.energy_j
    cell = _affordable(low, high, cell_j / params.battery.energy_j, max_values)
    soc, _, _, _ = _pass(params, model, demand_w, low, high, soc_initial, price_kg, cell)
    fine = cell_j / REFINEMENT / params.battery.energy_j
    half = BAND_CELLS * REFINEMENT * fine
    while True:
        # The band leaves the ends of the tube what they are: there it is exact.
        band_low = np.maximum(low, np.minimum(soc - half, high))
        band_high = np.minimum(high, np.maximum(soc + half, low))
        cell = _affordable(band_low, band_high, fine, max_values)
        found = _pass(params, model, demand_w, band_low, band_high, soc_initial, price_kg, cell)
        soc, plan, values, co_state = found
        margin = half / 20.0
        touched = ((band_low > low) & (soc < band_low + margin)) | (
            (band_high < high) & (soc > band_high - margin)
        )
        if not touched.any():
            break
        half *= 2.0
    value_kg, cost_kg = values
    return EngineSolution(
        plan=plan,
        value_kg=value_kg,
        cost_kg=cost_kg,
        co_state_kg_per_j=co_state / params.battery.energy_j,
        power_demand_w=demand_w,
        soc_target=soc_target,
        end_price_kg_per_j=end_price_kg_per_j,
        cell_j=cell * params.battery.energy_j,
        band=np.stack([band_low, band_high]),
        powertrain_hash=powertrain_hash(params),
    )


def _pass(
    params: PowertrainParams,
    model: Model,
    demand_w: FloatArray,
    low: FloatArray,
    high: FloatArray,
    soc_initial: float,
    end_price_kg: float,
    cell: float,
) -> tuple[FloatArray, EnginePlan, tuple[float, float], FloatArray]:
    """SOC of the optimum on one grid, its run, (value, cost) and the co-state per SOC."""
    steps = len(demand_w)
    rows = rows_of(model, demand_w, low, high, cell)
    nodes = int(rows.nodes.max())
    on, off = np.empty((steps + 1, nodes)), np.empty((steps + 1, nodes))
    last = np.clip(rows.base[-1] + rows.cell * np.arange(nodes), low[-1], high[-1])
    on[-1] = off[-1] = end_price_kg * (soc_initial - last)
    cell_j = cell * params.battery.energy_j
    stride = max(1, round(STRIDE_J / cell_j))
    reach_w = min(model.numbers.engine_max_w, 2.0 * params.battery.power_max_w)
    if float(rows.nodes.sum()) * reach_w * params.dt_s / cell_j <= EVERY_NODE:
        stride = 1
    backward(on, off, rows, demand_w, model, stride)
    value_kg = value_at(off[0], row_of(rows, 0), soc_initial, model.numbers.missing_kg)
    soc, engine_on = np.empty(steps + 1), np.empty(steps, dtype=np.bool_)
    battery_w, co_state = np.empty(steps), np.empty(steps)
    soc[0] = soc_initial
    end_kg = forward(on, off, rows, demand_w, model, soc, battery_w, engine_on)
    reach = params.battery.power_max_w * params.dt_s / params.battery.energy_j
    co_states(on, off, rows, model, soc, engine_on, reach, co_state)
    held = params.engine.min_on_s > 0.0
    plan = driven(relaxed(params), held, demand_w, soc, demand_w - battery_w, engine_on)
    return soc, plan, (value_kg, float(plan.fuel_kg.sum()) + end_kg), co_state


def soc_of_use(
    model: Model,
    demand_w: FloatArray,
    soc_initial: float,
    soc_target: float | None,
    end_price_kg_per_j: float | None,
) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest SOC of every step, (T + 1,) each, that a run can pass through and still
    meet demand and end; what cannot be reached counts as the nearest that can."""
    low, high = np.empty(len(demand_w) + 1), np.empty(len(demand_w) + 1)
    reachable(model, demand_w, soc_initial, low, high)
    least, most = low.copy(), high.copy()
    if soc_target is not None:
        least[-1] = most[-1] = min(max(soc_target, low[-1]), high[-1])
    elif end_price_kg_per_j is None:
        most[-1] = low[-1]
    of_use(model, demand_w, least, most)
    lowest, highest = np.maximum(low, least), np.minimum(high, most)
    # Where no run meets all of the demand the two may cross: what is reachable then goes first.
    lowest = np.minimum(lowest, high)
    return lowest, np.maximum(highest, lowest)


def nearest_end_soc(
    params: PowertrainParams, power_demand_w: FloatArray, soc_initial: float, soc_final: float
) -> float:
    """The SOC nearest to ``soc_final`` that a run from ``soc_initial`` can end at."""
    low, high = np.empty(len(power_demand_w) + 1), np.empty(len(power_demand_w) + 1)
    reachable(model_of(params), np.asarray(power_demand_w, float), soc_initial, low, high)
    return float(np.clip(soc_final, low[-1], high[-1]))


def rows_of(
    model: Model, demand_w: FloatArray, low: FloatArray, high: FloatArray, cell: float
) -> Rows:
    """Nodes every ``cell`` of SOC between ``low`` and ``high``, shifting with the demand."""
    numbers = model.numbers
    ocv_v = np.interp(0.5 * (low + high)[:-1], model.ocv[0], model.ocv[1])
    power_w = np.clip(demand_w, -numbers.power_max_w, numbers.power_max_w)
    root_v = np.sqrt(np.maximum(ocv_v**2 - 4.0 * numbers.resistance_ohm * power_w, 0.0))
    taken = 2.0 * power_w / (ocv_v + root_v) / numbers.amps_per_soc
    shift = np.append(0.0, -np.cumsum(taken))
    base = low - np.mod(low - shift, cell)
    nodes = np.ceil((high - base) / cell).astype(np.int64) + 1
    return Rows(base, low, high, np.maximum(nodes, 1), cell)


def model_of(params: PowertrainParams) -> Model:
    """The numbers that the compiled loops work on."""
    engine, battery, dt_s = params.engine, params.battery, params.dt_s
    knots_w = engine_knots_w(params)
    power_w = np.linspace(0.0, knots_w[-1], FUEL_POINTS)
    fuel_kg, at_knots_kg = (_fuel_on_kg(params, at_w) for at_w in (power_w, knots_w))
    slopes = np.diff(at_knots_kg) / np.diff(knots_w)
    kinked = np.abs(np.diff(slopes)) > 1e-3 * np.abs(slopes[:-1])
    marginal = float(np.max(np.diff(fuel_kg) / np.diff(power_w))) / dt_s
    missing_kg_per_j = PRICE_MULTIPLE * marginal
    ocv_soc, ocv_v = battery.ocv_soc, battery.ocv_v
    if not ocv_soc:
        ocv_soc, ocv_v = (0.0, 1.0), (battery.voltage_v, battery.voltage_v)
    numbers = Numbers(
        resistance_ohm=battery.resistance_ohm,
        amps_per_soc=battery.charge_c / dt_s,
        power_max_w=battery.power_max_w,
        charge_max_a=battery.current_max_charge_a,
        discharge_max_a=battery.current_max_discharge_a,
        soc_min=battery.soc_min,
        soc_max=battery.soc_max,
        engine_max_w=float(knots_w[-1]),
        start_kg=engine.start_fuel_kg,
        missing_kg=missing_kg_per_j * battery.energy_j,
        shortfall_kg_per_w=SHORTFALL_MULTIPLE * missing_kg_per_j * dt_s,
        held_on=engine.min_on_s > 0.0,
    )
    return Model(numbers, np.array([ocv_soc, ocv_v]), fuel_kg, knots_w[1:-1][kinked])


def _fuel_on_kg(params: PowertrainParams, bus_w: FloatArray) -> FloatArray:
    """Fuel of one step of the running engine at powers at the bus."""
    crank_w = to_crank_w(params.generator, bus_w, params.engine.power_max_w)
    rate = fuel_rate_kg_per_s(params.engine, crank_w, np.ones(bus_w.shape, dtype=bool))
    return rate * params.dt_s


def _affordable(low: FloatArray, high: FloatArray, cell: float, max_values: int) -> float:
    """The cell [SOC], widened where the tables would pass ``max_values``."""
    nodes = max_values / (2.0 * len(low))
    return max(cell, float(np.max(high - low)) / max(nodes - 3.0, 1.0))


def _check(
    params: PowertrainParams,
    demand_w: FloatArray,
    soc_initial: float,
    soc_target: float | None,
    end_price_kg_per_j: float | None,
    cell_j: float,
) -> None:
    battery = params.battery
    for name, soc in (("soc_initial", soc_initial), ("soc_target", soc_target)):
        if soc is not None and not battery.soc_min <= soc <= battery.soc_max:
            raise ConfigError(f"{name}: {soc}, allowed {battery.soc_min}..{battery.soc_max}")
    if end_price_kg_per_j is not None:
        if soc_target is not None:
            raise ConfigError("end_price_kg_per_j: allowed only without soc_target")
        if not (math.isfinite(end_price_kg_per_j) and end_price_kg_per_j >= 0.0):
            raise ConfigError(f"end_price_kg_per_j: {end_price_kg_per_j}, allowed finite and >= 0")
    if not (math.isfinite(cell_j) and cell_j > 0.0):
        raise ConfigError(f"cell_j: {cell_j}, allowed > 0")
    if demand_w.ndim != 1 or not len(demand_w) or not np.all(np.isfinite(demand_w)):
        raise CycleError(f"power_demand_w: shape {demand_w.shape}, allowed (T,) and finite")
