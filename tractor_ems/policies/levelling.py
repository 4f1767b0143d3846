"""Load levelling: the engine at the slow mean of the demand, the battery takes the rest.

Needs no future and, for light work, stops the engine between stretches of running.
"""

from dataclasses import dataclass

import numpy as np

from tractor_ems.policies.genset import power_max_w
from tractor_ems.policies.protocol import limits_of
from tractor_ems.policies.reserve import (
    beyond_battery_w,
    hold_power_w,
    must_hold,
    recent_peak_w,
    support_w,
)
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import DemandFilter, Observation, ObservationSpec
from tractor_msgs_py.trajectory import BoolArray, FloatArray
from tractor_sim.powertrain import (
    Command,
    PowertrainParams,
    feasible_battery_power_w,
    project,
)


@dataclass(frozen=True)
class LevellingState:
    """Memory of load levelling, each of shape (B,): whether the engine is in a stretch of running,
    and the recent peak demand [W]."""

    working: BoolArray
    peak_w: FloatArray


@dataclass(frozen=True)
class LoadLevelling:
    """The engine gives what the work needs on average and what brings SOC back to its target:

        P = mean(P_dem) + E (SOC_target - SOC) / soc_time_s

    A stretch of running begins when P exceeds ``start_share P_max`` (P_max is the engine's most
    at the bus) and ends when P is down to ``stop_share P_max``; during it the engine gives
    ``max(P, least_share P_max)``. In heavy work P stays high and the stretch lasts. In light work
    the engine gives more than the mean, SOC rises until the stretch ends, and it swings by about
    ``(start_share - stop_share) P_max soc_time_s / E``: 0.11 on "field".

    Where an engine is not back at once (see ``reserve``) it also runs for demand that the battery
    should not carry alone, and while such peaks are recent it is held: at P, idling if need be.

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

    def init(self, batch: int) -> LevellingState:
        """Not running, no peak seen; the mean is observed."""
        return LevellingState(np.zeros(batch, dtype=bool), np.zeros(batch))

    def act(
        self, observation: Observation, state: LevellingState
    ) -> tuple[Command, LevellingState]:
        """Engine at the level or off; both projected on what the battery allows."""
        most_w = power_max_w(self.powertrain)
        gain_w = self.powertrain.battery.energy_j / self.soc_time_s
        level_w = observation.features[:, 0] + gain_w * (observation.soc_target - observation.soc)
        demand_w = observation.power_demand_w
        discharge_w = observation.discharge_limit_w
        peak_w = recent_peak_w(self.powertrain, state.peak_w, demand_w)
        needed_w = support_w(self.powertrain, demand_w, discharge_w, observation.engine_on)
        # Remembered, not read off the engine: an engine that is only held must not be taken for
        # one in a stretch, or it would change between idling and the least power each second.
        working = level_w > np.where(
            state.working, self.stop_share * most_w, self.start_share * most_w
        )
        held = observation.engine_on & must_hold(self.powertrain, peak_w, discharge_w)
        run = working | held | (beyond_battery_w(self.powertrain, demand_w, discharge_w) > 0.0)
        least_w = np.where(working, self.least_share * most_w, 0.0)
        hold_w = hold_power_w(self.powertrain, peak_w, discharge_w)
        engine_w = np.maximum.reduce([level_w, least_w, needed_w, hold_w])
        lb, ub = feasible_battery_power_w(limits_of(observation), demand_w)
        battery_w = project(np.where(run, demand_w - engine_w, demand_w), lb, ub)
        return Command(battery_w, np.where(run, np.nan, 0.0)), LevellingState(working, peak_w)
