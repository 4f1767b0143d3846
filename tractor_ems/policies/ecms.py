"""ECMS that never stops a started engine: the least equivalent fuel of the present step at a
price of battery energy that SOC corrects. Needs no future.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tractor_ems.policies.genset import (
    HOLD_ON_W,
    power_knots_w,
    power_max_w,
    running_fuel_kg_per_s,
)
from tractor_ems.policies.protocol import ANY_RUN, limits_of
from tractor_ems.policies.reserve import beyond_battery_w
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import Observation, ObservationSpec
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.battery import discharge_current_a, open_circuit_v
from tractor_sim.powertrain import (
    Command,
    PowertrainParams,
    feasible_battery_power_w,
    project,
)

GRID = 257
"""Engine powers tried besides the knots of the fuel curve: one per kW on "field"."""


@lru_cache(maxsize=32)
def _candidates_w(params: PowertrainParams) -> FloatArray:
    grid_w = np.linspace(HOLD_ON_W, power_max_w(params), GRID)
    return np.union1d(grid_w, power_knots_w(params)[1:])


@dataclass(frozen=True)
class NeverStopEcms:
    """Minimises, at every step, over the engine's power at the bus

        LHV fuel(P_eng) + s V_oc I(P_dem - P_eng),
        s = equivalence (1 + soc_gain (SOC_target - SOC))

    in watts of fuel; V_oc I is what the battery loses inside, resistance included. The engine
    starts when running, at whatever power, costs less than not running, or when the battery
    should not carry the load alone. From then on it idles at least.

    With a full battery and no demand nothing can take the engine's power: the plant stops it then.

    Attributes:
        powertrain: what it drives.
        equivalence: fuel energy per battery energy at the target SOC, > 0. On "field" marginal
            fuel at the bus is 2.34 up to 155 kW and rises beyond, so 2.38 charges gently.
        soc_gain: relative rise of that per unit of SOC below the target, >= 0.

    Raises PolicyError where a setting is out of range.
    """

    powertrain: PowertrainParams
    equivalence: float = 2.38
    soc_gain: float = 1.0
    name: str = "never_stop_ecms"
    spec: ObservationSpec = ANY_RUN

    def __post_init__(self) -> None:
        if not (np.isfinite(self.equivalence) and self.equivalence > 0):
            raise PolicyError(
                f"never_stop_ecms.equivalence: {self.equivalence}, allowed finite and > 0"
            )
        if not (np.isfinite(self.soc_gain) and self.soc_gain >= 0):
            raise PolicyError(f"never_stop_ecms.soc_gain: {self.soc_gain}, allowed finite, >= 0")

    def init(self, batch: int) -> None:
        """No memory: whether the engine runs is observed."""
        return None

    def act(self, observation: Observation, state: None) -> tuple[Command, None]:
        """The cheapest engine power within the present limits, off only before the first start."""
        params = self.powertrain
        demand_w, soc = observation.power_demand_w, observation.soc
        price = self.equivalence * (1.0 + self.soc_gain * (observation.soc_target - soc))
        lb, ub = feasible_battery_power_w(limits_of(observation), demand_w)
        most_w = power_max_w(params)
        engine_w = _candidates_w(params)
        running = demand_w[:, None] - engine_w[None, :]

        # Whether to start is asked without the ramp limit: it lasts seconds, the running does not.
        least_w = np.maximum(-observation.charge_limit_w, demand_w - most_w)
        unhurried = project(running, least_w[:, None], ub[:, None])
        off_cost = self._cost_w(price, soc, demand_w[:, None], demand_w[:, None])[:, 0]
        on_cost = np.min(self._cost_w(price, soc, demand_w[:, None], unhurried), axis=1)
        beyond_w = beyond_battery_w(params, demand_w, observation.discharge_limit_w)
        run = observation.engine_on | (on_cost < off_cost) | (beyond_w > 0.0) | (demand_w > ub)

        candidates_w = project(running, lb[:, None], np.minimum(ub, demand_w - HOLD_ON_W)[:, None])
        cost_w = self._cost_w(price, soc, demand_w[:, None], candidates_w)
        chosen = np.argmin(cost_w, axis=1)[:, None]
        battery_w = np.take_along_axis(candidates_w, chosen, axis=1)[:, 0]
        battery_w = np.where(run, battery_w, project(demand_w, lb, ub))
        return Command(battery_w, np.where(run, np.nan, 0.0)), state

    def _cost_w(
        self, price: FloatArray, soc: FloatArray, demand_w: FloatArray, battery_w: FloatArray
    ) -> FloatArray:
        """Equivalent fuel power (B, N); an engine power below HOLD_ON_W / 2 is off."""
        params = self.powertrain
        engine_w = np.maximum(demand_w - battery_w, 0.0)
        burning = running_fuel_kg_per_s(params, engine_w) * params.engine.fuel_lhv_j_per_kg
        fuel_w = np.where(engine_w >= 0.5 * HOLD_ON_W, burning, 0.0)
        soc = np.broadcast_to(soc[:, None], battery_w.shape)
        inside_w = open_circuit_v(params.battery, soc) * discharge_current_a(
            params.battery, soc, battery_w
        )
        cost: FloatArray = fuel_w + price[:, None] * inside_w
        return cost
