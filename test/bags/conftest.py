"""Short runs, their samples, and one bag of them, for every test of the bag code."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from tractor_ems.bags.in_process import run_info_of, samples_of, write_samples_bag
from tractor_ems.drive import drive
from tractor_ems.policies.rules import RuleBased
from tractor_ems.scenario import Scenario, make_scenario
from tractor_msgs_py.trajectory import Trajectory
from tractor_msgs_py.types import RunInfo, Sample

STEPS = 60


@dataclass(frozen=True)
class DrivenRun:
    """A short rule-based run: what was driven and everything that was said."""

    scenario: Scenario
    info: RunInfo
    trajectory: Trajectory
    samples: tuple[Sample, ...]


@pytest.fixture(scope="session")
def driven() -> DrivenRun:
    return drive_part("planter", 100, STEPS)


def drive_part(cycle: str, first: int, steps: int) -> DrivenRun:
    """Drive ``steps`` steps of a shipped cycle; from 100 on there is a headland turn in them."""
    whole = make_scenario("paper", cycle)
    demand_w = whole.cycle.power_demand_w[first : first + steps]
    scenario = replace(whole, cycle=replace(whole.cycle, name="part", power_demand_w=demand_w))
    policy = RuleBased(scenario.params)
    trajectory = drive(
        policy,
        scenario.params,
        scenario.power_demand_w[None, :],
        scenario.soc_initial,
        scenario.soc_target,
    )[0]
    assert np.any(trajectory.engine_on) and not np.all(trajectory.engine_on)
    info = run_info_of(scenario, trajectory, policy.name)
    samples, _ = samples_of(scenario.params, info, trajectory)
    return DrivenRun(scenario, info, trajectory, tuple(samples))


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Writes samples as a new bag and returns its folder."""

    def write_bag(samples: Sequence[Sample], name: str = "bag", namespace: str = "") -> Path:
        write_samples_bag(tmp_path / name, samples, {}, namespace)
        return tmp_path / name

    return write_bag


@pytest.fixture(scope="session")
def bag(driven: DrivenRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of the driven run, shared: tests only read it."""
    path = tmp_path_factory.mktemp("shared") / "bag"
    write_samples_bag(path, driven.samples, {f"policy:{driven.info.run_id}": "rule_based"})
    return path
