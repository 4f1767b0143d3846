"""Rewards: what a step is worth, from plain arrays. No plant state, no learning.

Every reward is the negative of a cost that splits into three parts, so that recorded steps and
all-action backups share one definition:

    r = -(running_cost(P_eng) + start_cost + battery_price(SOC, SOC'))

Arrays broadcast; the leading axis is the batch.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal, get_args

import numpy as np

from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import BoolArray, FloatArray
from tractor_sim.engine import EngineParams, best_power_w, efficiency, fuel_rate_kg_per_s
from tractor_sim.generator import to_bus_w, to_crank_w
from tractor_sim.powertrain import PowertrainParams

RewardKind = Literal["fuel", "piecewise", "piecewise_corrected", "equivalent_fuel"]

ENGINE_OFF_REWARD = 0.46 + 2.0
GOOD_FROM_W, GOOD_TO_W, TOP_W = 1.1e5, 1.9e5, 2.75e5


@dataclass(frozen=True)
class RewardConfig:
    """Which reward, and its settings.

    Attributes:
        kind: ``fuel``: r = -fuel. ``piecewise``: the paper's shaped reward as printed.
            ``piecewise_corrected``: its band and slopes without its slips, see
            :func:`band_penalty`. ``equivalent_fuel``: r = -(fuel + start + price of battery
            energy).
        lambda0_kg_per_j: price of battery energy at the target SOC, > 0; None: the engine's best
            specific fuel, which on a lossless battery is the exact co-state [kg/J].
        kp: relative rise of the price per unit of SOC below the target, >= 0:
            lambda(SOC) = lambda0 (1 + kp (SOC_target - SOC)).
        start_price_kg: least price of an engine start, >= 0 [kg]. Where the plant's own start
            fuel is less, the difference is a price that learning sees and no tank does. It makes
            the engine run in stretches; 0 switches it off. Only ``equivalent_fuel`` has it.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012  (read where YAML is checked)

    kind: RewardKind = "equivalent_fuel"
    lambda0_kg_per_j: float | None = None
    kp: float = 3.0
    start_price_kg: float = 0.002

    def __post_init__(self) -> None:
        if self.kind not in get_args(RewardKind):
            allowed = ", ".join(get_args(RewardKind))
            raise ConfigError(f"reward.kind: {self.kind!r}, allowed {allowed}")
        price = self.lambda0_kg_per_j
        if price is not None and not (np.isfinite(price) and 0 < price <= 1e-6):
            raise ConfigError(f"reward.lambda0_kg_per_j: {price}, allowed 0 < value <= 1e-6")
        for name, most in (("kp", 100.0), ("start_price_kg", 1.0)):
            value = getattr(self, name)
            if not (np.isfinite(value) and 0 <= value <= most):
                raise ConfigError(f"reward.{name}: {value}, allowed 0..{most:g}")

    @property
    def cost_unit(self) -> float:
        """Cost that a network sees as 1: 10 g of fuel, or one unit of a shaped reward."""
        return 1.0 if self.kind.startswith("piecewise") else 0.010


def best_specific_fuel_kg_per_j(params: PowertrainParams) -> float:
    """Least fuel per joule at the bus [kg/J]; 1 / (eta_max LHV) with an ideal generator."""
    engine = params.engine
    crank_w = np.union1d(np.linspace(0.0, engine.power_max_w, 4097)[1:], engine.curve_power_w[1:])
    bus_w = to_bus_w(params.generator, crank_w, engine.power_max_w)
    return float(np.min(fuel_rate_kg_per_s(engine, crank_w) / bus_w))


def best_fuel_kg(params: PowertrainParams) -> float:
    """Fuel of one step at the engine's best-efficiency power [kg]."""
    best_w = np.array(best_power_w(params.engine))
    return float(fuel_rate_kg_per_s(params.engine, best_w) * params.dt_s)


def resolve(config: RewardConfig, params: PowertrainParams) -> RewardConfig:
    """The same reward with its defaults filled in from the plant."""
    if config.lambda0_kg_per_j is not None:
        return config
    return replace(config, lambda0_kg_per_j=_lambda0(params))


@lru_cache(maxsize=16)
def _lambda0(params: PowertrainParams) -> float:
    return best_specific_fuel_kg_per_j(params)


def piecewise_reward(engine: EngineParams, engine_power_w: FloatArray) -> FloatArray:
    """The paper's shaped reward, as printed, of crankshaft power [W] (any shape).

        2.46                                          P = 0
        eta + 1                                       1.1e5 <= P <= 1.9e5
        -0.58 - 2e-6 (1.1e5 - P) - eta                0 < P < 1.1e5
        -0.06 + 6e-6 (1.9e5 - P) - eta                1.9e5 < P < 2.75e5
        -2                                            otherwise

    ``1.1e^5`` in the paper means 1.1 x 10^5. Three properties that it has as printed: engine off
    earns more than any engine point, so its optimum drains the battery to SOC_min; below 110 kW
    it falls as efficiency rises, and it jumps by 2.4 at 110 kW; exactly 275 kW earns -2.
    """
    power_w = np.asarray(engine_power_w, dtype=np.float64)
    eta = efficiency(engine, power_w)
    return np.select(
        [
            power_w == 0.0,
            (power_w >= GOOD_FROM_W) & (power_w <= GOOD_TO_W),
            (power_w > 0.0) & (power_w < GOOD_FROM_W),
            (power_w > GOOD_TO_W) & (power_w < TOP_W),
        ],
        [
            ENGINE_OFF_REWARD,
            eta + 1.0,
            -0.58 - 2e-6 * (GOOD_FROM_W - power_w) - eta,
            -0.06 + 6e-6 * (GOOD_TO_W - power_w) - eta,
        ],
        default=-2.0,
    )


def band_penalty(engine_power_w: FloatArray) -> FloatArray:
    """What the corrected shaped reward takes off outside 110..190 kW of crankshaft power [W].

        0                       P = 0, or 1.1e5 <= P <= 1.9e5
        2e-6 (1.1e5 - P)        0 < P < 1.1e5
        6e-6 (P - 1.9e5)        1.9e5 < P

    The whole reward is r = -((fuel + battery price) / fuel of a step at the best point + penalty).
    Band and slopes are the paper's; each change removes one property of the print:

        engine off earns 2.46, more than any engine point    off has no bonus and no penalty, and
                                                             the battery energy that it takes is
                                                             paid for at lambda(SOC)
        outside the band the reward falls as efficiency      efficiency enters through the fuel,
        rises (its term is -eta there)                       with one sign everywhere
        jumps of 2.4 at 110 kW and 1.9 at 190 kW             the penalty starts from 0 at both
        exactly 275 kW earns -2                              the upper branch has no end
    """
    power_w = np.asarray(engine_power_w, dtype=np.float64)
    below = np.where(power_w > 0.0, 2e-6 * np.maximum(GOOD_FROM_W - power_w, 0.0), 0.0)
    return below + 6e-6 * np.maximum(power_w - GOOD_TO_W, 0.0)


def running_cost(
    config: RewardConfig,
    params: PowertrainParams,
    engine_power_w: FloatArray,
    engine_on: BoolArray | None = None,
) -> FloatArray:
    """Cost of running at a bus power over one step: fuel without start fuel [kg], or the shaped
    rewards' part of it. ``engine_on`` defaults to ``engine_power_w > 0``."""
    engine = params.engine
    crank_w = to_crank_w(params.generator, engine_power_w, engine.power_max_w)
    if config.kind == "piecewise":
        return -piecewise_reward(engine, crank_w)
    fuel_kg = fuel_rate_kg_per_s(engine, crank_w, engine_on) * params.dt_s
    if config.kind == "piecewise_corrected":
        return fuel_kg / best_fuel_kg(params) + band_penalty(crank_w)
    return fuel_kg


def start_cost(config: RewardConfig, params: PowertrainParams) -> float:
    """Cost of one engine start, in the unit of :func:`running_cost`; the printed shaped reward
    knows none."""
    if config.kind == "piecewise":
        return 0.0
    if config.kind == "fuel":
        return params.engine.start_fuel_kg
    if config.kind == "piecewise_corrected":
        return params.engine.start_fuel_kg / best_fuel_kg(params)
    return max(params.engine.start_fuel_kg, config.start_price_kg)


def battery_price(
    config: RewardConfig,
    params: PowertrainParams,
    soc: FloatArray,
    soc_next: FloatArray,
    soc_target: FloatArray,
) -> FloatArray:
    """Phi(SOC) - Phi(SOC'): the price of the battery energy a step took, in the unit of
    :func:`running_cost` ([kg], or [kg] over the best point's fuel for the corrected reward).

    With e = SOC - SOC_target and lambda(SOC) = lambda0 (1 - kp e), the potential is its integral,

        Phi = E lambda0 (e - kp e^2 / 2),

    so over a run the prices telescope to Phi(SOC_0) - Phi(SOC_T): runs that end at one SOC are
    ordered by their fuel alone. Under a discount gamma a share (1 - gamma) Phi(SOC') stays in
    every step, which is what holds SOC at the target. Zero for ``fuel`` and ``piecewise``.
    """
    if config.kind in ("fuel", "piecewise"):
        return np.zeros(np.broadcast_shapes(np.shape(soc), np.shape(soc_next)))
    lambda0 = config.lambda0_kg_per_j
    if lambda0 is None:
        lambda0 = _lambda0(params)
    error = 0.5 * (soc + soc_next) - soc_target
    # Factored, because the difference of two potentials loses the digits of one step.
    price: FloatArray = (
        params.battery.energy_j * lambda0 * (soc - soc_next) * (1.0 - config.kp * error)
    )
    return price / best_fuel_kg(params) if config.kind == "piecewise_corrected" else price


def step_reward(
    config: RewardConfig,
    params: PowertrainParams,
    *,
    fuel_kg: FloatArray,
    engine_power_w: FloatArray,
    engine_on: BoolArray,
    engine_started: BoolArray,
    soc: FloatArray,
    soc_next: FloatArray,
    soc_target: FloatArray,
) -> FloatArray:
    """Reward of recorded steps, from what was applied.

    Args:
        fuel_kg: fuel burnt, start fuel included, as recorded [kg].
        engine_power_w: applied power at the bus [W].
        engine_on, engine_started: engine state during the step, and whether it was started.
        soc, soc_next, soc_target: fractions.

    Returns:
        Shape of the arguments; [kg] negative for the fuel rewards. Divided by
        ``RewardConfig.cost_unit`` it is what a learner sees.
    """
    power_w = np.where(engine_on, engine_power_w, 0.0)
    if config.kind == "piecewise":
        return -running_cost(config, params, power_w)
    if config.kind == "piecewise_corrected":
        crank_w = to_crank_w(params.generator, power_w, params.engine.power_max_w)
        price = battery_price(config, params, soc, soc_next, soc_target)
        return -(fuel_kg / best_fuel_kg(params) + band_penalty(crank_w) + price)
    extra_kg = start_cost(config, params) - params.engine.start_fuel_kg
    cost_kg = fuel_kg + np.where(engine_started, extra_kg, 0.0)
    reward: FloatArray = -(cost_kg + battery_price(config, params, soc, soc_next, soc_target))
    return reward
