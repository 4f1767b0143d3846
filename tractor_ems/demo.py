"""The main job in one go: record experts through the real nodes, learn from the bags alone, drive
the plant with what was learnt on cycles that training never saw."""

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tractor_ems.evaluate import evaluate
from tractor_ems.learning.config import load_train_config
from tractor_ems.learning.train import train
from tractor_ems.plots import plot_runs
from tractor_ems.result import Result
from tractor_ems.scenario import Scenario, make_scenario
from tractor_msgs_py.atomic import write_bytes, write_json
from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import Trajectory
from tractor_sim.duty_cycle.cycle import Split
from tractor_sim.duty_cycle.library import listed_cycles

SUMMARY_SCHEMA = 1
BASELINES = ("dp", "rule_based", "best_point", "myopic_greedy", "conventional")
MADE_HERE = ("bags", "policies", "plots", "summary.json")
MARKER = ".tractor_ems_demo"
"""File that says a folder is a demo's; only such a folder is cleared."""

Say = Callable[[str], None]


def _planters(split: Split, count: int) -> tuple[str, ...]:
    """The first cycles of the paper's operation in a split."""
    return tuple(row.name for row in listed_cycles(split, "planter")[:count])


@dataclass(frozen=True)
class DemoConfig:
    """What the demo drives.

    Attributes:
        powertrain: shipped name or YAML file.
        soc_initial, soc_target: of every run; the paper's pass starts at 0.85 and its DP ends at
            0.836.
        train_cycles: recorded, one DP and one rule-based bag each.
        unseen_cycles: driven after training, which never saw them.
        seed: of training.
    """

    powertrain: str = "paper"
    soc_initial: float = 0.85
    soc_target: float = 0.836
    train_cycles: tuple[str, ...] = _planters("train", 6)
    unseen_cycles: tuple[str, ...] = _planters("validation", 5)
    seed: int = 0


def run_demo(out: Path, config: DemoConfig, say: Say) -> dict[str, Any]:
    """Record, train, drive, score, plot; returns the document that ``summary.json`` holds.

    Args:
        out: folder to fill; a previous demo's files in it are replaced.
        config: what to drive.
        say: receives one line per finished piece of work.

    Raises:
        ConfigError: ``out`` holds something and no demo made it.
        TractorEmsError: a run was aborted.
    """
    _clear(out)
    started = time.monotonic()

    def tell(text: str) -> None:
        say(f"[{time.monotonic() - started:5.1f} s] {text}")

    bags = _record(out, config, tell)
    training = _train(out, config, bags, tell)
    results, runs = _drive(out, config, training, tell)
    for cycle, by_policy in runs.items():
        scenario = _scenario(config, cycle)
        title = f"unseen cycle {cycle}: learned offline from bags, driven in ROS 2 lockstep"
        plot_runs(
            out / "plots" / f"{cycle}.png", title, by_policy, scenario.params, config.soc_target
        )
    document = {
        "schema": SUMMARY_SCHEMA,
        "results": [result.to_json() for result in results],
        "bags": bags,
        "training": training,
    }
    write_json(out / "summary.json", document)
    tell(f"wrote {out / 'summary.json'} and {out / 'plots'}")
    return document


def _scenario(config: DemoConfig, cycle: str) -> Scenario:
    return make_scenario(config.powertrain, cycle, config.soc_initial, config.soc_target)


def _clear(out: Path) -> None:
    ours = (out / MARKER).is_file()
    if out.exists() and not ours and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(f"{out}: exists and no demo made it; choose another folder")
    write_bytes(out / MARKER, b"made by ems demo, which replaces what it made\n")
    for name in MADE_HERE:
        path = out / name
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def _record(out: Path, config: DemoConfig, tell: Say) -> list[dict[str, Any]]:
    """One DP and one rule-based bag per training cycle, through plant, policy and recorder."""
    bags = []
    for cycle in config.train_cycles:
        scenario, runs = _scenario(config, cycle), {}
        for policy in ("dp", "rule_based"):
            path = out / "bags" / f"{policy}_{cycle}"
            result, runs[policy] = evaluate(policy, scenario, transport="ros", record=path)
            bags.append({"path": str(path.relative_to(out)), **result.to_json()})
            tell(f"recorded {path.name}: {result.steps} steps, {result.fuel_kg:.3f} kg")
        if cycle == config.train_cycles[0]:
            picture = out / "plots" / "experts.png"
            plot_runs(
                picture,
                f"experts on {cycle}, recorded to MCAP",
                runs,
                scenario.params,
                config.soc_target,
            )
            tell(f"first picture: {picture}")
    return bags


def _train(out: Path, config: DemoConfig, bags: list[dict[str, Any]], tell: Say) -> dict[str, Any]:
    """Both target modes, from the bags alone."""
    training = {}
    experts, rules = (
        [out / bag["path"] for bag in bags if bag["policy"] == name]
        for name in ("dp", "rule_based")
    )
    for targets in ("counterfactual", "sampled"):
        path = out / "policies" / f"ddqn_{targets}.safetensors"
        settings = load_train_config(
            targets, {"powertrain": config.powertrain, "seed": config.seed}
        )
        report = train(settings, experts, rules, path, command_line="ems demo")
        training[targets] = report.to_json() | {"policy": str(path.relative_to(out))}
        tell(f"trained ddqn_{targets} offline, {settings.updates} updates")
    return training


def _drive(
    out: Path, config: DemoConfig, training: dict[str, Any], tell: Say
) -> tuple[list[Result], dict[str, dict[str, Trajectory]]]:
    """Every policy over every unseen cycle: what was learnt through the nodes, the rest
    in-process, where the trajectory is the same."""
    results: list[Result] = []
    runs: dict[str, dict[str, Trajectory]] = {}
    for cycle in config.unseen_cycles:
        scenario = _scenario(config, cycle)
        runs[cycle] = {}
        for targets, facts in training.items():
            learnt = str(out / facts["policy"])
            result, runs[cycle][f"ddqn_{targets}"] = evaluate(learnt, scenario, transport="ros")
            results.append(result)
        for policy in BASELINES:
            result, trajectory = evaluate(policy, scenario)
            results.append(result)
            if policy in ("dp", "rule_based"):
                runs[cycle][policy] = trajectory
        tell(f"drove {cycle}: " + ", ".join(_scored(r) for r in results if r.cycle == cycle))
    return results, runs


def _scored(result: Result) -> str:
    ratio = "-" if result.dp_ratio is None else f"{result.dp_ratio:.4f}"
    return f"{result.policy} {ratio}"
