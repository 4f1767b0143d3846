"""Driven runs, recorded or simulated, as replay transitions."""

from dataclasses import dataclass

import numpy as np

from tractor_ems.bags.transitions import Trace
from tractor_ems.learning.replay import Transitions
from tractor_ems.learning.rewards import RewardConfig, step_reward
from tractor_ems.learning.samples import servable_demand_w
from tractor_ems.policies.action_grid import applied_index, feasible_range
from tractor_ems.policies.q_policy import Normalisation, demand_inputs, soc_input, state_inputs
from tractor_msgs_py.observation import ObservationSpec, filter_trace
from tractor_msgs_py.trajectory import BoolArray, FloatArray, Trajectory
from tractor_sim.powertrain import (
    PlantState,
    PowertrainParams,
    battery_power_grid_w,
    feasible_battery_power_w,
    power_limits,
)


@dataclass(frozen=True)
class Drive:
    """T driven steps: states at t_0 .. t_T, shape (T + 1,), and what was applied, shape (T,)."""

    power_demand_w: FloatArray
    soc: FloatArray
    engine_on: BoolArray
    time_in_state_s: FloatArray
    battery_power_w: FloatArray
    engine_power_w: FloatArray
    fuel_kg: FloatArray
    soc_target: float


def drive_of_trace(trace: Trace) -> Drive | None:
    """What a bag recorded; None for a demand-only trace, one without a target SOC, and one that
    begins within its run: what the demand filters showed by then is not known."""
    if (
        not trace.from_start
        or trace.soc is None
        or trace.engine_on is None
        or trace.time_in_state_s is None
        or trace.battery_power_w is None
        or trace.engine_power_w is None
        or trace.fuel_kg is None
        or trace.soc_target is None
    ):
        return None
    return Drive(
        trace.power_demand_w,
        trace.soc,
        trace.engine_on,
        trace.time_in_state_s,
        trace.battery_power_w,
        trace.engine_power_w,
        trace.fuel_kg,
        trace.soc_target,
    )


def drive_of_trajectory(
    trajectory: Trajectory, params: PowertrainParams, soc_target: float
) -> Drive:
    """What was simulated; the engine was off before the first step."""
    engine_on = np.concatenate(([False], trajectory.engine_on))
    since = np.arange(len(engine_on))
    changed = np.concatenate(([True], engine_on[1:] != engine_on[:-1]))
    last_change = np.maximum.accumulate(np.where(changed, since, 0))
    before_run_s = max(params.engine.min_off_s, params.engine.min_on_s)
    in_state_s = (since - last_change + (last_change > 0)) * params.dt_s
    return Drive(
        trajectory.power_demand_w,
        np.append(trajectory.soc_observed, trajectory.soc_final),
        engine_on,
        np.where(last_change == 0, before_run_s + since * params.dt_s, in_state_s),
        trajectory.battery_power_w,
        trajectory.engine_power_w,
        trajectory.fuel_kg,
        soc_target,
    )


def replay_transitions(
    drive: Drive,
    params: PowertrainParams,
    reward: RewardConfig,
    spec: ObservationSpec,
    scaling: Normalisation,
    gamma: float,
    actions: int,
) -> Transitions:
    """T - 1 transitions of T steps: the demand after the last one is not known.

    The action is the grid index of the power that was applied, and the reward is evaluated anew
    from what was applied.
    """
    grid_w = battery_power_grid_w(params, actions)
    demand_w, on = servable_demand_w(params, drive.power_demand_w), drive.engine_on
    soc, target = drive.soc[:-1], np.full(len(demand_w), drive.soc_target)
    before_w = np.concatenate(
        (np.where(on[:1], drive.engine_power_w[:1], 0.0), drive.engine_power_w[:-1])
    )
    state = PlantState(soc, on[:-1], drive.time_in_state_s[:-1], before_w)
    lb, ub = feasible_battery_power_w(power_limits(params, state), demand_w)
    first, last = feasible_range(grid_w, lb, ub)
    action = applied_index(grid_w, drive.battery_power_w, on[1:], lb, ub)
    rewards = step_reward(
        reward,
        params,
        fuel_kg=drive.fuel_kg,
        engine_power_w=drive.engine_power_w,
        engine_on=on[1:],
        engine_started=on[1:] & ~on[:-1],
        soc=soc,
        soc_next=drive.soc[1:],
        soc_target=target,
    )
    features_w = filter_trace(spec, demand_w, params.dt_s)
    inputs = state_inputs(
        scaling,
        demand_inputs(scaling, demand_w, features_w),
        soc_input(scaling, soc, target),
        on[:-1],
    )
    count = max(len(demand_w) - 1, 0)
    return Transitions(
        inputs=inputs[:-1],
        action=action[:-1],
        reward=(rewards[:-1] / reward.cost_unit).astype(np.float32),
        discount=np.full(count, gamma, dtype=np.float32),
        next_inputs=inputs[1:],
        first=first[:-1].astype(np.int16),
        last=last[:-1].astype(np.int16),
        next_first=first[1:].astype(np.int16),
        next_last=last[1:].astype(np.int16),
    )
