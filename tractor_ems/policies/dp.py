"""Drives the optimum of one known cycle: acts from the cost to go on the actual state.

A reference, not a controller: it knows the whole cycle beforehand and refuses any other.
"""

from dataclasses import dataclass

import numpy as np

from tractor_ems.optimal.dp import (
    DpSolution,
    engine_fuel_kg,
    engine_knots_w,
    landing_power_w,
    solve,
)
from tractor_ems.policies.protocol import limits_of
from tractor_msgs_py.errors import PolicyError, RunAborted
from tractor_msgs_py.observation import Observation, ObservationSpec
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.battery import soc_after
from tractor_sim.powertrain import (
    ROUNDING_W,
    Command,
    PowertrainParams,
    battery_power_grid_w,
    feasible_battery_power_w,
    project,
)
from tractor_sim.powertrain_json import powertrain_hash


@dataclass(frozen=True)
class DpPolicy:
    """Least fuel of this step plus V_{k+1} of where it leads, over the candidates of the DP.

    Its state is the stamp of its first tick [ns], or None before that.

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
                f"dp solution of powertrain {made_for[:12]}, cannot drive {self.params.name} "
                f"({given[:12]})"
            )

    @property
    def spec(self) -> ObservationSpec:
        """No filters; the step length of the powertrain."""
        return ObservationSpec(dt_s=self.params.dt_s)

    def init(self, batch: int) -> int | None:
        """Stamp of tick 0, where it is known."""
        return self.t0_ns

    def act(self, observation: Observation, state: int | None) -> tuple[Command, int]:
        """The command of every run of the batch.

        Raises:
            RunAborted: the tick is not in the solved cycle, or its demand is not the solved one.
        """
        t0_ns = observation.stamp_ns if state is None else state
        k = self._tick(observation, t0_ns)
        params, solution = self.params, self.solution
        soc, demand_w = observation.soc, observation.power_demand_w
        lb, ub = feasible_battery_power_w(limits_of(observation), demand_w)
        candidates_w = project(
            candidate_powers_w(params, solution, demand_w, soc, lb, ub), lb[:, None], ub[:, None]
        )
        after = soc_after(params.battery, soc[:, None], candidates_w, params.dt_s)
        cost_kg = engine_fuel_kg(params, demand_w[:, None] - candidates_w)
        cost_kg = cost_kg + np.interp(after, solution.soc_grid, solution.values[k + 1])
        chosen = np.argmin(cost_kg, axis=1)[:, None]
        battery_w = np.take_along_axis(candidates_w, chosen, axis=1)[:, 0]
        return Command(battery_w, np.where(battery_w >= demand_w, 0.0, np.nan)), t0_ns

    def _tick(self, observation: Observation, t0_ns: int) -> int:
        solved_w = self.solution.power_demand_w
        k, rest = divmod(observation.stamp_ns - t0_ns, round(self.params.dt_s * 1e9))
        if rest or not 0 <= k < len(solved_w):
            raise RunAborted(
                f"dp: stamp {observation.stamp_ns} ns is tick {k} and {rest} ns, "
                f"the solved cycle has ticks 0..{len(solved_w) - 1} from {t0_ns} ns"
            )
        differs = ~(np.abs(observation.power_demand_w - solved_w[k]) <= ROUNDING_W)
        if np.any(differs):
            seen_w = observation.power_demand_w[np.argmax(differs)]
            raise RunAborted(
                f"dp: tick {k}: power_demand is {seen_w} W, the solved cycle has {solved_w[k]} W"
            )
        return k


def solve_policy(
    params: PowertrainParams, cycle_demand_w: FloatArray, soc_initial: float, soc_target: float
) -> DpPolicy:
    """The policy of a cycle from one SOC to another; ``cycle_demand_w`` (T,) as it appears at the
    bus, auxiliaries included [W]. Raises what :func:`tractor_ems.optimal.dp.solve` raises."""
    solution = solve(params, cycle_demand_w, soc_target, soc_initial=soc_initial)
    return DpPolicy(params, solution)


def candidate_powers_w(
    params: PowertrainParams,
    solution: DpSolution,
    demand_w: FloatArray,
    soc: FloatArray,
    lb: FloatArray,
    ub: FloatArray,
) -> FloatArray:
    """What the programme may choose from, shape (B, candidates), not yet limited to [lb, ub].

    Off, the engine's knots and the exact landing come before the grid, so that a tie goes to
    them.
    """
    knots_w = engine_knots_w(params)
    grid_w = battery_power_grid_w(params, solution.actions)
    batch = len(demand_w)
    return np.concatenate(
        [
            ub[:, None],
            lb[:, None],
            demand_w[:, None] - knots_w[None, :],
            landing_power_w(params, soc, solution.soc_target)[:, None],
            np.broadcast_to(grid_w, (batch, len(grid_w))),
        ],
        axis=1,
    )
