"""Recordings of vehicles whose parameters are known: driven in-process, altered on request."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tractor_ems.bags.in_process import run_info_of, samples_of, write_samples_bag
from tractor_ems.drive import drive
from tractor_ems.policies.protocol import ANY_RUN
from tractor_ems.scenario import Scenario
from tractor_msgs_py.observation import Observation, ObservationSpec
from tractor_msgs_py.trajectory import FloatArray
from tractor_msgs_py.types import Sample
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.cycle import DutyCycle
from tractor_sim.powertrain import Command

IDLE = np.nan
"""In a schedule of engine powers: on without load."""


@dataclass(frozen=True)
class Schedule:
    """A policy that follows engine powers at the bus; 0 is off."""

    engine_w: FloatArray
    name: str = "schedule"
    spec: ObservationSpec = field(default=ANY_RUN)

    def init(self, batch: int) -> int:
        return 0

    def act(self, observation: Observation, state: int) -> tuple[Command, int]:
        wanted = self.engine_w[state : state + 1]
        demand_w = observation.power_demand_w
        if np.isnan(wanted[0]):  # a hundredth of a milliwatt is more than rounding, so it is on
            return Command(demand_w - 1e-5, np.full(1, np.nan)), state + 1
        return Command(demand_w - wanted, np.where(wanted == 0.0, 0.0, np.nan)), state + 1


def samples(vehicle: str, demand_w: FloatArray, engine_w: FloatArray) -> list[Sample]:
    """Everything that is said in one run; demand at the bus, auxiliaries included."""
    params = load_powertrain(vehicle)
    cycle = DutyCycle(
        name="test", power_demand_w=demand_w - params.p_aux_w, dt_s=1.0, operation="test"
    )
    soc = params.soc_initial
    scenario = Scenario(params, cycle, soc, soc, vehicle, "test")
    policy = Schedule(engine_w)
    (trajectory,) = drive(policy, params, scenario.power_demand_w[None, :], soc, soc)
    return samples_of(params, run_info_of(scenario, trajectory, policy.name), trajectory)[0]


def write(out: Path, said: Sequence[Sample]) -> Path:
    """A bag of samples; returns its path."""
    write_samples_bag(out, said, {"recorder": "in_process"})
    return out


def varied(seed: int, steps: int, engine_max_w: float) -> tuple[FloatArray, FloatArray]:
    """Demand and engine power around levels held for 6-14 s, over all of their ranges, stops and
    idling included; the battery's power has mean 0, so that SOC stays inside its window."""
    rng = np.random.Generator(np.random.PCG64(seed))
    held = rng.integers(6, 15, steps)
    pieces = np.repeat(np.arange(steps), held)[:steps]
    engine_w = rng.uniform(0.0, engine_max_w, steps)
    engine_w[rng.random(steps) < 0.2] = 0.0
    engine_w[rng.random(steps) < 0.05] = IDLE
    engine_w = engine_w[pieces]
    moved_w = engine_w + rng.uniform(-8e3, 8e3, steps)
    engine_w = np.where(engine_w > 0.0, np.clip(moved_w, 0.0, engine_max_w), engine_w)
    demand_w = np.nan_to_num(engine_w) + rng.uniform(-110e3, 110e3, steps)[pieces]
    return demand_w, engine_w
