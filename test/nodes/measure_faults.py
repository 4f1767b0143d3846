"""How soon a policy and a plant react to everything that goes wrong on a wire or to a process, and
how soon they drive again. A report, no test.

python test/nodes/measure_faults.py [--trials N] [--out FILE.json]
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import typer
from measuring import Section, machine, publish, quantiles, shown
from nodes.faults import PERIOD_S, PLANT_FAULTS, POLICY_FAULTS, Outcome, try_plant, try_policy
from nodes.lost_processes import lose_and_replace
from nodes.scripted import SOC, TENTH, ScriptedPlant, ScriptedPolicy, random_demand, write_cycle
from nodes.stage import Stage, stage

from tractor_msgs_py import topics

STEPS = 20_000
PATIENCE_S, LONGEST_S = 2.0, 20.0
"""How long a side is watched that should drive on, and one that should react [s]."""

OBSERVATION = (topics.RUN_INFO, topics.POWER_DEMAND, topics.BATTERY, topics.POWERTRAIN)
MODES: dict[str, dict[str, Any]] = {"exact": {}, "sampled": {"signals": "signals"}}


def policy_rows(on: Stage, mode: str, trials: int, timeout_s: float) -> dict[str, list[Outcome]]:
    """Every fault of an observation."""
    there, work = f"/{mode}", random_demand(0, STEPS)
    cycle = write_cycle(on.folder / "work.csv", work, PERIOD_S)
    node = on.start(
        "rule_based_policy",
        there,
        powertrain=TENTH,
        observation_timeout_s=timeout_s,
        **MODES[mode],
    )
    peer = on.graph.peer(topics.COMMAND, name="scripted_plant", namespace=there)
    plant = ScriptedPlant(peer, cycle)
    found = {}
    for fault in POLICY_FAULTS:
        patience_s = PATIENCE_S if fault.drives_on else LONGEST_S
        found[f"policy, {mode}: {fault.name}"] = [
            try_policy(on.graph, plant, fault, patience_s) for _ in range(trials)
        ]
    assert on.end(node) == 0, node.output
    on.graph.remove(peer.node)
    return found


def plant_rows(on: Stage, trials: int, timeout_s: float) -> dict[str, list[Outcome]]:
    """Every fault of a command."""
    cycle = write_cycle(on.folder / "even.csv", [100e3] * STEPS, PERIOD_S)
    peer = on.graph.peer(*OBSERVATION, name="scripted_policy", namespace="/plant")
    node = on.start(
        "plant_sim", "/plant", powertrain=TENTH, cycle=cycle, mode="real_time", soc_initial=SOC,
        command_timeout_s=timeout_s,
    )  # fmt: skip
    policy = ScriptedPolicy(peer)
    found = {}
    for fault in PLANT_FAULTS:
        patience_s = PATIENCE_S if fault.drives_on else LONGEST_S
        found[f"plant: {fault.name}"] = [
            try_plant(on.graph, policy, fault, patience_s) for _ in range(trials)
        ]
    assert on.end(node) == 0, node.output
    on.graph.remove(peer.node)
    return found


def row(name: str, outcomes: list[Outcome]) -> tuple[str, ...]:
    """One fault: reaction, reason, recovery."""
    times = [o.reaction_s for o in outcomes if o.reaction_s is not None]
    ticks = [o.recovery_ticks for o in outcomes if o.recovery_ticks is not None]
    reasons = sorted({o.reason.name for o in outcomes if o.reason})
    again = f"{min(ticks)}..{max(ticks)}" if ticks else "never"
    return (
        name,
        f"{len(times)} of {len(outcomes)}",
        *shown(quantiles(times), "min", "p50", "max", digits=2),
        ", ".join(reasons) or "-",
        again if len(ticks) == len(outcomes) else f"{again}, {len(outcomes) - len(ticks)} not",
        str(sum(o.unsafe for o in outcomes)),
    )


def lost_rows(on: Stage, trials: int, timeout_s: float) -> list[tuple[str, ...]]:
    """Processes that stop, die and are replaced."""
    took = [lose_and_replace(on, timeout_s) for _ in range(trials)]
    rows = []
    for what in took[0]:
        times = [one[what] for one in took]
        found = shown(quantiles(times), "min", "p50", "max", digits=2)
        rows.append((what, f"{len(times)} of {trials}", *found, "-", "-", "-"))
    return rows


def main(
    trials: int = 5,
    timeout_s: float = 0.5,
    out: Path | None = None,
    record: str | None = None,
) -> None:
    """TRIALS of every fault."""
    before = machine()
    rows: list[tuple[str, ...]] = []
    figures: dict[str, Any] = {"timeout_s": timeout_s}
    parts: list[Callable[[Stage], dict[str, list[Outcome]]]] = [
        lambda on: policy_rows(on, "exact", trials, timeout_s),
        lambda on: policy_rows(on, "sampled", trials, timeout_s),
        lambda on: plant_rows(on, trials, timeout_s),
    ]
    for part in parts:
        with stage() as on:
            found = part(on)
        rows += [row(name, outcomes) for name, outcomes in found.items()]
        figures |= {n: [o.reaction_s for o in outcomes] for n, outcomes in found.items()}
    with stage() as on:
        rows += lost_rows(on, trials, timeout_s)
    notes = [
        f"Both timeouts {timeout_s:g} s, 10 Hz. From the last good word to the first sign of the "
        "fallback law; faults that should change nothing are watched for "
        f"{PATIENCE_S:g} s. Recovery: good ticks until everything was as before.",
        "With a signal map a topic that stops while others go on is missed when its signal's own "
        "max_age_s is over: 1.5 s for demand and engine, 5 s for SOC.",
        "A policy that was SIGKILLed counts as connected until the middleware's lease ends, "
        "about 20 s; until then its successor is refused as a second one.",
    ]
    section = Section(
        f"Every fault on the wire, {trials} trials each",
        ("fault", "fell back", "min s", "median s", "max s", "reason said", "recovery ticks",
         "unsafe"),
        rows, figures, notes,
    )  # fmt: skip
    publish(section, before, out, record)


if __name__ == "__main__":
    typer.run(main)
