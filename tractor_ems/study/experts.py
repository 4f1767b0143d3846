"""Demonstrations: experts' runs recorded into MCAP bags, read back by the production reader, and
counted anew in the study's reward.
"""

import hashlib
import json
import os
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numba import njit

from tractor_ems.bags.in_process import record_in_process
from tractor_ems.learning.mdp import Mdp, bounds_w, feasible_actions, reward_of
from tractor_ems.learning.online import INPUTS, Encoder, encode_trace
from tractor_ems.learning.recorded import Drive
from tractor_ems.learning.replay import Seeding, Transitions, concatenate, draw_seeds
from tractor_ems.policies.registry import make_policy
from tractor_ems.scenario import make_scenario
from tractor_ems.study.config import StudyConfig
from tractor_ems.study.drives import read_drives
from tractor_ems.study.rows import Row
from tractor_msgs_py.errors import BagError, ConfigError
from tractor_msgs_py.trajectory import FloatArray, IntArray
from tractor_sim.config import load_powertrain
from tractor_sim.duty_cycle.cycle import cycle_hash
from tractor_sim.duty_cycle.library import load_cycle
from tractor_sim.powertrain import ROUNDING_W, PowertrainParams
from tractor_sim.powertrain_json import powertrain_hash

Expert = Literal["dp", "rule_based"]

EDGE_W = 25.0
"""A recorded power this close to lb or ub is lb or ub: half a float32 step of SOC is 20 W of a
185 kWh battery over one second."""

SEEDING = 2
"""Raise when the same bags seed a replay otherwise: part of a seeded run's hash."""

RECORDING = 1
"""Raise when the same expert drives otherwise: bags are then recorded anew."""


@dataclass(frozen=True)
class Demonstration:
    """One bag to record: who drives which cycle on the plant with which lower SOC limit."""

    expert: Expert
    cycle: str
    soc_min: float
    bag: Path


def plant(config: StudyConfig, soc_min: float) -> PowertrainParams:
    """The study's powertrain with another lower SOC limit."""
    params = load_powertrain(config.powertrain)
    return replace(params, battery=replace(params.battery, soc_min=soc_min))


def shares(row: Row, config: StudyConfig) -> dict[Expert, float]:
    """Share of the replay that each expert seeds."""
    dp, rule = config.experts.dp_share, config.experts.rule_share
    return {
        "dp": dp if row.seeding in ("dp", "mixed") else 0.0,
        "rule_based": rule if row.seeding in ("rule", "mixed") else 0.0,
    }


def demonstrations(config: StudyConfig, folder: Path) -> tuple[Demonstration, ...]:
    """Every bag that the rows need: as many cycles as fill each expert's share of the replay.

    Raises:
        ConfigError: the range of seeds holds too few cycles.
    """
    study_cycle = load_cycle(config.cycle)
    own = cycle_hash(study_cycle)
    names = [f"planter_{seed}" for seed in range(*_inclusive(config.experts.seeds))]
    names = [name for name in names if cycle_hash(load_cycle(name)) != own]
    found: dict[Demonstration, None] = {}
    for row in config.rows:
        for expert, share in shares(row, config).items():
            steps = max(len(study_cycle) - 1, 1)
            count = int(np.ceil(share * config.replay_capacity / steps))
            if count > len(names):
                raise ConfigError(
                    f"experts.seeds: {list(config.experts.seeds)} holds {len(names)} cycles, "
                    f"{expert} needs {count} to fill {share:.0%} of {config.replay_capacity}"
                )
            runs = folder / f"soc_min_{row.soc_min:g}-{_recipe(config, row.soc_min)}" / expert
            for name in names[:count]:
                found[Demonstration(expert, name, row.soc_min, runs / name)] = None
    return tuple(found)


def _recipe(config: StudyConfig, soc_min: float) -> str:
    """First digits of the hash of what decides a recorded run besides driver and cycle."""
    text = json.dumps(
        {
            "recording": RECORDING,
            "powertrain_hash": powertrain_hash(plant(config, soc_min)),
            "soc_initial": config.soc_initial,
            "soc_target": config.soc_target,
        },
        sort_keys=True,
    )
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def record(demonstration: Demonstration, config: StudyConfig) -> None:
    """Drive and record one bag, whole or not at all; one that is there already is kept."""
    bag = demonstration.bag
    if bag.exists():
        return
    scenario = make_scenario(
        config.powertrain, demonstration.cycle, config.soc_initial, config.soc_target
    )
    scenario = replace(scenario, params=plant(config, demonstration.soc_min))
    # The paper's rule has no guard: the plant itself holds SOC_min.
    policy = make_policy(demonstration.expert, scenario, soc_guard=False)
    try:
        bag.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".part.", dir=bag.parent) as part:
            record_in_process(policy, scenario, Path(part) / bag.name)
            os.rename(Path(part) / bag.name, bag)
    except OSError as error:
        raise BagError(f"{bag}: cannot be written ({error.strerror or error})") from None


def drives_of(
    config: StudyConfig, folder: Path, expert: Expert, soc_min: float
) -> tuple[Drive, ...]:
    """What the bags of one expert hold, by the reader that training uses.

    Raises:
        BagError: a bag is missing, damaged or of another powertrain.
    """
    wanted = [d for d in demonstrations(config, folder) if d.soc_min == soc_min]
    bags = [d.bag for d in wanted if d.expert == expert]
    return read_drives(bags, plant(config, soc_min))


def seeds(
    row: Row,
    config: StudyConfig,
    folder: Path,
    mdp: Mdp,
    encoder: Encoder,
    rng: np.random.Generator,
) -> tuple[Transitions, dict[str, Seeding]]:
    """Distinct transitions for the row's shares of the replay, shuffled together."""
    parts, reports = [], dict[str, Seeding]()
    for expert, share in shares(row, config).items():
        if share > 0.0:
            drives = drives_of(config, folder, expert, row.soc_min)
            driven = [transitions(d, mdp, encoder, config.networks.gamma) for d in drives]
            drawn, reports[expert] = draw_seeds(
                concatenate(driven, INPUTS), share, config.replay_capacity, rng
            )
            parts.append(drawn)
    joined = concatenate(parts, INPUTS)
    return joined.take(rng.permutation(len(joined))), reports


def transitions(drive: Drive, mdp: Mdp, encoder: Encoder, gamma: float) -> Transitions:
    """T - 1 transitions of a recorded run of T steps, in the reward and actions of ``mdp``."""
    soc, demand_w = drive.soc, drive.power_demand_w
    action, reward, first, last = _retell(
        mdp, demand_w, soc, drive.battery_power_w, drive.engine_power_w, drive.fuel_kg
    )
    inputs = encode_trace(encoder, demand_w, soc[:-1])
    return Transitions(
        inputs=inputs[:-1],
        action=action[:-1],
        reward=reward[:-1].astype(np.float32),
        discount=np.full(len(action) - 1, gamma, np.float32),
        next_inputs=inputs[1:],
        first=first[:-1].astype(np.int16),
        last=last[:-1].astype(np.int16),
        next_first=first[1:].astype(np.int16),
        next_last=last[1:].astype(np.int16),
    )


@njit(cache=True, error_model="numpy")
def _retell(
    mdp: Mdp,
    demand_w: FloatArray,
    soc: FloatArray,
    battery_w: FloatArray,
    engine_w: FloatArray,
    fuel_kg: FloatArray,
) -> tuple[IntArray, FloatArray, IntArray, IntArray]:
    """Action, reward, first and last feasible action of every recorded step."""
    steps = len(demand_w)
    action, reward = np.zeros(steps, np.int64), np.zeros(steps)
    first, last = np.zeros(steps, np.int64), np.zeros(steps, np.int64)
    for k in range(steps):
        lb, ub = bounds_w(mdp, demand_w[k], soc[k])
        first[k], last[k] = feasible_actions(mdp, demand_w[k], lb, ub)
        reward[k] = reward_of(mdp, engine_w[k], fuel_kg[k], soc[k], soc[k + 1])
        power_w = mdp.action_power_w
        wanted_w = engine_w[k] if mdp.engine_actions else battery_w[k]
        nearest = int(np.rint((wanted_w - power_w[0]) / (power_w[1] - power_w[0])))
        low, high = first[k], last[k]
        off = engine_w[k] <= ROUNDING_W
        if mdp.engine_actions:
            # Off is action 0 and no running engine is it.
            action[k] = 0 if off else min(max(nearest, max(low, 1)), max(high, 1))
        elif off or battery_w[k] >= ub - EDGE_W:
            action[k] = high
        elif battery_w[k] <= lb + EDGE_W:
            action[k] = low
        else:
            action[k] = min(max(nearest, low), max(high - 1, low))
    return action, reward, first, last


def _inclusive(bounds: tuple[int, int]) -> tuple[int, int]:
    return bounds[0], bounds[1] + 1
