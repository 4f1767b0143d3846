"""Exact optimum of a reward over a known cycle: most undiscounted reward, end where it may.

It tells what a reward asks for, whatever a learner makes of it. The recursion is ``optimal.dp``'s
with the reward's cost in place of fuel and no terminal constraint; battery prices telescope, so
they stand at the end of the run.
"""

from dataclasses import dataclass

import numpy as np

from tractor_ems.drive import drive
from tractor_ems.learning.rewards import (
    GOOD_FROM_W,
    GOOD_TO_W,
    RewardConfig,
    battery_price,
    running_cost,
    start_cost,
)
from tractor_ems.optimal.dp import (
    check_problem,
    end_powers_w,
    engine_knots_w,
    landing_power_w,
    reachable_soc,
    soc_moves,
    soc_tube,
    tube_rows,
)
from tractor_ems.optimal.kernel import backward
from tractor_ems.policies.protocol import ANY_RUN
from tractor_msgs_py.errors import ConfigError, PolicyError
from tractor_msgs_py.observation import Observation, ObservationSpec
from tractor_msgs_py.trajectory import FloatArray, Trajectory
from tractor_sim.battery import power_limits_w, soc_after
from tractor_sim.generator import to_bus_w
from tractor_sim.powertrain import (
    ROUNDING_W,
    Command,
    PowertrainParams,
    battery_power_grid_w,
    project,
)
from tractor_sim.powertrain_json import powertrain_hash

EDGE_W = 1e-3
"""Distance of the extra candidates inside the edges of the band: at an edge itself, rounding of
P_dem - P_batt would decide on which side of the printed reward's jump a step falls."""


@dataclass(frozen=True)
class RewardSolution:
    """Cost to go of one cycle under one reward.

    Attributes:
        soc_grid: (T + 1, N), nodes of every step over all that a run from ``soc_initial`` can
            reach and use, each row increasing.
        values: (T + 1, N), minus the best sum of rewards from step k on, in the unit of
            ``rewards.running_cost``; battery prices counted from ``soc_initial`` at the end.
        landing_soc: (T,), highest SOC after each step that is of use, worth hitting exactly.
        power_demand_w: (T,), the cycle it holds for [W].
        reward: which, its defaults as given.
        soc_initial, soc_target: start, and the target that prices battery energy.
        actions: size of the battery-power grid.
        powertrain_hash: the powertrain it holds for.
    """

    soc_grid: FloatArray
    values: FloatArray
    landing_soc: FloatArray
    power_demand_w: FloatArray
    reward: RewardConfig
    soc_initial: float
    soc_target: float
    actions: int
    powertrain_hash: str

    @property
    def best_return(self) -> float:
        """The optimal sum of rewards, in the units a learner sees."""
        cost = np.interp(self.soc_initial, self.soc_grid[0], self.values[0])
        return -float(cost) / self.reward.cost_unit


def solve_reward(
    params: PowertrainParams,
    power_demand_w: FloatArray,
    reward: RewardConfig,
    *,
    soc_initial: float,
    soc_target: float,
    soc_points: int = 801,
    actions: int = 1600,
) -> RewardSolution:
    """Solve one cycle for one reward.

    Args:
        params: a powertrain without engine memory.
        power_demand_w: (T,), demand at the bus, auxiliaries included [W].
        reward: any kind; ``equivalent_fuel`` without a price per start.
        soc_initial: where the run starts.
        soc_target: prices battery energy; nothing makes the run end there.
        soc_points: nodes of every step's SOC grid, at least 4.
        actions: battery powers over -P_b,max..P_b,max, at least 2. Besides these lb, ub, engine
            off, every knot of the engine curve, the edges 110 and 190 kW, and landing on the
            highest SOC of use are candidates.

    Raises:
        ConfigError: the powertrain has engine memory, the reward a price per start, or a SOC or
            grid size is out of range.
        CycleError: the demand is empty or not finite.
    """
    demand_w = np.ascontiguousarray(power_demand_w, dtype=np.float64)
    check_problem(params, demand_w, soc_target, soc_initial, soc_points, actions)
    if start_cost(reward, params) > 0.0:
        raise ConfigError(
            f"reward.start_price_kg: {reward.start_price_kg}, dynamic programming allows 0 (it "
            "has no engine state)"
        )
    low, high = _soc_of_use(params, demand_w, reward, soc_initial)
    soc_grid, landing_soc = tube_rows(low, high, soc_points), high[1:]
    power_w = battery_power_grid_w(params, actions)
    knots_w = _candidate_engine_w(params)
    lb, ub, ends_w, _ = end_powers_w(params, demand_w, soc_grid)
    landing_w = landing_power_w(params, soc_grid[:-1], landing_soc[:, None])
    nodes_w = np.concatenate([ends_w, landing_w[None]])
    node_cost = _cost(reward, params, demand_w[:, None] - nodes_w)
    node_cost[2] = np.where((lb <= landing_w) & (landing_w <= ub), node_cost[2], np.inf)
    values = np.empty_like(soc_grid)
    values[-1] = battery_price(
        reward, params, np.array(soc_initial), soc_grid[-1], np.array(soc_target)
    )
    backward(
        values,
        soc_grid,
        demand_w,
        power_w,
        soc_moves(params, power_w),
        _cost(reward, params, demand_w[:, None] - power_w[None, :]),
        knots_w,
        _cost(reward, params, knots_w),
        lb,
        ub,
        nodes_w,
        node_cost,
    )
    return RewardSolution(
        soc_grid=soc_grid,
        values=values,
        landing_soc=landing_soc,
        power_demand_w=demand_w,
        reward=reward,
        soc_initial=soc_initial,
        soc_target=soc_target,
        actions=actions,
        powertrain_hash=powertrain_hash(params),
    )


def roll_out_reward(solution: RewardSolution, params: PowertrainParams) -> Trajectory:
    """The optimum driven on the real plant.

    Raises:
        PolicyError: the solution is of another powertrain.
    """
    given = powertrain_hash(params)
    if solution.powertrain_hash != given:
        raise PolicyError(
            f"reward optimum: solution of powertrain {solution.powertrain_hash[:12]}, cannot "
            f"drive {params.name} ({given[:12]})"
        )
    policy = _Planned(_plan_w(solution, params))
    demand_w = solution.power_demand_w[None, :]
    return drive(policy, params, demand_w, solution.soc_initial, solution.soc_target)[0]


def _soc_of_use(
    params: PowertrainParams, demand_w: FloatArray, reward: RewardConfig, soc_initial: float
) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest SOC of every step, (T + 1,) each, that bounds the nodes.

    Where battery energy has no price, SOC is worth nothing above what the rest of the cycle can
    take out of the battery: the value has its kink there, and is flat above.
    """
    if reward.kind in ("fuel", "piecewise"):
        return reachable_soc(params, demand_w, soc_initial, params.battery.soc_min)
    return soc_tube(params, demand_w, soc_initial)


def _cost(
    reward: RewardConfig, params: PowertrainParams, engine_power_w: FloatArray
) -> FloatArray:
    """Cost of one step as the plant drives it: what is below rounding is off."""
    power_w = np.clip(engine_power_w, 0.0, engine_knots_w(params)[-1])
    return running_cost(reward, params, np.where(power_w <= ROUNDING_W, 0.0, power_w))


def _candidate_engine_w(params: PowertrainParams) -> FloatArray:
    """Bus powers that are tried beside the grid, increasing; the first is off."""
    peak_w = params.engine.power_max_w
    edges_w = [GOOD_FROM_W, GOOD_FROM_W + EDGE_W, GOOD_TO_W - EDGE_W, GOOD_TO_W]
    inside_w = np.array([edge_w for edge_w in edges_w if edge_w < peak_w])
    return np.union1d(engine_knots_w(params), to_bus_w(params.generator, inside_w, peak_w))


def _plan_w(solution: RewardSolution, params: PowertrainParams) -> FloatArray:
    """Battery powers of the optimum, shape (T,), each chosen at the SOC that the plant is at."""
    battery, demand_w = params.battery, solution.power_demand_w
    grid_w, knots_w = battery_power_grid_w(params, solution.actions), _candidate_engine_w(params)
    chosen_w = np.empty(len(demand_w))
    soc = np.array([solution.soc_initial])
    for k, power_w in enumerate(demand_w):
        charge_w, discharge_w = power_limits_w(battery, soc, params.dt_s)
        lb = np.maximum(-charge_w, power_w - knots_w[-1])
        ub = np.minimum(discharge_w, power_w)
        # Off, the knots and the landing come before the grid, so that a tie goes to them.
        landing_w = landing_power_w(params, soc, solution.landing_soc[k])
        candidates_w = np.concatenate([power_w - knots_w, landing_w, grid_w])
        candidates_w = project(candidates_w, lb, ub)
        after = soc_after(battery, soc, candidates_w, params.dt_s)
        cost = _cost(solution.reward, params, power_w - candidates_w)
        cost += np.interp(after, solution.soc_grid[k + 1], solution.values[k + 1])
        best = int(np.argmin(cost))
        chosen_w[k], soc = candidates_w[best], after[best : best + 1]
    return chosen_w


@dataclass(frozen=True)
class _Planned:
    """Gives the commands of a plan one by one; its state is the tick."""

    battery_power_w: FloatArray
    name: str = "optimum"
    spec: ObservationSpec = ANY_RUN

    def init(self, batch: int) -> int:
        return 0

    def act(self, observation: Observation, state: int) -> tuple[Command, int]:
        demand_w = observation.power_demand_w
        battery_w = np.full(demand_w.shape, self.battery_power_w[state])
        return Command(battery_w, np.where(battery_w >= demand_w, 0.0, np.nan)), state + 1
