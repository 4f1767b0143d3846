"""How long a policy node takes to notice that observations stopped, and a plant node that commands
did: real nodes at 10 Hz, the other side scripted. A report, no test.

python test/nodes/measure_reactions.py [--trials N] [--out FILE.json]
"""

import random
import time
from pathlib import Path
from typing import Any

import typer
from measuring import Section, machine, publish, quantiles, shown
from nodes.scripted import (
    OBSERVATION,
    SOC,
    TENTH,
    ScriptedPlant,
    ScriptedPolicy,
    random_demand,
    write_cycle,
)
from nodes.stage import Stage, stage

from tractor_msgs_py import topics

PERIOD_S = 0.1
MARGIN = 0.25
"""What is asked for: a reaction within the timeout and this part of it."""

PLANT_TRIALS = 10
"""Trials with one plant process: another process has its timers at another phase."""

CYCLE_STEPS = 20_000
STOPPED: tuple[tuple[type, ...], ...] = (OBSERVATION, *((kind,) for kind in OBSERVATION))


def policy_trials(
    on: Stage, cycle: str, trials: int, timeout_s: float, rng: random.Random
) -> dict[str, Any]:
    """Stop all observations, or one of the three topics, at a random moment of a run."""
    peer = on.graph.peer(topics.COMMAND, name="scripted_plant")
    plant = ScriptedPlant(peer, cycle)
    node = on.start("rule_based_policy", powertrain=TENTH, observation_timeout_s=timeout_s)
    reactions, recovered, what = [], [], []
    for trial in range(trials):
        plant.begin()
        plant.drive_until_nominal(on.graph.spin_to)
        plant.drive(on.graph.spin_to, rng.randint(3, 12))
        on.graph.spin_until(lambda: plant.nominal, "an answer to the last tick")
        gone, last_s = STOPPED[trial % len(STOPPED)], plant.said_s
        before = len(plant.commands)
        on.graph.spin_to(last_s + rng.uniform(0.0, PERIOD_S))
        while not plant.fell_back(before) and node.process.poll() is None:
            if gone != OBSERVATION:
                plant.tick(without=gone)
            on.graph.spin_to(time.monotonic() + PERIOD_S)
        reactions.append(plant.fell_back(before)[0][0] - last_s)
        what.append("all" if gone == OBSERVATION else gone[0].__name__)
        recovered.append(plant.drive_until_nominal(on.graph.spin_to))
    code = on.end(node)
    on.graph.remove(peer.node)
    return {"reaction_s": reactions, "stopped": what, "ticks_to_recover": recovered, "exit": code}


def plant_trials(
    on: Stage, cycle: str, trials: int, timeout_s: float, rng: random.Random
) -> dict[str, Any]:
    """Stop answering at a random tick; the answer before came at once, the worst case."""
    codes, found = [], {"reaction_s": [], "acted_s": [], "ticks_to_recover": []}
    for first in range(0, trials, PLANT_TRIALS):
        peer = on.graph.peer(
            topics.RUN_INFO, topics.POWER_DEMAND, topics.BATTERY, topics.POWERTRAIN,
            name="scripted_policy",
        )  # fmt: skip
        policy = ScriptedPolicy(peer)
        node = on.start(
            "plant_sim", powertrain=TENTH, cycle=cycle, mode="real_time",
            command_timeout_s=timeout_s, soc_initial=SOC,
        )  # fmt: skip
        on.graph.spin_until(lambda policy=policy: policy.obeyed, "an obeyed command")
        for _ in range(min(PLANT_TRIALS, trials - first)):
            for name, value in plant_trial(on, policy, rng).items():
                found[name].append(value)
        codes.append(on.end(node))
        on.graph.remove(peer.node)
    return {**found, "exit": max(codes)}


def plant_trial(on: Stage, policy: ScriptedPolicy, rng: random.Random) -> dict[str, float]:
    """Fall silent, wait for the fallback law, speak again until obeyed."""
    on.graph.spin_to(time.monotonic() + rng.uniform(0.3, 1.0))
    policy.answers = policy.silent
    on.graph.spin_until(lambda: not policy.obeyed, "the fallback law")
    after = [item for item in policy.applied if item[1].stamp_ns > policy.said_ns]
    heard_s, reading = next(item for item in after if not policy.obeys(item[1]))
    said_s, said_ns, before = policy.said_s, policy.said_ns, len(policy.demands)
    policy.answers = policy.good
    on.graph.spin_until(lambda: policy.obeyed, "an obeyed command")
    return {
        "reaction_s": heard_s - said_s,
        "acted_s": (reading.stamp_ns - said_ns) * 1e-9 - PERIOD_S,
        "ticks_to_recover": len(policy.demands) - before,
    }


def row(side: str, found: dict[str, Any], timeout_s: float) -> tuple[str, ...]:
    """One line of the table."""
    bound_s = (1.0 + MARGIN) * timeout_s
    reactions, ticks = found["reaction_s"], found["ticks_to_recover"]
    return (
        side,
        f"{timeout_s:g}",
        *shown(quantiles(reactions), "min", "p50", "max"),
        f"{bound_s:.3f}",
        f"{sum(r <= bound_s for r in reactions)} of {len(reactions)}",
        f"{min(ticks)}..{max(ticks)}",
    )


def main(
    trials: int = 50,
    timeout_s: float = 0.5,
    seed: int = 0,
    out: Path | None = None,
    record: str | None = None,
) -> None:
    """Measure both sides over TRIALS each."""
    before, rng = machine(), random.Random(seed)
    with stage() as on:
        work = write_cycle(on.folder / "work.csv", random_demand(seed, CYCLE_STEPS), PERIOD_S)
        policy = policy_trials(on, work, trials, timeout_s, rng)
        # Constant: a held set-point then leaves the battery what it had, the fallback law 0.
        even = write_cycle(on.folder / "even.csv", [100e3] * CYCLE_STEPS, PERIOD_S)
        plant = plant_trials(on, even, trials, timeout_s, rng)
    notes = [
        "Policy: from the publication of the last complete observation to the first fallback "
        "command heard; in turn all topics stop, or one of the three alone.",
        "Plant: from the publication of the last command to the first powertrain_state heard "
        "that was driven otherwise. A plant applies a command at the end of its step, so this is "
        "one period more than the stale command acted: the longest acted for "
        f"{max(plant['acted_s']):.2f} s of the run.",
        f"The plant needs a timeout of at least {PERIOD_S / MARGIN:.2f} s at 10 Hz for this "
        f"bound, in general {1.0 / MARGIN:.0f} periods and what its machine takes: it reports "
        "after the step.",
    ]
    if policy["exit"] or plant["exit"]:
        notes.insert(0, f"FAILURE: exit codes {policy['exit']} and {plant['exit']}")
    section = Section(
        f"Reaction to a side that stops, 10 Hz, {trials} trials each",
        ("who reacts", "timeout s", "min s", "median s", "max s", "bound s", "within",
         "ticks to recover"),
        [row("policy node", policy, timeout_s), row("plant node", plant, timeout_s)],
        {"policy": policy, "plant": plant, "timeout_s": timeout_s},
        notes,
    )  # fmt: skip
    publish(section, before, out, record)


if __name__ == "__main__":
    typer.run(main)
