"""The upper end of the bracket: a run of the real plant, ramp limit and minimum times kept.

The optimum of the relaxed model says when the engine runs and what energy is worth. A second,
small programme then chooses engine powers that ramp and minimum times allow, battery energy at
that price, and may move each start and stop a little.
"""

import dataclasses
import itertools
import math
from dataclasses import dataclass

import numpy as np

from tractor_ems.drive import drive
from tractor_ems.optimal.engine_dp import PRICE_MULTIPLE, EngineSolution, model_of, solve_engine
from tractor_ems.optimal.engine_kernel import Model
from tractor_ems.optimal.engine_plan import EnginePlan
from tractor_ems.optimal.engine_reach import follow
from tractor_ems.optimal.ramp_kernel import levels_while, priced_levels
from tractor_ems.policies.planned import PlannedPolicy
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import BoolArray, FloatArray, Trajectory
from tractor_sim.battery import discharge_current_a, power_limits_w
from tractor_sim.engine import fuel_rate_kg_per_s
from tractor_sim.generator import to_bus_w
from tractor_sim.powertrain import PowertrainParams

LEVELS = 110
"""About how many engine powers are told apart: 2.5 kW on "field"."""

MOST_LEVELS = 4000
"""A ramp limit so slow that it takes more is refused: the tables hold as many at every step."""

TRIES = ((10.0, 0.0), (0.0, 0.0), (3.0, 0.0), (10.0, 0.004), (0.0, 0.004), (10.0, 0.015))
"""How far a start or stop may be moved [s], and how far the optimum that is followed keeps off the
ends of the SOC window. Where it uses the whole window, moving a stop may leave no room to end as
it should."""

GOOD_ENOUGH = 1e-3
"""No more is tried once a plan is that close to the relaxed optimum."""

MISSED = 1.5
"""Price of energy missing at the end in units of what it is worth: a plan that ends as it should
is preferred."""

PENALTY_KG = 10.0
"""Price of a step in a state that the schedule does not allow, and of 1 kW of unmet demand."""

PRICE_SPREAD = 1.5
"""The price stays within this factor of its median. At the ends of a cycle, where hardly any
choice is left, the co-state says what the last joule costs, not what energy is worth."""

LEAST_PRICE = 0.1
"""A median of the co-state below that share of the largest marginal fuel means that the optimum
had no choice, and says nothing about what energy is worth: then it is that marginal fuel."""

GROWTH, PRICE_STEP, SEARCH_STEPS = 1.02, 1e-4, 50
"""Of the search for the factor on the price at which the plan ends where it should."""

WIDENINGS = 8
"""Of that search, each by the square of the one before: to a factor of 160 at most."""

STRETCH_S = 1800.0
"""Least length of the parts of a long cycle that are planned one after the other [s]."""


@dataclass(frozen=True)
class _Levels:
    """Engine powers at the crankshaft and at the bus (M,) [W], their fuel per step (M,) [kg], and
    how many levels one step may change by."""

    crank_w: FloatArray
    bus_w: FloatArray
    fuel_kg: FloatArray
    reach: int


def drive_plan(params: PowertrainParams, solution: EngineSolution) -> Trajectory:
    """The optimum as the real plant can drive it, driven."""
    soc = float(solution.plan.soc[0])
    target = soc if solution.soc_target is None else solution.soc_target
    policy = plan_policy(params, solution)
    return drive(policy, params, solution.power_demand_w[None, :], soc, target)[0]


def plan_policy(params: PowertrainParams, solution: EngineSolution) -> PlannedPolicy:
    """The optimum as the real plant can drive it: the cheapest of a few plans."""
    engine, relaxed = params.engine, solution.plan
    demand_w, engine_w, engine_on = (
        solution.power_demand_w,
        relaxed.engine_power_w,
        relaxed.engine_on,
    )
    if math.isinf(engine.ramp_w_per_s) and engine.min_on_s == engine.min_off_s == 0.0:
        return PlannedPolicy(params, demand_w, engine_w, engine_on)
    enough_kg = solution.cost_kg * (1.0 + GOOD_ENOUGH)
    least_kg, followed = math.inf, solution
    for move_s, margin in TRIES:
        if margin > 0.0:
            if _room(params, relaxed) > margin:
                continue
            followed = _with_margin(params, solution, margin)
        cost_kg, power_w, on = _plan(params, followed, move_s)
        if cost_kg < least_kg:
            least_kg, engine_w, engine_on = cost_kg, power_w, on
        if least_kg <= enough_kg:
            break
    return PlannedPolicy(params, demand_w, engine_w, engine_on)


def _room(params: PowertrainParams, plan: EnginePlan) -> float:
    """How far the optimum stays off the ends of the SOC window."""
    battery, soc = params.battery, plan.soc
    return min(float(soc.min()) - battery.soc_min, battery.soc_max - float(soc.max()))


def _plan(
    params: PowertrainParams, solution: EngineSolution, move_s: float
) -> tuple[float, FloatArray, BoolArray]:
    """A plan that moves starts and stops by ``move_s`` at most: what it costs with unmet demand
    and a missed end priced [kg], engine power at the bus and on or off (T,)."""
    relaxed, demand_w, engine = solution.plan, solution.power_demand_w, params.engine
    levels, model = _levels(params), model_of(params)
    price_kg = solution.co_state_kg_per_j * params.battery.energy_j
    middle, largest = float(np.median(price_kg)), largest_marginal_kg(model)
    if middle < LEAST_PRICE * largest:
        middle = largest
    price_kg = np.clip(price_kg, middle / PRICE_SPREAD, middle * PRICE_SPREAD)
    chosen = np.empty(len(demand_w), dtype=np.int64)
    on_kg, off_kg = _costs(params, levels, demand_w, relaxed.soc[:-1], price_kg)
    move = round(move_s / params.dt_s)
    may_run, may_stand = _within(move, relaxed.engine_on), _within(move, ~relaxed.engine_on)
    priced_levels(
        on_kg + PENALTY_KG * ~may_run[:, None],
        off_kg + PENALTY_KG * ~may_stand,
        engine.start_fuel_kg,
        levels.reach,
        max(1, math.ceil(engine.min_on_s / params.dt_s - 1e-9)),
        max(1, math.ceil(engine.min_off_s / params.dt_s - 1e-9)),
        chosen,
    )
    engine_on = chosen >= 0
    plan_w, soc, short_j = np.zeros(len(demand_w)), float(relaxed.soc[0]), 0.0
    for begin, end in _stretches(engine_on, round(STRETCH_S / params.dt_s)):
        part = _Part(
            params,
            model,
            levels,
            demand_w[begin:end],
            relaxed.soc[begin:end],
            price_kg[begin:end],
            engine_on[begin:end],
            soc,
        )
        target = solution.soc_target if end == len(demand_w) else float(relaxed.soc[end])
        plan_w[begin:end] = part.that_ends(target)
        soc, missed_j = part.end(plan_w[begin:end])
        short_j += missed_j
    burning = fuel_rate_kg_per_s(engine, plan_w, engine_on) * params.dt_s
    starts = int(np.sum(engine_on & ~np.append(False, engine_on[:-1])))
    cost_kg = float(burning.sum()) + starts * engine.start_fuel_kg + PENALTY_KG * 1e-3 * short_j
    wanted = float(relaxed.soc[-1]) if solution.soc_target is None else solution.soc_target
    cost_kg += max(middle, largest) * max(wanted - soc, 0.0) * MISSED
    return cost_kg, to_bus_w(params.generator, plan_w, engine.power_max_w), engine_on


def largest_marginal_kg(model: Model) -> float:
    """Largest marginal fuel of the running engine for the energy of a whole SOC [kg], > 0: the
    least that energy missing at an end may cost, whatever the co-state says."""
    return model.numbers.missing_kg / PRICE_MULTIPLE


def _stretches(engine_on: BoolArray, steps: int) -> list[tuple[int, int]]:
    """The cycle in stretches of ``steps`` or more that begin with the engine off: a ramp limit
    does not tie one to the next, so that each can be made to end at the SOC of the relaxed
    optimum, and a long run does not drift away from it."""
    begins = [0]
    for k in np.flatnonzero(~engine_on).tolist():
        if k - begins[-1] >= steps and len(engine_on) - k >= steps:
            begins.append(k)
    return list(itertools.pairwise([*begins, len(engine_on)]))


@dataclass(frozen=True)
class _Part:
    """A stretch of n steps: demand [W], SOC of the relaxed optimum before every step, price of
    energy [kg per SOC] and on or off, each (n,); and where the plan is at its begin."""

    params: PowertrainParams
    model: Model
    levels: _Levels
    power_demand_w: FloatArray
    soc: FloatArray
    price_kg: FloatArray
    engine_on: BoolArray
    soc_begin: float

    def plan_w(self, factor: float) -> FloatArray:
        """The best crankshaft powers (n,) at a multiple of the price [W]."""
        costs_kg, _ = _costs(
            self.params, self.levels, self.power_demand_w, self.soc, factor * self.price_kg
        )
        chosen = np.empty(len(self.soc), dtype=np.int64)
        levels_while(costs_kg, self.engine_on, self.levels.reach, chosen)
        return np.where(self.engine_on, self.levels.crank_w[np.maximum(chosen, 0)], 0.0)

    def end(self, plan_w: FloatArray) -> tuple[float, float]:
        """SOC at the end of a plan, and how much of the demand the battery fails to carry [J]."""
        params = self.params
        engine_w = to_bus_w(params.generator, plan_w, params.engine.power_max_w)
        battery_w = self.power_demand_w - engine_w
        soc, short_w = follow(self.model, battery_w, self.soc_begin)
        return soc, short_w * params.dt_s

    def that_ends(self, target: float | None) -> FloatArray:
        """The plan (n,) [W] that ends at ``target``: between those of two prices of energy.

        Any plan between two that keep to a ramp limit keeps to it too.
        """
        above = below = self.plan_w(1.0)
        if target is None:
            return above
        low = high = 1.0
        growths = [GROWTH ** (2.0**n) for n in range(WIDENINGS)]
        for growth in growths:
            if self.end(above)[0] >= target:
                break
            low, below, high = high, above, high * growth
            above = self.plan_w(high)
        for growth in growths:
            if self.end(below)[0] <= target:
                break
            high, above, low = low, below, low / growth
            below = self.plan_w(low)
        while high - low > PRICE_STEP:
            middle = 0.5 * (low + high)
            plan_w = self.plan_w(middle)
            if self.end(plan_w)[0] >= target:
                high, above = middle, plan_w
            else:
                low, below = middle, plan_w
        share, step = 1.0, 0.5
        for _ in range(SEARCH_STEPS):  # of ``above``, the least that ends at the target
            if self.end(below + (share - step) * (above - below))[0] >= target:
                share -= step
            step *= 0.5
        plan_w = below + share * (above - below)
        return plan_w


def _levels(params: PowertrainParams) -> _Levels:
    """Levels that divide the ramp of one step, and the engine's maximum."""
    peak_w, spacing_w = params.engine.power_max_w, params.engine.power_max_w / LEVELS
    ramp_w, reach = params.engine.ramp_w_per_s * params.dt_s, LEVELS + 1
    if ramp_w < peak_w:
        reach = math.ceil(ramp_w / spacing_w)
        spacing_w = ramp_w / reach
    if peak_w / spacing_w > MOST_LEVELS:
        least = peak_w / MOST_LEVELS / params.dt_s
        raise ConfigError(
            f"engine.ramp_w_per_s: {params.engine.ramp_w_per_s}, allowed >= {least:g} for a plan"
        )
    crank_w = np.append(np.arange(0.0, peak_w - 1.0, spacing_w), peak_w)
    fuel_kg = fuel_rate_kg_per_s(params.engine, crank_w, np.ones(crank_w.shape, dtype=bool))
    bus_w = to_bus_w(params.generator, crank_w, peak_w)
    return _Levels(crank_w, bus_w, fuel_kg * params.dt_s, reach)


def _costs(
    params: PowertrainParams,
    levels: _Levels,
    power_demand_w: FloatArray,
    soc: FloatArray,
    price_kg: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Cost of n steps at every level (n, M) and with the engine off (n,): fuel, and what the
    battery gives at ``price_kg`` (n,) per SOC, taken at ``soc`` (n,)."""
    battery, wide_soc = params.battery, soc[:, None]
    charge_w, discharge_w = power_limits_w(battery, wide_soc, params.dt_s)
    wanted_w = power_demand_w[:, None] - np.append(0.0, levels.bus_w)
    power_w = np.clip(wanted_w, -charge_w, discharge_w)
    wide_soc = np.broadcast_to(wide_soc, power_w.shape)
    taken = discharge_current_a(battery, wide_soc, power_w) * params.dt_s / battery.charge_c
    cost_kg = taken * price_kg[:, None] + np.append(0.0, levels.fuel_kg)
    cost_kg += PENALTY_KG * 1e-3 * np.maximum(wanted_w - discharge_w - 1.0, 0.0)
    return np.ascontiguousarray(cost_kg[:, 1:]), np.ascontiguousarray(cost_kg[:, 0])


def _within(steps: int, state: BoolArray) -> BoolArray:
    """Where ``state`` (T,) is true at most ``steps`` before or after."""
    padded = np.pad(state.astype(np.float64), steps)
    near: BoolArray = np.convolve(padded, np.ones(2 * steps + 1), mode="valid") > 0.5
    return near


def _with_margin(
    params: PowertrainParams, solution: EngineSolution, margin: float
) -> EngineSolution:
    """The optimum that keeps off the ends of the battery's window."""
    battery = params.battery
    ends = [float(solution.plan.soc[0]), float(solution.plan.soc[-1])]
    inside = dataclasses.replace(
        battery,
        soc_min=min(battery.soc_min + margin, *ends),
        soc_max=max(battery.soc_max - margin, *ends),
    )
    return solve_engine(
        dataclasses.replace(params, battery=inside),
        solution.power_demand_w,
        ends[0],
        solution.soc_target,
        end_price_kg_per_j=solution.end_price_kg_per_j,
    )
