"""One run of a plant with engine state, and what the plant makes of a plan whose SOC is known."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from tractor_ems.policies.planned import command
from tractor_msgs_py.trajectory import BoolArray, FloatArray
from tractor_sim.powertrain import PlantState, PowertrainParams, step


@dataclass(frozen=True)
class EnginePlan:
    """One run of a plant, step by step.

    Attributes:
        soc: (T + 1,), before every step and after the last.
        battery_power_w: (T,), terminal power, > 0 discharges [W].
        engine_power_w: (T,), at the bus [W].
        engine_on: (T,).
        fuel_kg: (T,), starts included.
        shortfall_j: (T,).
    """

    soc: FloatArray
    battery_power_w: FloatArray
    engine_power_w: FloatArray
    engine_on: BoolArray
    fuel_kg: FloatArray
    shortfall_j: FloatArray

    @property
    def starts(self) -> int:
        """Times that the engine is started; it is off before the first step."""
        return int(np.sum(self.engine_on & ~np.append(False, self.engine_on[:-1])))

    @property
    def stops(self) -> int:
        """Times that the engine is stopped."""
        return int(np.sum(self.engine_on[:-1] & ~self.engine_on[1:]))


def driven(
    relaxed: PowertrainParams,
    held_on: bool,
    demand_w: FloatArray,
    soc: FloatArray,
    engine_power_w: FloatArray,
    engine_on: BoolArray,
) -> EnginePlan:
    """What ``powertrain.step`` makes of every step of a run whose SOC is known, all at once, on
    the relaxed plant: the state before a step is SOC and engine on, no more.

    Where the plan has the engine idling though nothing can take its power, it goes on with
    ``held_on`` and stops without; the next step begins with what it did.
    """
    free = relaxed
    if held_on:
        free = dataclasses.replace(free, engine=dataclasses.replace(free.engine, min_on_s=1.0))
    wanted, applied = command(demand_w, engine_power_w, engine_on), engine_on
    while True:
        before = np.append(False, applied[:-1])
        state = PlantState(
            soc=soc[:-1],
            engine_on=before,
            time_in_state_s=np.where(before & engine_on, 0.0, 1.0),
            engine_power_w=np.zeros(len(demand_w)),
        )
        after, result = step(free, state, demand_w, wanted)
        if np.array_equal(after.engine_on, applied):
            break
        applied = after.engine_on
    return EnginePlan(
        soc=np.append(soc[:1], after.soc),
        battery_power_w=result.battery_power_w,
        engine_power_w=result.engine_power_w,
        engine_on=after.engine_on,
        fuel_kg=result.fuel_kg,
        shortfall_j=result.shortfall_j,
    )
