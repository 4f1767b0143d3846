"""Load levelling: the engine at the slow mean of the demand, the battery takes the rest.

Needs no future and, for light work, stops the engine between stretches of running.
"""

from dataclasses import dataclass

import numpy as np

from tractor_ems.policies.genset import power_max_w
from tractor_ems.policies.protocol import limits_of
from tractor_ems.policies.reserve import beyond_battery_w, hold_power_w, must_hold, recent_peak_w
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import DemandFilter, Observation, ObservationSpec
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.powertrain import (
    Command,
    PowertrainParams,
    feasible_battery_power_w,
    project,
)


@dataclass(frozen=True)
class LoadLevelling:
    """The engine gives what the work needs on average and what brings SOC back to its target:

        P = mean(P_dem) + E (SOC_target - SOC) / soc_time_s

    A running engine gives ``max(P, least_share P_max)`` and stops when P falls to
    ``stop_share P_max``; a stopped one starts when P reaches ``start_share P_max``. P_max is
    the engine's most at the bus. In heavy work P stays high and the engine never stops. In light
    work the engine gives more than the mean, SOC rises until P falls to the stop, and SOC swings
    by ``(start_share - stop_share) P_max soc_time_s / E``: 0.11 on "field". Where an
    engine is not back at once (see ``reserve``) it is started for demand that the battery should
    not carry alone, and held, idling where P is none, while such peaks are recent.

    Attributes:
        powertrain: what it drives.
        mean_time_s: time constant of the mean, > 0 [s]; several passes with their turns.
        soc_time_s: a SOC error is paid back at the rate that would end it in this time, > 0 [s].
        least_share, start_share, stop_share: shares of P_max, stop < start.

    Raises PolicyError where a setting is out of range.
    """

    powertrain: PowertrainParams
    mean_time_s: float = 150.0
    soc_time_s: float = 150.0
    least_share: float = 0.5
    start_share: float = 0.4
    stop_share: float = 0.0
    name: str = "load_levelling"

    def __post_init__(self) -> None:
        for name in ("mean_time_s", "soc_time_s"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise PolicyError(f"load_levelling.{name}: {value}, allowed finite and > 0")
        if not 0.0 <= self.least_share <= 1.0:
            raise PolicyError(f"load_levelling.least_share: {self.least_share}, allowed 0..1")
        if not -1.0 <= self.stop_share < self.start_share <= 1.0:
            raise PolicyError(
                f"load_levelling.stop_share, start_share: {self.stop_share}, {self.start_share}, "
                "allowed -1 <= stop < start <= 1"
            )

    @property
    def spec(self) -> ObservationSpec:
        """The slow mean comes as the observation's only feature."""
        return ObservationSpec(filters=(DemandFilter("low_pass", self.mean_time_s),))

    def init(self, batch: int) -> FloatArray:
        """No peak seen, shape (B,). The mean is observed, and so is whether the engine runs."""
        return np.zeros(batch)

    def act(self, observation: Observation, state: FloatArray) -> tuple[Command, FloatArray]:
        """Engine at the level or off; both projected on what the battery allows."""
        most_w = power_max_w(self.powertrain)
        gain_w = self.powertrain.battery.energy_j / self.soc_time_s
        level_w = observation.features[:, 0] + gain_w * (observation.soc_target - observation.soc)
        demand_w = observation.power_demand_w
        peak_w = recent_peak_w(self.powertrain, state, demand_w)
        discharge_w = observation.discharge_limit_w
        needed_w = beyond_battery_w(self.powertrain, demand_w, discharge_w)
        wanted = level_w > np.where(
            observation.engine_on, self.stop_share * most_w, self.start_share * most_w
        )
        held = observation.engine_on & must_hold(self.powertrain, peak_w, discharge_w)
        run = wanted | held | (needed_w > 0.0)
        least_w = np.where(wanted, self.least_share * most_w, 0.0)
        hold_w = hold_power_w(self.powertrain, peak_w, discharge_w)
        engine_w = np.maximum.reduce([level_w, least_w, needed_w, hold_w])
        lb, ub = feasible_battery_power_w(limits_of(observation), demand_w)
        battery_w = project(np.where(run, demand_w - engine_w, demand_w), lb, ub)
        return Command(battery_w, np.where(run, np.nan, 0.0)), peak_w
