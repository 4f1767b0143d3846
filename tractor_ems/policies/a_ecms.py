"""Adaptive ECMS that starts and stops: a price of battery energy fed back from SOC, and a start
that is written off over the time an engine state is expected to last. Needs no future.
"""

from dataclasses import dataclass

import numpy as np

from tractor_ems.policies.one_step import (
    Held,
    cheapest,
    command_of,
    hold,
    not_held,
    running_range_w,
    unhurried_range_w,
)
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import DemandFilter, Observation, ObservationSpec
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.battery import discharge_current_a, open_circuit_v
from tractor_sim.powertrain import Command, PowertrainParams

ADAPT_EVERY_S = 60.0

BEND_MOST = 1.0
"""Most that SOC feedback raises or lowers the price, relative to it."""


@dataclass(frozen=True)
class AEcmsState:
    """Memory: what the price was raised by so far, (B,), ticks since the start, and holding."""

    raised: FloatArray
    ticks: int
    held: Held


@dataclass(frozen=True)
class AEcms:
    """Minimises LHV fuel + s V_oc I at every step, as ``ecms``, with the engine free to stop:

        s = equivalence (1 + (soc_gain + stiffen_s / time left) e + sum over minutes of adapt e),
        e = SOC_target - SOC

    Whether to run is asked of demand smoothed over ``decide_s``: the engine starts (stops) when
    running (standing) is cheaper by more than the start's fuel / ``write_off_s``.

    A relative rise of the price by x moves the battery by x V_oc^2 / 2R (2.6 MW on "field"), and
    paying an error e back in the time left t takes E e / t: stiffen_s = 2 R E / V_oc^2, 55 s on
    "field", would just do that; below it SOC swings freely until late.

    Attributes:
        powertrain: what it drives.
        equivalence: fuel energy per battery energy at the target SOC, > 0.
        soc_gain, adapt: relative rise of that per unit of SOC below the target, and per minute.
        write_off_s: time over which a start is written off, > 0 [s]; inf: starts count nothing.
        decide_s: time constant of the demand that decides on starts and stops [s]; 0: the
            present demand does.
        stiffen_s: how the gain grows towards the planned end, >= 0 [s]; 0: knows of no end.

    Raises PolicyError where a setting is out of range.
    """

    powertrain: PowertrainParams
    equivalence: float = 2.40
    soc_gain: float = 1.0
    adapt: float = 0.0
    write_off_s: float = 120.0
    decide_s: float = 20.0
    stiffen_s: float = 0.0
    name: str = "a_ecms"

    def __post_init__(self) -> None:
        if not (np.isfinite(self.equivalence) and self.equivalence > 0):
            raise PolicyError(
                f"{self.name}.equivalence: {self.equivalence}, allowed finite and > 0"
            )
        if not self.write_off_s > 0:
            raise PolicyError(f"{self.name}.write_off_s: {self.write_off_s}, allowed > 0")
        for name in ("soc_gain", "adapt", "decide_s", "stiffen_s"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise PolicyError(f"{self.name}.{name}: {value}, allowed finite and >= 0")

    @property
    def spec(self) -> ObservationSpec:
        """Smoothed demand comes as the observation's only feature."""
        if self.decide_s == 0.0:
            return ObservationSpec()
        return ObservationSpec(filters=(DemandFilter("low_pass", self.decide_s),))

    def init(self, batch: int) -> AEcmsState:
        """Nothing adapted yet."""
        return AEcmsState(np.zeros(batch), 0, not_held(batch))

    def act(self, observation: Observation, state: AEcmsState) -> tuple[Command, AEcmsState]:
        """The cheapest engine power, or off."""
        params, soc = self.powertrain, observation.soc
        error = observation.soc_target - soc
        every = max(round(ADAPT_EVERY_S / params.dt_s), 1)
        due = state.ticks > 0 and state.ticks % every == 0
        raised = state.raised + (self.adapt * error if due else 0.0)
        gain = self.soc_gain + self.stiffen_s / np.maximum(observation.time_left_s, params.dt_s)
        bend = np.clip(gain * error + raised, -BEND_MOST, BEND_MOST)
        price = self.equivalence * (1.0 + bend)
        kg_per_j = price[:, None] / params.engine.fuel_lhv_j_per_kg
        column = soc[:, None]
        ocv_v = open_circuit_v(params.battery, column)

        def after(battery_w: FloatArray) -> FloatArray:
            at = np.broadcast_to(column, battery_w.shape)
            amps = discharge_current_a(params.battery, at, battery_w)
            return kg_per_j * ocv_v * amps * params.dt_s

        demand_w = observation.power_demand_w
        least_w, most_w, may_run, may_be_off = running_range_w(params, observation)
        engine_w, _ = cheapest(params, demand_w, least_w, most_w, after)
        seen_w = observation.features[:, 0] if self.decide_s > 0.0 else demand_w
        slow_w = np.minimum(seen_w, observation.discharge_limit_w)
        wide = unhurried_range_w(params, slow_w, observation)
        _, run_kg = cheapest(params, slow_w, *wide, after)
        still_kg = after(slow_w[:, None])[:, 0]
        edge_kg = params.engine.start_fuel_kg * params.dt_s / self.write_off_s
        wants = run_kg < still_kg + np.where(observation.engine_on, edge_kg, -edge_kg)
        kept, held = hold(params, observation, state.held)
        run = (wants | kept | ~may_be_off) & may_run
        return command_of(demand_w, engine_w, run), AEcmsState(raised, state.ticks + 1, held)
