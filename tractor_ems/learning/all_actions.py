"""Running cost of every action at many demands at once, by looking it up in a shifted table.

The engine carries what the battery does not: P_eng = P_dem - P_batt. Over an evenly spaced
action grid that is one function of engine power sampled at a shift that demand decides, so a row
of 1600 costs is a contiguous slice of a table, and no cost is computed in training.
"""

from dataclasses import dataclass

import numpy as np

from tractor_ems.learning.rewards import RewardConfig, running_cost
from tractor_ems.policies.action_grid import feasible_range, in_range
from tractor_ems.policies.mlp import Float32Array
from tractor_msgs_py.trajectory import BoolArray, FloatArray, IntArray
from tractor_sim.generator import to_bus_w
from tractor_sim.powertrain import PowertrainParams, battery_power_grid_w, project

PHASES = 64
"""Shifts per grid step: demand is rounded to 1/64 of 313 W, under 3 W."""


@dataclass(frozen=True)
class CostTable:
    """Running costs while the engine is on, in cost units.

    Attributes:
        rows: shape (PHASES, M, actions), overlapping views of (PHASES, M + actions - 1) costs;
            inf where the engine would have to give nothing or more than it can.
        first_demand_w: demand of the first phase of the last slice [W].
        step_w: demand rounding [W].
        engine_most_w: most the engine can give at the bus [W].
        grid_w: the actions, shape (actions,) [W].
    """

    rows: Float32Array
    first_demand_w: float
    step_w: float
    engine_most_w: float
    grid_w: FloatArray


def build_cost_table(
    reward: RewardConfig,
    params: PowertrainParams,
    actions: int,
    demand_low_w: float,
    demand_high_w: float,
) -> CostTable:
    """The table for demands between two bounds [W]."""
    grid_w = battery_power_grid_w(params, actions)
    spacing_w = float(grid_w[1] - grid_w[0])
    step_w = spacing_w / PHASES
    slices = int((demand_high_w - demand_low_w) / spacing_w) + 2
    phase = np.arange(PHASES)[:, None]
    column = np.arange(slices + actions - 1)[None, :]
    engine_w = demand_low_w + phase * step_w + (slices - 1 - column) * spacing_w - grid_w[0]
    peak_w = params.engine.power_max_w
    most_w = float(to_bus_w(params.generator, np.array(peak_w), peak_w))
    cost = running_cost(reward, params, np.clip(engine_w, 0.0, most_w), engine_w > 0.0)
    cost = np.where((engine_w > 0.0) & (engine_w <= most_w), cost / reward.cost_unit, np.inf)
    rows = np.lib.stride_tricks.sliding_window_view(cost.astype(np.float32), actions, axis=1)
    return CostTable(rows, demand_low_w, step_w, most_w, grid_w)


@dataclass(frozen=True)
class ActionSet:
    """What can be done at B states; the engine-off choice stands apart, it is a jump.

    Attributes:
        running: cost of every action with the engine on, shape (B, actions), inf where
            infeasible [cost units].
        grid_w: the action grid, shape (actions,) [W].
        off_power_w: battery power with the engine off, shape (B,) [W].
        off_feasible: whether that is allowed, shape (B,).
        lb, ub: feasible battery power, shape (B,) [W].
    """

    running: Float32Array
    grid_w: FloatArray
    off_power_w: FloatArray
    off_feasible: BoolArray
    lb: FloatArray
    ub: FloatArray

    def power_w(self, index: IntArray) -> FloatArray:
        """Battery power that an action of every row means, shape (B,) [W]."""
        return project(self.grid_w[index], self.lb, self.ub)


def enumerate_actions(
    table: CostTable,
    reward: RewardConfig,
    params: PowertrainParams,
    power_demand_w: FloatArray,
    lb: FloatArray,
    ub: FloatArray,
) -> ActionSet:
    """Every feasible action of B states; shapes (B,) [W].

    Inner actions come from the table; the two ends of the feasible range, which lie off the
    grid, are computed.
    """
    batch = np.arange(len(power_demand_w))
    grid_w, actions = table.grid_w, len(table.grid_w)
    shift = np.rint((power_demand_w - table.first_demand_w) / table.step_w).astype(np.int64)
    whole, phase = np.divmod(shift, PHASES)
    running: Float32Array = table.rows[phase, table.rows.shape[1] - 1 - whole]
    first, last = feasible_range(grid_w, lb, ub)
    # The table knows the engine's bounds; only rows that the battery bounds need a mask.
    charge_bound = (first > 0) & (lb > power_demand_w - table.engine_most_w)
    discharge_bound = (last < actions - 1) & (ub < power_demand_w)
    rows = np.flatnonzero(charge_bound | discharge_bound)
    running[rows] = np.where(in_range(first[rows], last[rows], actions), running[rows], np.inf)
    off_w = np.maximum(lb, ub)
    off_feasible = off_w >= power_demand_w
    ends_w = np.stack((power_demand_w - lb, power_demand_w - off_w), axis=1)
    engine_w = np.clip(ends_w, 0.0, table.engine_most_w)
    ends = running_cost(reward, params, engine_w, ends_w > 0.0) / reward.cost_unit
    ends = np.where(ends_w > 0.0, ends, np.inf)
    running[batch, last] = ends[:, 1]
    running[batch, first] = np.where(first == last, ends[:, 1], ends[:, 0])
    return ActionSet(running, grid_w, off_w, off_feasible, lb, ub)
