"""Rules that need no model of the future: conventional, best point, the paper's rule base, and
myopic greedy. Load levelling and ECMS stand in files of their own.

Each policy is a frozen dataclass of its settings; memory, where there is any, is its state.
"""

from dataclasses import dataclass

import numpy as np

from tractor_ems.learning.rewards import best_specific_fuel_kg_per_j
from tractor_ems.policies.genset import HOLD_ON_W, best_power_w
from tractor_ems.policies.protocol import ANY_RUN, limits_of
from tractor_ems.policies.reserve import hold_power_w, must_hold, recent_peak_w, starts_slowly
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import Observation, ObservationSpec
from tractor_msgs_py.trajectory import BoolArray, FloatArray
from tractor_sim.engine import fuel_rate_kg_per_s
from tractor_sim.generator import to_crank_w
from tractor_sim.powertrain import (
    Command,
    PowertrainParams,
    battery_power_grid_w,
    feasible_battery_power_w,
    project,
)

NO_STATE = None


def _command(battery_power_w: FloatArray, engine_off: BoolArray) -> Command:
    return Command(battery_power_w, np.where(engine_off, 0.0, np.nan))


@dataclass(frozen=True)
class Conventional:
    """The engine follows the load and idles where there is none; the battery only helps above the
    engine's maximum, while the engine starts or ramps, and takes what flows back.

    Its SOC drifts by that help alone and nothing brings it back.
    """

    name: str = "conventional"
    spec: ObservationSpec = ANY_RUN

    def init(self, batch: int) -> None:
        """No memory."""
        return NO_STATE

    def act(self, observation: Observation, state: None) -> tuple[Command, None]:
        """Zero battery power, projected on the feasible set; never less than idling."""
        demand_w = observation.power_demand_w
        lb, ub = feasible_battery_power_w(limits_of(observation), demand_w)
        battery_w = np.minimum(np.zeros_like(demand_w), demand_w - HOLD_ON_W)
        return _command(project(battery_w, lb, ub), np.zeros(demand_w.shape, bool)), state


@dataclass(frozen=True)
class BestPoint:
    """The engine always at its best-efficiency power while SOC allows; the battery is the slack.

    Best at the bus, generator included. On "paper" this is nearly optimal, so a high score there
    proves little: every table shows it. SOC does not return to its target: in work lighter than
    the best power it ends full, in heavier work empty.

    Where an engine is not back at once (not on the paper's plant) ``margin`` keeps it from the
    ends of its window, where the plant would have to stop the engine: within it the engine goes
    over to following the load, x = 1 to 0, and beyond to bringing SOC back, P = P_dem + x (P_best
    - P_dem).

    Raises PolicyError where ``margin`` is not in 0 < margin <= 0.2.
    """

    powertrain: PowertrainParams
    margin: float = 0.02
    name: str = "best_point"
    spec: ObservationSpec = ANY_RUN

    def __post_init__(self) -> None:
        if not 0.0 < self.margin <= 0.2:
            raise PolicyError(f"best_point.margin: {self.margin}, allowed 0 < margin <= 0.2")

    def init(self, batch: int) -> None:
        """No memory."""
        return NO_STATE

    def act(self, observation: Observation, state: None) -> tuple[Command, None]:
        """Battery power that leaves the engine its best power."""
        best_w = best_power_w(self.powertrain)
        demand_w = observation.power_demand_w
        surplus_w = best_w - demand_w
        engine_w = np.full_like(demand_w, best_w)
        if starts_slowly(self.powertrain):
            battery = self.powertrain.battery
            to_full = (battery.soc_max - self.margin - observation.soc) / self.margin
            to_empty = (observation.soc - battery.soc_min - self.margin) / self.margin
            share = np.clip(np.where(surplus_w > 0.0, to_full, to_empty), -1.0, 1.0)
            engine_w = np.maximum(demand_w + share * surplus_w, HOLD_ON_W)
        lb, ub = feasible_battery_power_w(limits_of(observation), demand_w)
        return _command(
            project(demand_w - engine_w, lb, ub), np.zeros(demand_w.shape, bool)
        ), state


@dataclass(frozen=True)
class RuleState:
    """Memory of the rule base, each of shape (B,): guard engaged, recent peak demand [W]."""

    engaged: BoolArray
    peak_w: FloatArray


@dataclass(frozen=True)
class RuleBased:
    """The paper's rule base: the engine carries demand above ``threshold_w``, the battery the
    rest, with an SOC guard that can be switched off.

    The guard (not in the paper) engages at SOC_min + ``guard_margin`` and holds until
    ``guard_release`` above that: the engine then runs at its best power or the demand, whichever
    is more, and the battery takes the surplus. So SOC stays above SOC_min but does not return to
    its target: in light work it ends just above the guard.

    Where an engine is not back at once (not on the paper's plant) it idles instead of stopping
    while peaks are recent that the battery should not carry alone.
    """

    powertrain: PowertrainParams
    threshold_w: float = 110e3
    soc_guard: bool = True
    guard_margin: float = 0.01
    guard_release: float = 0.02
    name: str = "rule_based"
    spec: ObservationSpec = ANY_RUN

    def init(self, batch: int) -> RuleState:
        """Guard not engaged, no peak seen."""
        return RuleState(np.zeros(batch, dtype=bool), np.zeros(batch))

    def act(self, observation: Observation, state: RuleState) -> tuple[Command, RuleState]:
        """Engine follows the load above the threshold, else off; the guards overrule."""
        demand_w = observation.power_demand_w
        engage_soc = self.powertrain.battery.soc_min + self.guard_margin
        engaged = np.where(
            state.engaged,
            observation.soc < engage_soc + self.guard_release,
            observation.soc < engage_soc,
        )
        peak_w = recent_peak_w(self.powertrain, state.peak_w, demand_w)
        discharge_w = observation.discharge_limit_w
        hold = observation.engine_on & must_hold(self.powertrain, peak_w, discharge_w)
        hold_w = np.where(hold, hold_power_w(self.powertrain, peak_w, discharge_w), 0.0)
        best_w = best_power_w(self.powertrain)
        engine_w = np.where(demand_w > self.threshold_w, demand_w, hold_w)
        engine_w = np.where(engaged & self.soc_guard, np.maximum(demand_w, best_w), engine_w)
        lb, ub = feasible_battery_power_w(limits_of(observation), demand_w)
        command = _command(project(demand_w - engine_w, lb, ub), engine_w <= 0.0)
        return command, RuleState(engaged, peak_w)


@dataclass(frozen=True)
class MyopicGreedy:
    """Least equivalent fuel of the present step, nothing of the future: fuel plus battery energy
    at one fixed price.

    The price is the engine's best specific fuel, the co-state of a lossless battery. It shows
    how much of a learner's score needs no learning. It sees idle and start fuel; a start never
    pays within one step, so it empties the battery first, and on a plant whose engine starts and
    ramps slowly it then fails to meet the demand.
    """

    powertrain: PowertrainParams
    actions: int = 1600
    name: str = "myopic_greedy"
    spec: ObservationSpec = ANY_RUN

    def init(self, batch: int) -> None:
        """No memory."""
        return NO_STATE

    def act(self, observation: Observation, state: None) -> tuple[Command, None]:
        """Search the action grid, clipped to the feasible set."""
        params = self.powertrain
        engine, generator = params.engine, params.generator
        price_kg_per_j = best_specific_fuel_kg_per_j(params)
        demand_w = observation.power_demand_w
        lb, ub = feasible_battery_power_w(limits_of(observation), demand_w)
        grid_w = battery_power_grid_w(params, self.actions)
        candidates_w = project(grid_w[None, :], lb[:, None], ub[:, None])
        engine_w = np.maximum(demand_w[:, None] - candidates_w, 0.0)
        crank_w = to_crank_w(generator, engine_w, engine.power_max_w)
        starts = ~observation.engine_on[:, None] & (engine_w > 0.0)
        start_kg_per_s = np.where(starts, engine.start_fuel_kg / params.dt_s, 0.0)
        cost = fuel_rate_kg_per_s(engine, crank_w) + start_kg_per_s + price_kg_per_j * candidates_w
        chosen = np.argmin(cost, axis=1)[:, None]
        battery_w = np.take_along_axis(candidates_w, chosen, axis=1)[:, 0]
        return _command(battery_w, battery_w >= demand_w), state
