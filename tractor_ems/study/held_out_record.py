"""First stage of the held-out study: runs of DP and rules on training cycles, recorded as bags."""

import dataclasses
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from tractor_ems.bags.in_process import record_in_process
from tractor_ems.policies.registry import make_policy
from tractor_ems.scenario import Scenario
from tractor_ems.study.pieces import code_digest, digest_of, load_piece, save_piece
from tractor_msgs_py.errors import ConfigError
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.cycle import DutyCycle, cycle_hash
from tractor_sim.duty_cycle.library import load_cycle
from tractor_sim.powertrain_json import powertrain_hash

_CODE = (
    "tractor_ems/drive.py",
    "tractor_ems/safety.py",
    "tractor_ems/optimal",
    "tractor_ems/policies/dp.py",
    "tractor_ems/policies/rules.py",
    "tractor_ems/policies/reserve.py",
)


@dataclass(frozen=True)
class Recording:
    """One run to record: who drives what, and the bag it becomes.

    Attributes:
        powertrain, cycle: names; scale: factor on the cycle's demand.
        policy: name of a rule, or ``dp``.
        bag: folder; its piece lies beside it.
    """

    powertrain: str
    cycle: str
    scale: float
    policy: str
    bag: Path

    @property
    def piece(self) -> Path:
        """Where its figures are kept."""
        return self.bag.with_name(f"{self.bag.name}.json")

    @property
    def key(self) -> str:
        """Hash of everything that decides the bag."""
        scenario = scenario_of(self.powertrain, self.cycle, self.scale)
        made_of = [powertrain_hash(scenario.params), cycle_hash(scenario.cycle), self.policy]
        return digest_of([*made_of, code_digest(*_CODE)])


@dataclass(frozen=True)
class Recorded:
    """What a recording became: its bag, its steps, and the seconds of CPU it took."""

    bag: Path
    key: str
    steps: int
    cpu_s: float


def recordings_of(
    powertrain: str, cycles: Sequence[str], policies: Sequence[str], scale: float, folder: Path
) -> list[Recording]:
    """Every policy on every cycle: the first policy's runs first."""
    return [
        Recording(powertrain, cycle, scale, policy, folder / f"{policy}_{cycle}")
        for policy in policies
        for cycle in cycles
    ]


def scaled_cycle(name: str, scale: float) -> DutyCycle:
    """A listed cycle with its demand times ``scale``, in whole watts; 1 leaves it as it is."""
    cycle = load_cycle(name)
    if scale == 1.0:
        return cycle
    return dataclasses.replace(
        cycle,
        name=f"{cycle.name}_x{scale:g}",
        power_demand_w=np.round(scale * cycle.power_demand_w) + 0.0,
    )


@lru_cache(maxsize=512)
def scenario_of(powertrain: str, cycle: str, scale: float = 1.0) -> Scenario:
    """A listed cycle on a powertrain, from its initial SOC to its target."""
    params = load_powertrain(powertrain)
    target = params.soc_initial if params.soc_target is None else params.soc_target
    made = scaled_cycle(cycle, scale)
    return Scenario(params, made, params.soc_initial, target, powertrain, cycle)


def record(task: Recording) -> Recorded:
    """Drive and record, unless that is done already."""
    found = load_piece(task.piece, task.key)
    if found is None or not task.bag.is_dir():
        scenario = scenario_of(task.powertrain, task.cycle, task.scale)
        if scenario.cycle.split != "train":
            raise ConfigError(f"{task.cycle}: split {scenario.cycle.split}, allowed train")
        shutil.rmtree(task.bag, ignore_errors=True)
        task.bag.parent.mkdir(parents=True, exist_ok=True)
        began = time.process_time()
        record_in_process(make_policy(task.policy, scenario), scenario, task.bag)
        spent = time.process_time() - began
        found = {"steps": len(scenario.cycle), "cpu_s": round(spent, 3)}
        save_piece(task.piece, task.key, found)
    return Recorded(task.bag, task.key, int(found["steps"]), float(found["cpu_s"]))
