"""Short recordings to learn from: in memory as traces, and on disk as bags."""

import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from tractor_ems.bags.in_process import record_in_process
from tractor_ems.bags.transitions import Trace
from tractor_ems.drive import drive
from tractor_ems.learning.networks import one_thread
from tractor_ems.learning.recorded import drive_of_trajectory
from tractor_ems.policies.protocol import Policy
from tractor_ems.policies.rules import BestPoint, RuleBased
from tractor_ems.scenario import make_scenario
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.library import load_cycle
from tractor_sim.powertrain import PowertrainParams
from tractor_sim.powertrain_json import powertrain_hash

MakeTraces = Callable[..., list[Trace]]


@pytest.fixture(scope="session", autouse=True)
def single_thread() -> Iterator[None]:
    """As in a training run; two threads for nets this small only wait for each other."""
    with one_thread():
        yield


@pytest.fixture(scope="session")
def paper() -> PowertrainParams:
    return load_powertrain("paper")


@pytest.fixture(scope="session")
def make_traces(paper: PowertrainParams) -> MakeTraces:
    """Traces of training cycles, as a bag of the run would give them."""

    def make(
        seeds: list[int], policy: Policy | None = None, name: str = "dp", steps: int = 766
    ) -> list[Trace]:
        cycles = [load_cycle(f"planter_{seed}") for seed in seeds]
        demand = np.stack([cycle.power_demand_w[:steps] for cycle in cycles])
        runs = drive(policy or RuleBased(paper), paper, demand, 0.85, 0.836)
        traces = []
        for cycle, run in zip(cycles, runs, strict=True):
            driven = drive_of_trajectory(run, paper, 0.836)
            traces.append(
                Trace(
                    stamp_ns=run.stamp_ns,
                    power_demand_w=driven.power_demand_w,
                    dt_s=1.0,
                    p_aux_w=0.0,
                    soc=driven.soc,
                    battery_power_w=driven.battery_power_w,
                    engine_power_w=driven.engine_power_w,
                    engine_on=driven.engine_on,
                    time_in_state_s=driven.time_in_state_s,
                    fuel_kg=driven.fuel_kg,
                    shortfall_j=run.shortfall_j,
                    dissipated_j=run.dissipated_j,
                    soc_target=0.836,
                    from_start=True,
                    to_end=True,
                    irregular=0,
                    refusals=0,
                    run_id=cycle.name,
                    cycle=cycle.name,
                    cycle_hash=hashlib.sha256(cycle.name.encode()).hexdigest(),
                    powertrain="paper",
                    powertrain_hash=powertrain_hash(paper),
                    policy=name,
                    bag=f"{name}/{cycle.name}",
                    bag_hash=hashlib.sha256(f"{name}{cycle.name}".encode()).hexdigest(),
                )
            )
        return traces

    return make


@pytest.fixture(scope="session")
def bags(tmp_path_factory: pytest.TempPathFactory, paper: PowertrainParams) -> Path:
    """A folder with two recorded runs of 120 s: ``best`` and ``rule``."""
    folder = tmp_path_factory.mktemp("bags")
    demand = load_cycle("planter_3").power_demand_w[40:160]
    rows = "".join(f"{k},{power}\n" for k, power in enumerate(demand))
    csv = folder / "short.csv"
    csv.write_text(f"time_s,power_demand_w\n{rows}")
    scenario = make_scenario("paper", str(csv), 0.85, 0.836)
    record_in_process(BestPoint(paper, name="dp"), scenario, folder / "best")
    record_in_process(RuleBased(paper), scenario, folder / "rule")
    return folder
