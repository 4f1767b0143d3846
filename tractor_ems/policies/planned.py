"""Drives a plan of engine powers for one known cycle, tick by tick.

A reference like ``policies.dp``: it refuses any cycle but its own. The plan is open loop; what
makes it fit the plant is ``optimal.bracket``.
"""

from dataclasses import dataclass

import numpy as np

from tractor_ems.policies.cycle_tick import tick_of
from tractor_msgs_py.observation import Observation, ObservationSpec
from tractor_msgs_py.trajectory import BoolArray, FloatArray
from tractor_sim.powertrain import Command, PowertrainParams

IDLE_W = 1e-3
"""What the plant is asked for where the engine is to idle: exactly 0 would mean off."""


def command(demand_w: FloatArray, engine_power_w: FloatArray, engine_on: BoolArray) -> Command:
    """What a policy asks for to have the engine at a power at the bus, or off; any shape."""
    battery_w = demand_w - np.maximum(engine_power_w, IDLE_W)
    return Command(np.where(engine_on, battery_w, demand_w), np.where(engine_on, np.nan, 0.0))


@dataclass(frozen=True)
class PlannedPolicy:
    """Engine power and on/off of every tick, as planned; its memory is the stamp of tick 0 [ns].

    Attributes:
        params: the powertrain that the plan was made for.
        power_demand_w: (T,), the only cycle it drives [W].
        engine_power_w: (T,), at the bus [W]; engine_on: (T,).
        t0_ns: stamp of tick 0; None: the first tick seen is tick 0.
    """

    params: PowertrainParams
    power_demand_w: FloatArray
    engine_power_w: FloatArray
    engine_on: BoolArray
    t0_ns: int | None = None
    name: str = "dp"

    @property
    def spec(self) -> ObservationSpec:
        """No filters; the step length of the powertrain."""
        return ObservationSpec(dt_s=self.params.dt_s)

    def init(self, batch: int) -> int | None:
        """Nothing seen yet."""
        return self.t0_ns

    def act(self, observation: Observation, state: int | None) -> tuple[Command, int]:
        """The planned command for every run of the batch.

        Raises:
            RunAborted: the tick is not in the planned cycle, or its demand is not the planned one.
        """
        t0_ns = observation.stamp_ns if state is None else state
        k = tick_of(self.power_demand_w, observation, t0_ns, self.params.dt_s)
        demand_w = observation.power_demand_w
        power_w = np.full(demand_w.shape, self.engine_power_w[k])
        return command(demand_w, power_w, np.full(demand_w.shape, self.engine_on[k])), t0_ns
