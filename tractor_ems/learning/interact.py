"""Simulated episodes: an epsilon-greedy Q-network on the plant, over training cycles only."""

from dataclasses import dataclass

import numpy as np

from tractor_ems.drive import drive
from tractor_ems.learning.recorded import Drive, drive_of_trajectory
from tractor_ems.policies.action_grid import feasible_range
from tractor_ems.policies.q_policy import QPolicy, own_limits
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.observation import Observation, ObservationSpec
from tractor_msgs_py.trajectory import BoolArray, FloatArray
from tractor_sim.duty_cycle.library import cycle_names, load_cycle
from tractor_sim.powertrain import Command, PowertrainParams, feasible_battery_power_w, project


@dataclass(frozen=True)
class EpsilonGreedy:
    """Follows a Q-policy except at the ticks where ``explore`` says so; there it takes a uniformly
    drawn action among the feasible ones. Every draw was made beforehand; the state is the tick.

    Attributes:
        greedy: the policy to follow.
        explore: shape (T,).
        draw: uniform in [0, 1), shape (T,).
    """

    greedy: QPolicy
    explore: BoolArray
    draw: FloatArray
    name: str = "epsilon_greedy"

    @property
    def spec(self) -> ObservationSpec:
        """What the greedy policy sees."""
        return self.greedy.spec

    def init(self, batch: int) -> int:
        """The first tick."""
        return 0

    def act(self, observation: Observation, state: int) -> tuple[Command, int]:
        """A random feasible action, or the greedy one."""
        if not self.explore[state]:
            return self.greedy.act(observation, None)[0], state + 1
        demand_w = observation.power_demand_w
        limits = own_limits(self.greedy.params, observation)
        lb, ub = feasible_battery_power_w(limits, demand_w)
        first, last = feasible_range(self.greedy.grid_w, lb, ub)
        index = first + (self.draw[state] * (last - first + 1)).astype(np.int64)
        battery_w = project(self.greedy.grid_w[index], lb, ub)
        return Command(battery_w, np.where(battery_w >= demand_w, 0.0, np.nan)), state + 1


def training_demand_w(name: str, params: PowertrainParams) -> FloatArray:
    """Demand at the bus of a shipped training cycle, shape (T,) [W].

    Raises:
        ConfigError: the cycle steps by another time than the powertrain.
    """
    cycle = load_cycle(name)
    if abs(cycle.dt_s - params.dt_s) > 1e-9:
        raise ConfigError(f"cycle {name}: dt_s {cycle.dt_s}, the powertrain's is {params.dt_s}")
    return cycle.power_demand_w + params.p_aux_w


def episode_cycles(count: int, rng: np.random.Generator) -> list[str]:
    """Names of the cycles of ``count`` episodes, drawn from the training split."""
    names = cycle_names("train")
    return [names[index] for index in rng.integers(0, len(names), count)]


def episode(policy: QPolicy, cycle: str, epsilon: float, rng: np.random.Generator) -> Drive:
    """Drive one episode from a random SOC towards a random target."""
    params = policy.params
    demand_w = training_demand_w(cycle, params)
    window = (params.battery.soc_min, params.battery.soc_max)
    soc_initial, soc_target = rng.uniform(*window, 2)
    explorer = EpsilonGreedy(
        policy, rng.random(len(demand_w)) < epsilon, rng.random(len(demand_w))
    )
    trajectory = drive(explorer, params, demand_w[None, :], soc_initial, soc_target)[0]
    return drive_of_trajectory(trajectory, params, float(soc_target))
