"""Drives the optimum of one known cycle: acts from the cost to go on the actual state.

A reference, not a controller: it knows the whole cycle beforehand and refuses any other.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tractor_ems.optimal.bracket import plan_policy
from tractor_ems.optimal.dp import (
    DpSolution,
    cost_to_go_kg,
    engine_fuel_kg,
    engine_knots_w,
    landing_power_w,
    solve,
)
from tractor_ems.optimal.engine_dp import has_engine_state, solve_engine
from tractor_ems.policies.cycle_tick import tick_of
from tractor_ems.policies.planned import PlannedPolicy
from tractor_ems.policies.protocol import limits_of
from tractor_msgs_py.codec import wire_soc
from tractor_msgs_py.errors import PolicyError, RunAborted
from tractor_msgs_py.observation import Observation, ObservationSpec
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.battery import soc_after
from tractor_sim.powertrain import (
    Command,
    PowertrainParams,
    battery_power_grid_w,
    feasible_battery_power_w,
    project,
)
from tractor_sim.powertrain_json import powertrain_hash


@dataclass(frozen=True)
class DpMemory:
    """What the policy remembers: the stamp of tick 0 [ns], and the SOC it expects to see next,
    shape (B,). None before the first tick."""

    t0_ns: int | None
    soc: FloatArray | None


@dataclass(frozen=True)
class DpPolicy:
    """Least fuel of this step plus V_{k+1} of where it leads, over the candidates of the DP.

    The SOC on the wire is a float32, 20 J coarse on "paper". The policy counts the SOC itself
    and goes on with its own count for as long as that rounds to what it sees, so that a run
    which has to be followed exactly is followed exactly.

    Attributes:
        params: the powertrain that ``solution`` was made for.
        solution: its cycle is the only one this policy drives.
        t0_ns: stamp of tick 0; None: the first tick seen is tick 0.

    Raises:
        PolicyError: the solution is of another powertrain.
    """

    params: PowertrainParams
    solution: DpSolution
    t0_ns: int | None = None
    name: str = "dp"

    def __post_init__(self) -> None:
        made_for, given = self.solution.powertrain_hash, powertrain_hash(self.params)
        if made_for != given:
            raise PolicyError(
                f"dp: solution of powertrain {made_for[:12]}, cannot drive {self.params.name} "
                f"({given[:12]})"
            )

    @property
    def spec(self) -> ObservationSpec:
        """No filters; the step length of the powertrain."""
        return ObservationSpec(dt_s=self.params.dt_s)

    def init(self, batch: int) -> DpMemory:
        """Nothing seen yet."""
        initial = self.solution.soc_initial
        return DpMemory(self.t0_ns, None if initial is None else np.full(batch, initial))

    def act(self, observation: Observation, state: DpMemory) -> tuple[Command, DpMemory]:
        """The command of every run of the batch.

        Raises:
            RunAborted: the tick is not in the solved cycle, its demand is not the solved one, or
                the SOC is further from the solved range than one step reaches.
        """
        params, solution = self.params, self.solution
        t0_ns = observation.stamp_ns if state.t0_ns is None else state.t0_ns
        k = tick_of(solution.power_demand_w, observation, t0_ns, params.dt_s)
        soc = observation.soc
        if state.soc is not None:
            soc = np.where(wire_soc(state.soc) == soc, state.soc, soc)
        self._check_soc(k, soc)
        demand_w = observation.power_demand_w[:, None]
        lb, ub = feasible_battery_power_w(limits_of(observation), observation.power_demand_w)
        candidates_w = project(self._candidates_w(k, demand_w, soc), lb[:, None], ub[:, None])
        after = soc_after(params.battery, soc[:, None], candidates_w, params.dt_s)
        cost_kg = engine_fuel_kg(params, demand_w - candidates_w)
        cost_kg = cost_kg + cost_to_go_kg(solution, k + 1, after)
        chosen = np.arange(len(soc)), np.argmin(cost_kg, axis=1)
        battery_w = candidates_w[chosen]
        engine_off = battery_w >= observation.power_demand_w
        command = Command(battery_w, np.where(engine_off, 0.0, np.nan))
        return command, DpMemory(t0_ns, after[chosen])

    def _candidates_w(self, k: int, demand_w: FloatArray, soc: FloatArray) -> FloatArray:
        """Shape (B, candidates), limits aside. Knots, off among them, and the landing come
        before the grid, so that a tie goes to them; lb and ub come out of the projection."""
        grid_w = self._grid_w
        landing_w = landing_power_w(self.params, soc, self.solution.landing_soc[k])
        every_w = np.broadcast_to(grid_w, (len(soc), len(grid_w)))
        return np.concatenate([demand_w - self._knots_w, landing_w[:, None], every_w], axis=1)

    @cached_property
    def _knots_w(self) -> FloatArray:
        return engine_knots_w(self.params)

    @cached_property
    def _grid_w(self) -> FloatArray:
        return battery_power_grid_w(self.params, self.solution.actions)

    def _check_soc(self, k: int, soc: FloatArray) -> None:
        battery, row = self.params.battery, self.solution.soc_grid[k]
        step = battery.power_max_w * self.params.dt_s / battery.energy_j
        low, high = float(row[0]), float(row[-1])
        outside = ~((soc >= low - step) & (soc <= high + step))
        if outside.any():
            raise RunAborted(
                f"dp: tick {k}: SOC is {soc[np.argmax(outside)]}, solved for {low}..{high} "
                f"(a run from {self.solution.soc_initial} to {self.solution.soc_target})"
            )


def solve_policy(
    params: PowertrainParams, cycle_demand_w: FloatArray, soc_initial: float, soc_target: float
) -> DpPolicy | PlannedPolicy:
    """The policy of a cycle from one SOC to another; ``cycle_demand_w`` (T,) as it appears at the
    bus, auxiliaries included [W]. On a plant with engine state it drives the run that the bracket
    of the certificate is about. Raises what ``dp.solve`` or ``engine_dp.solve_engine`` raise."""
    if has_engine_state(params):
        return plan_policy(params, solve_engine(params, cycle_demand_w, soc_initial, soc_target))
    solution = solve(params, cycle_demand_w, soc_target, soc_initial=soc_initial)
    return DpPolicy(params, solution)
