"""From recorded demand to a policy of stochastic dynamic programming: features, chain, tables."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from tractor_ems.optimal.one_step_kernel import Cell
from tractor_ems.optimal.sdp import Chain, fit_chain, running_kg, solve_chain
from tractor_ems.policies.genset import power_max_w, running_fuel_kg_per_s
from tractor_ems.policies.sdp import SdpPolicy
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.observation import (
    DemandFilter,
    ObservationSpec,
    init_filters,
    update_filters,
)
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.battery import open_circuit_v
from tractor_sim.powertrain import PowertrainParams

FUEL_KNOTS = 4097
"""Entries of the fuel table over bus power: 61 W apart on "field"."""

TIMES_S = (
    0.0, 25.0, 50.0, 75.0, 100.0, 150.0, 200.0, 300.0, 450.0, 600.0, 900.0, 1200.0, 1800.0,
    2700.0, 3600.0,
)  # fmt: skip
"""Times left at which tables are kept: close together where the end is near."""

EDGES = (
    (0.018, 0.055, 0.09, 0.145, 0.2, 0.255, 0.33, 0.4, 0.47, 0.545, 0.635, 0.73, 0.87),
    (0.073, 0.127, 0.18, 0.255, 0.33, 0.42, 0.53, 0.655),
    (0.11, 0.145, 0.2, 0.27, 0.365, 0.47),
)
"""Inner edges of demand, fast mean and slow mean, in shares of the engine's power."""

SOCS, KEPT = 101, 2
"""SOC points of a table, over the battery's whole window; of which every second is kept: half the
file, the same scores."""


@dataclass(frozen=True)
class SdpSettings:
    """How a chain is counted and what its optimum pays for.

    Attributes:
        planned: with a planned end (a table per time left) or without (one table).
        fast_s, slow_s: time constants of the two means of demand that are features, > 0 [s].
        slow: kind of the slow one; a running mean begins at the recordings' mean.
        price: of SOC, relative to the marginal fuel of a running engine at middle power, > 0;
            no SOC is worth more than it costs to make.
        wall_kg: cost per step where 8 % of half the SOC window are left to its end, rising with
            the 16th power, >= 0 [kg].
        end_kg: planned: cost of a SOC error at the end, > 0 [kg per SOC^2].
        holding_kg, soft_wall_kg, soft_wall_at, most_kg: unplanned: cost of a SOC error per step,
            min(holding e^2 + soft wall (e / at)^8, most) [kg].
        gamma: unplanned: discount per second; sweeps: of value iteration.
        varied: squeezed traces counted beside each recorded one, >= 0.
        seed: of their generator.

    Raises ConfigError where a setting is out of range.
    """

    planned: bool = True
    fast_s: float = 20.0
    slow_s: float = 120.0
    slow: Literal["low_pass", "running_mean"] = "running_mean"
    price: float = 1.02
    wall_kg: float = 2e-3
    end_kg: float = 16.0
    holding_kg: float = 0.008
    soft_wall_kg: float = 3e-4
    soft_wall_at: float = 0.07
    most_kg: float = 6e-4
    gamma: float = 0.998
    sweeps: int = 1000
    varied: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        above = ("fast_s", "slow_s", "price", "end_kg", "soft_wall_at", "sweeps")
        least = ("wall_kg", "holding_kg", "soft_wall_kg", "most_kg", "varied", "seed")
        for name in (*above, *least):
            value = getattr(self, name)
            if not np.isfinite(value) or value < 0 or (value == 0 and name in above):
                raise ConfigError(
                    f"sdp.{name}: {value}, allowed finite, {'>' if name in above else '>='} 0"
                )
        if self.slow not in ("low_pass", "running_mean"):
            raise ConfigError(f"sdp.slow: {self.slow!r}, allowed low_pass, running_mean")
        if not 0.0 < self.gamma < 1.0:
            raise ConfigError(f"sdp.gamma: {self.gamma}, allowed 0 < gamma < 1")
        if self.varied > 10.0 or self.sweeps > 100_000:
            raise ConfigError(
                f"sdp.varied, sweeps: {self.varied}, {self.sweeps}, allowed <= 10, <= 100000"
            )


@dataclass(frozen=True)
class Machine:
    """A powertrain as numbers of the compiled kernels.

    Attributes:
        cell: of the battery; fuel_kg: of one step of the running engine over 0..most power.
        engine_max_w: at the bus; limit_w: of the battery [W].
        marginal_kg: fuel of one unit of SOC made by an engine at middle power [kg].
    """

    cell: Cell
    fuel_kg: FloatArray
    engine_max_w: float
    limit_w: float
    marginal_kg: float


def machine_of(params: PowertrainParams) -> Machine:
    """The numbers of a powertrain."""
    battery, most_w = params.battery, power_max_w(params)
    low_w, high_w = 0.1 * most_w, 0.5 * most_w
    low, high = running_fuel_kg_per_s(params, np.array([low_w, high_w]))
    return Machine(
        cell=Cell(battery.resistance_ohm, battery.charge_c / params.dt_s, battery.power_max_w),
        fuel_kg=running_fuel_kg_per_s(params, np.linspace(0.0, most_w, FUEL_KNOTS)) * params.dt_s,
        engine_max_w=most_w,
        limit_w=battery.power_max_w,
        marginal_kg=float(high - low) / (high_w - low_w) * battery.energy_j,
    )


def features_of(
    filters: Sequence[DemandFilter], traces_w: Sequence[FloatArray], dt_s: float
) -> list[FloatArray]:
    """Demand and its filters, (T, 1 + F) of every trace [W]: what a policy would have seen."""
    spec, longest = ObservationSpec(filters=tuple(filters)), max(map(len, traces_w))
    demand_w = np.zeros((len(traces_w), longest))
    for row, trace_w in zip(demand_w, traces_w, strict=True):
        row[: len(trace_w)] = trace_w
    state, seen = init_filters(spec, len(traces_w)), []
    for k in range(longest):
        state = update_filters(spec, state, demand_w[:, k], dt_s)
        seen.append(np.column_stack((demand_w[:, k], state.values_w)))
    whole = np.stack(seen, axis=1)
    return [whole[i, : len(trace_w)] for i, trace_w in enumerate(traces_w)]


def fit_sdp(
    params: PowertrainParams,
    traces_w: Sequence[FloatArray],
    settings: SdpSettings,
    *,
    more_w: Sequence[FloatArray] = (),
    progress: Callable[[float], None] = lambda done: None,
) -> SdpPolicy:
    """Count a chain in demand traces at the bus (T,) [W] and solve it.

    Args:
        more_w: traces that are counted too, but are not of the mean demand.
        progress: told the share that is done.

    Raises:
        ConfigError: no trace, or one of fewer than two steps.
    """
    if not traces_w or min(map(len, (*traces_w, *more_w))) < 2:
        raise ConfigError("sdp: needs demand traces of two steps at least")
    mean_w = float(np.mean(np.concatenate(traces_w)))
    prior_w = mean_w if settings.slow == "running_mean" else 0.0
    filters = (
        DemandFilter("low_pass", settings.fast_s),
        DemandFilter(settings.slow, settings.slow_s, prior_w),
    )
    edges = tuple(np.array(shares) * params.engine.power_max_w for shares in EDGES)
    chain = fit_chain(edges, features_of(filters, [*traces_w, *more_w], params.dt_s))
    target = params.soc_initial if params.soc_target is None else params.soc_target
    soc = np.linspace(params.battery.soc_min, params.battery.soc_max, SOCS)
    machine = machine_of(params)
    price_kg = settings.price * machine.marginal_kg
    times_s, values = _tables(params, machine, chain, settings, soc, target, price_kg, progress)
    return SdpPolicy(
        params=params,
        filters=filters,
        edges=edges,
        number=chain.number,
        times_s=times_s,
        offset=(soc - target)[::KEPT],
        value_kg=values[:, :, ::KEPT].astype(np.float32).astype(np.float64),
        price_kg=price_kg,
        start_kg=params.engine.start_fuel_kg,
        gamma=1.0 if settings.planned else settings.gamma**params.dt_s,
        name="sdp" if settings.planned else "sdp_unplanned",
    )


def _tables(
    params: PowertrainParams, machine: Machine, chain: Chain, settings: SdpSettings,
    soc: FloatArray, target: float, price_kg: float, progress: Callable[[float], None],
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Times left (K,), and values at them (K, Z, S, 2)."""
    ocv_v, error = open_circuit_v(params.battery, soc), soc - target
    base_kg = running_kg(
        machine.cell, machine.fuel_kg, machine.engine_max_w, float(ocv_v[SOCS // 2]),
        machine.limit_w, chain.demand_w, price_kg,
    )  # fmt: skip
    middle, half = 0.5 * (soc[0] + soc[-1]), 0.5 * (soc[-1] - soc[0])
    holding = settings.wall_kg * (np.abs(soc - middle) / (0.92 * half)) ** 16
    most, gamma = 10.0 * settings.wall_kg, 1.0
    value = np.zeros((len(chain.demand_w), SOCS, 2))
    if settings.planned:
        value += (settings.end_kg * error**2)[None, :, None]
        steps = np.round(np.array(TIMES_S) / params.dt_s).astype(int)
    else:
        far = settings.soft_wall_kg * (error / settings.soft_wall_at) ** 8
        holding = settings.holding_kg * error**2 + far
        most, gamma = settings.most_kg, settings.gamma**params.dt_s
        steps = np.round(np.linspace(0.0, settings.sweeps, 11) / params.dt_s).astype(int)
    holding_kg = np.minimum(holding, most) * params.dt_s
    kept = [value.copy()]
    for before, after in pairwise(steps):
        solve_chain(
            machine.cell, machine.fuel_kg, machine.engine_max_w, ocv_v, machine.limit_w,
            chain.demand_w, chain.first, chain.follower, chain.share, error, price_kg,
            holding_kg, params.engine.start_fuel_kg, gamma, int(after - before), base_kg, value,
        )  # fmt: skip
        kept.append(value.copy())
        progress(float(after / steps[-1]))
    if settings.planned:
        return np.array(TIMES_S), np.stack(kept)
    return np.zeros(1), value[None]
