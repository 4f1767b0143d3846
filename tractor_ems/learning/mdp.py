"""The paper's decision process, compiled: one tractor, one step, for loops that learn by driving.

State [P_dem, SOC], action an index. The physics is ``tractor_sim.powertrain.step`` and the
rewards are ``learning.rewards``, scalar by scalar; tests hold them equal. Powertrains with engine
memory (start fuel, minimum times, ramp limit) have a larger state and are refused.
"""

import math
from typing import Literal, NamedTuple

import numpy as np
from numba import njit

from tractor_ems.learning.rewards import (
    GOOD_FROM_W,
    GOOD_TO_W,
    TOP_W,
    RewardConfig,
    RewardKind,
    best_fuel_kg,
    resolve,
)
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.powertrain import ROUNDING_W, PowertrainParams, battery_power_grid_w

ActionMapping = Literal["p_batt_grid", "p_eng_knots"]

_FUEL, _PIECEWISE, _CORRECTED, _EQUIVALENT = range(4)
_REWARDS: dict[RewardKind, int] = {
    "fuel": _FUEL,
    "piecewise": _PIECEWISE,
    "piecewise_corrected": _CORRECTED,
    "equivalent_fuel": _EQUIVALENT,
}


class Mdp(NamedTuple):
    """Numbers and arrays only, so that compiled code can take it.

    Attributes:
        power_demand_w: the cycle at the bus, shape (T,) [W].
        action_power_w: battery powers, increasing (``p_batt_grid``), or engine powers from 0,
            which is off, increasing (``p_eng_knots``); shape (A,) [W].
        engine_actions: ``action_power_w`` are engine powers.
        curve_power_w, curve_efficiency: of the engine; lhv_j_per_kg: of its fuel.
        engine_max_w, battery_max_w, energy_j, soc_min, soc_max, dt_s: of the plant.
        soc_initial, soc_target: of the run.
        reward: which one; cost_unit, best_fuel_kg, lambda0_kg_per_j, kp: its numbers.
    """

    power_demand_w: FloatArray
    action_power_w: FloatArray
    engine_actions: bool
    curve_power_w: FloatArray
    curve_efficiency: FloatArray
    lhv_j_per_kg: float
    engine_max_w: float
    battery_max_w: float
    energy_j: float
    soc_min: float
    soc_max: float
    dt_s: float
    soc_initial: float
    soc_target: float
    reward: int
    cost_unit: float
    best_fuel_kg: float
    lambda0_kg_per_j: float
    kp: float


class GreedyEpisode(NamedTuple):
    """T steps of a greedy policy, by whatever learner.

    Attributes:
        battery_power_w: asked of the plant, shape (T,) [W].
        engine_power_w: at the bus, shape (T,) [W].
        fuel_kg: of every step, shape (T,).
        reward: in the units a learner sees, shape (T,).
        soc: before every step and after the last, shape (T + 1,).
    """

    battery_power_w: FloatArray
    engine_power_w: FloatArray
    fuel_kg: FloatArray
    reward: FloatArray
    soc: FloatArray


def action_powers_w(params: PowertrainParams, mapping: ActionMapping, actions: int) -> FloatArray:
    """Power that each action means, shape (A,) [W].

    ``p_batt_grid``: the paper's, ``actions`` battery powers over -P_b,max..P_b,max, clipped to
    [lb, ub] when used. ``p_eng_knots``: off, and ``actions - 1`` engine powers up to the largest.
    """
    if mapping == "p_batt_grid":
        return battery_power_grid_w(params, actions)
    return np.linspace(0.0, params.engine.power_max_w, actions)


def make_mdp(
    params: PowertrainParams,
    power_demand_w: FloatArray,
    reward: RewardConfig,
    *,
    mapping: ActionMapping,
    actions: int,
    soc_initial: float,
    soc_target: float,
) -> Mdp:
    """Fill in the numbers.

    Raises:
        ConfigError: the powertrain has engine memory, losses in generator or battery, a fuel
            curve or an idle rate, or the reward a price per start: more than these agents know.
    """
    engine, battery = params.engine, params.battery
    simple = (
        ("engine.start_fuel_kg", engine.start_fuel_kg, 0.0),
        ("engine.min_on_s", engine.min_on_s, 0.0),
        ("engine.min_off_s", engine.min_off_s, 0.0),
        ("engine.ramp_w_per_s", engine.ramp_w_per_s, math.inf),
        ("engine.idle_fuel_kg_per_s", engine.idle_fuel_kg_per_s, 0.0),
        ("engine.curve_fuel_kg_per_s", engine.curve_fuel_kg_per_s, ()),
        ("generator.ideal", params.generator.ideal, True),
        ("battery.lossless", battery.lossless, True),
    )
    for name, value, wanted in simple:
        if value != wanted:
            raise ConfigError(
                f"powertrain {params.name}: {name} is {value}, the state [P_dem, SOC] of the "
                f"paper's agents allows {wanted}"
            )
    if reward.kind == "equivalent_fuel" and reward.start_price_kg > 0.0:
        raise ConfigError(
            f"reward.start_price_kg: {reward.start_price_kg}, the state [P_dem, SOC] of the "
            "paper's agents allows 0 (it has no engine state)"
        )
    resolved = resolve(reward, params)
    assert resolved.lambda0_kg_per_j is not None
    return Mdp(
        power_demand_w=np.ascontiguousarray(power_demand_w, dtype=np.float64),
        action_power_w=action_powers_w(params, mapping, actions),
        engine_actions=mapping == "p_eng_knots",
        curve_power_w=np.array(engine.curve_power_w),
        curve_efficiency=np.array(engine.curve_efficiency),
        lhv_j_per_kg=engine.fuel_lhv_j_per_kg,
        engine_max_w=engine.power_max_w,
        battery_max_w=battery.power_max_w,
        energy_j=battery.energy_j,
        soc_min=battery.soc_min,
        soc_max=battery.soc_max,
        dt_s=params.dt_s,
        soc_initial=soc_initial,
        soc_target=soc_target,
        reward=_REWARDS[reward.kind],
        cost_unit=reward.cost_unit,
        best_fuel_kg=best_fuel_kg(params),
        lambda0_kg_per_j=resolved.lambda0_kg_per_j,
        kp=reward.kp,
    )


@njit(cache=True, error_model="numpy")
def bounds_w(mdp: Mdp, demand_w: float, soc: float) -> tuple[float, float]:
    """lb and ub of the battery power; lb > ub means that no choice is left."""
    charge_w = min(max((mdp.soc_max - soc) * mdp.energy_j / mdp.dt_s, 0.0), mdp.battery_max_w)
    discharge_w = min(max((soc - mdp.soc_min) * mdp.energy_j / mdp.dt_s, 0.0), mdp.battery_max_w)
    return max(-charge_w, demand_w - mdp.engine_max_w), min(discharge_w, demand_w)


@njit(cache=True, error_model="numpy")
def feasible_actions(mdp: Mdp, demand_w: float, lb: float, ub: float) -> tuple[int, int]:
    """First and last feasible action, inclusive. The ends are lb and ub themselves: the nearest
    action outside is clipped to them, so off is among the actions whenever off is feasible."""
    power_w = mdp.action_power_w
    top = len(power_w) - 1
    low, high = lb, max(lb, ub)
    if mdp.engine_actions:
        low, high = max(demand_w - max(lb, ub), 0.0), max(demand_w - lb, 0.0)
    first = min(max(int(np.searchsorted(power_w, low, side="right")) - 1, 0), top)
    last = min(max(int(np.searchsorted(power_w, high, side="left")), first), top)
    return first, last


@njit(cache=True, error_model="numpy")
def battery_power_w(mdp: Mdp, action: int, demand_w: float, lb: float, ub: float) -> float:
    """Battery power of an action, clipped to [lb, ub]; where lb > ub it is lb."""
    power_w = float(mdp.action_power_w[action])
    wanted_w = demand_w - power_w if mdp.engine_actions else power_w
    return min(max(wanted_w, lb), max(lb, ub))


@njit(cache=True, error_model="numpy")
def advance(mdp: Mdp, demand_w: float, soc: float, wanted_w: float) -> tuple[float, float, float]:
    """One step with a feasible battery power.

    Returns:
        SOC after the step, engine power at the bus [W], fuel burnt [kg].
    """
    engine_w = min(max(demand_w - wanted_w, 0.0), mdp.engine_max_w)
    if engine_w <= ROUNDING_W:
        engine_w = 0.0
    charge_w = min(max((mdp.soc_max - soc) * mdp.energy_j / mdp.dt_s, 0.0), mdp.battery_max_w)
    discharge_w = min(max((soc - mdp.soc_min) * mdp.energy_j / mdp.dt_s, 0.0), mdp.battery_max_w)
    applied_w = min(max(demand_w - engine_w, -charge_w), discharge_w)
    after = soc - applied_w * mdp.dt_s / mdp.energy_j
    after = min(max(after, min(mdp.soc_min, soc)), max(mdp.soc_max, soc))
    fuel_kg = 0.0
    if engine_w > 0.0:
        fuel_kg = engine_w / (_efficiency(mdp, engine_w) * mdp.lhv_j_per_kg) * mdp.dt_s
    return after, engine_w, fuel_kg


@njit(cache=True, error_model="numpy")
def reward_of(mdp: Mdp, engine_w: float, fuel_kg: float, soc: float, soc_next: float) -> float:
    """Reward of a step, in the units a learner sees (``RewardConfig.cost_unit``)."""
    if mdp.reward == _FUEL:
        return -fuel_kg / mdp.cost_unit
    if mdp.reward == _PIECEWISE:
        return _piecewise(mdp, engine_w) / mdp.cost_unit
    error = 0.5 * (soc + soc_next) - mdp.soc_target
    price_kg = mdp.energy_j * mdp.lambda0_kg_per_j * (soc - soc_next) * (1.0 - mdp.kp * error)
    if mdp.reward == _EQUIVALENT:
        return -(fuel_kg + price_kg) / mdp.cost_unit
    outside = 0.0
    if 0.0 < engine_w < GOOD_FROM_W:
        outside = 2e-6 * (GOOD_FROM_W - engine_w)
    elif engine_w > GOOD_TO_W:
        outside = 6e-6 * (engine_w - GOOD_TO_W)
    return -((fuel_kg + price_kg) / mdp.best_fuel_kg + outside) / mdp.cost_unit


@njit(cache=True, error_model="numpy")
def _piecewise(mdp: Mdp, engine_w: float) -> float:
    if engine_w == 0.0:
        return 0.46 + 2.0
    eta = _efficiency(mdp, engine_w)
    if engine_w < GOOD_FROM_W:
        return -0.58 - 2e-6 * (GOOD_FROM_W - engine_w) - eta
    if engine_w <= GOOD_TO_W:
        return eta + 1.0
    if engine_w < TOP_W:
        return -0.06 + 6e-6 * (GOOD_TO_W - engine_w) - eta
    return -2.0


@njit(cache=True, error_model="numpy")
def _efficiency(mdp: Mdp, engine_w: float) -> float:
    x, y = mdp.curve_power_w, mdp.curve_efficiency
    if engine_w >= x[-1]:
        return float(y[-1])
    j = 0
    while x[j + 1] < engine_w:
        j += 1
    slope = (y[j + 1] - y[j]) / (x[j + 1] - x[j])
    return float(slope * (engine_w - x[j]) + y[j])
