"""SIGTERM and SIGINT to every node at random moments of its life: exit code, traceback, and what a
policy leaves behind on the command topic. A report, no test.

python test/nodes/measure_signals.py [--trials N] [--only NODE] [--out FILE.json]
"""

import random
import signal
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer
from measuring import ROOT, Section, machine, publish, quantiles, shown
from nodes.scripted import ScriptedPlant, ScriptedPolicy, write_cycle
from nodes.stage import Process, Stage, stage

from tractor_msgs_py import topics
from tractor_msgs_py.types import BatteryPowerCommand, CommandMode

POLICIES = ("rule_based_policy", "dp_policy", "ddqn_policy")
NODES = (*POLICIES, "plant_sim", "bag_recorder", "bag_player", "trainer")
LIFE_S = 3.0
"""The signal comes at a moment drawn evenly from this long: in every other trial from when the
handlers are there on, which is start-up for the most part, in the others from when the node is
seen in the graph."""

PERIOD_S = 0.05
STEPS, LONG = 400, 200
SIGNALS = {"SIGTERM": signal.SIGTERM, "SIGINT": signal.SIGINT}
OBSERVATION = (topics.RUN_INFO, topics.POWER_DEMAND, topics.BATTERY, topics.POWERTRAIN)


@dataclass(frozen=True)
class End:
    """How one life ended.

    Attributes:
        phase: what the node was doing when the signal came.
        code: exit code, negative for a signal that killed it.
        traceback: there was one in its output.
        safe: what it left behind is safe; None where it leaves nothing.
        left: what that was.
        handlers_s, exit_s: from start to handlers, and from signal to exit [s].
    """

    phase: str
    code: int
    traceback: bool
    safe: bool | None
    left: str
    handlers_s: float
    exit_s: float

    @property
    def clean(self) -> bool:
        """As asked for."""
        return self.code == 0 and not self.traceback and self.safe is not False


def handles(process: Process) -> bool:
    """The process has its own handlers; the interpreter itself brings one for SIGINT alone."""
    status = Path(f"/proc/{process.process.pid}/status").read_text()
    mask = next(line for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(int(mask.split()[1], 16) >> (signal.SIGTERM - 1) & 1)


class Life:
    """One node, and the other side that keeps it busy."""

    def __init__(self, on: Stage, name: str, cycle: str, rng: random.Random) -> None:
        self.on, self.name, self.rng = on, name, rng
        self.cycle, self.trial = cycle, 0
        self.plant: ScriptedPlant | None = None
        self.policy: ScriptedPolicy | None = None
        if name == "plant_sim":
            self.peer = on.graph.peer(*OBSERVATION, name="other_side")
            self.policy = ScriptedPolicy(self.peer)
        else:
            heard = (topics.POWER_DEMAND,) if name == "bag_player" else (topics.COMMAND,)
            self.peer = on.graph.peer(*heard, name="other_side")
            if name in (*POLICIES, "bag_recorder"):
                self.plant = ScriptedPlant(self.peer, cycle, "paper", PERIOD_S)

    def parameters(self) -> dict[str, Any]:
        """What the node is started with."""
        there = self.on.folder / f"{self.name}_{self.trial}"
        mode = self.rng.choice(("lockstep", "real_time"))
        return {
            "rule_based_policy": {},
            "ddqn_policy": {},
            "dp_policy": {"cycle": self.cycle, "soc_points": 51, "actions": 101}
            | {"soc_initial": 0.8, "soc_target": 0.8},
            "plant_sim": {"cycle": self.cycle, "mode": mode, "period_s": PERIOD_S}
            | {"answer_timeout_s": 60.0, "output": there},
            "bag_recorder": {"output": there, "runs": 0},
            "bag_player": {"bag": ROOT / "bags" / "dp_planter", "what": "topics"}
            | {"pace": "real_time"},
            "trainer": {"bags": ROOT / "bags" / "dp_planter", "updates": 10_000_000}
            | {"output": f"{there}.safetensors", "targets": "counterfactual"},
        }[self.name]

    def live(self, number: int) -> End:
        """From start to the end by one signal."""
        self.trial += 1
        for heard in self.peer.heard.values():
            heard.clear()
        if self.policy is not None:
            self.policy.demands.clear()
        node, started_s = self.on.start(self.name, **self.parameters()), time.monotonic()
        while not handles(node):
            time.sleep(0.001)
        handlers_s = time.monotonic() - started_s
        if self.trial % 2:
            while not self.seen() and node.process.poll() is None:
                self.on.graph.spin_to(time.monotonic() + PERIOD_S)
        due_s = time.monotonic() + self.rng.uniform(0.0, LIFE_S)
        begins_s = time.monotonic() + self.rng.uniform(0.0, LIFE_S / 2)
        mode = self.rng.choice(("lockstep", "real_time"))
        begun = False
        while time.monotonic() < due_s:
            if self.plant is None or time.monotonic() < begins_s:
                self.on.graph.spin_to(min(due_s, time.monotonic() + PERIOD_S))
                continue
            if not begun:
                self.plant.begin(mode)
                begun = True
            self.plant.tick()
            self.on.graph.spin_to(min(due_s, self.plant.next_s()))
        phase = self.phase(begun)
        sent_s = time.monotonic()
        node.process.send_signal(number)
        while node.process.poll() is None and time.monotonic() < sent_s + 60.0:
            self.on.graph.spin_to(time.monotonic() + 0.005)
        exit_s = time.monotonic() - sent_s
        self.on.graph.spin(10)  # what it said last may still be on its way
        code = node.process.poll()
        return End(
            phase, -9 if code is None else code, "Traceback" in node.output,
            *self.left(), handlers_s, exit_s,
        )  # fmt: skip

    def seen(self) -> bool:
        """The node is in the graph."""
        return self.name in self.peer.node.get_node_names()

    def phase(self, begun: bool) -> str:
        """What the node does, as far as the other side can tell."""
        if not self.seen():
            return "starting"
        if self.name in POLICIES:
            return "driving" if self.plant is not None and self.plant.commands else "waiting"
        if self.name == "plant_sim":
            return "driving" if self.policy is not None and self.policy.demands else "waiting"
        if self.name == "bag_recorder":
            return "recording" if begun else "waiting"
        return "working"

    def left(self) -> tuple[bool | None, str]:
        """What is left behind: a policy's last command, a recorder's bag, a plant's result."""
        there = self.on.folder / f"{self.name}_{self.trial}"
        files = sorted(path.name for path in there.iterdir()) if there.exists() else []
        if self.name in POLICIES and self.plant is not None:
            return last_command(self.plant)
        if self.name == "bag_recorder":
            parts = [name for name in files if name.endswith(".part")]
            return not parts and (not files or "metadata.yaml" in files), ", ".join(files)
        if self.name == "plant_sim":
            return not files, ", ".join(files)
        return None, ""

    def close(self) -> None:
        """Leave the graph."""
        self.on.graph.remove(self.peer.node)


def last_command(plant: ScriptedPlant) -> tuple[bool | None, str]:
    """The last command says shutdown or fallback and is feasible; None where none was said."""
    if not plant.commands:
        return None, ""
    last: BatteryPowerCommand = plant.commands[-1][1]
    safe = last.mode is not CommandMode.NOMINAL and plant.safe(last) and not plant.unsafe
    said = f"{last.mode.name}, {last.battery_power_w:g} W, {plant.unsafe} not feasible"
    plant.commands.clear()
    return safe, said


def row(name: str, signal_name: str, ends: list[End]) -> tuple[str, ...]:
    """One line of the table."""
    phases = Counter(end.phase for end in ends)
    judged = [end.safe for end in ends if end.safe is not None]
    return (
        name,
        signal_name,
        ", ".join(f"{count} {phase}" for phase, count in sorted(phases.items())),
        f"{sum(end.code == 0 for end in ends)} of {len(ends)}",
        str(sum(end.traceback for end in ends)),
        f"{sum(judged)} of {len(judged)}" if judged else "-",
        *shown(quantiles([end.exit_s for end in ends]), "p50", "max", digits=2),
    )


def main(
    trials: int = 50,
    only: str = "",
    seed: int = 0,
    out: Path | None = None,
    record: str | None = None,
) -> None:
    """TRIALS of each signal to every node, or to the ONLY one named."""
    before, rng = machine(), random.Random(seed)
    rows, figures, notes = [], {}, []
    handlers_s: list[float] = []
    for name in NODES if not only else (only,):
        with stage() as on:
            # A plant of its own must not come to its end; one for dp_policy must be solved.
            steps = STEPS * (LONG if name == "plant_sim" else 1)
            demand_w = [90e3 + 100.0 * (k % STEPS) for k in range(steps)]
            cycle = write_cycle(on.folder / "work.csv", demand_w, 1.0)
            life = Life(on, name, cycle, rng)
            ask: Callable[[int], End] = life.live
            for signal_name, number in SIGNALS.items():
                ends = [ask(number) for _ in range(trials)]
                rows.append(row(name, signal_name, ends))
                handlers_s += [end.handlers_s for end in ends]
                bad = [end for end in ends if not end.clean]
                notes += [f"FAILURE: {name}, {signal_name}: {end}" for end in bad]
                figures[f"{name} {signal_name}"] = [vars_of(end) for end in ends]
            life.close()
    found = quantiles(handlers_s)
    notes.append(
        f"A signal comes up to {LIFE_S:g} s after the program's own handlers are there, or, in "
        "every other trial, after the node is in the graph. The handlers "
        f"take {found['p50']:.2f} s (middle) to {found['max']:.2f} s from the start of the "
        "process. Before that there is nothing but an interpreter that starts: the kernel ends "
        "it, and nothing has been said or written."
    )
    notes.append(
        "Left behind safe: a policy's last command has mode shutdown or fallback and is feasible; "
        "a recorder's bag is finished, or there is none; a plant leaves no result of half a run."
    )
    section = Section(
        f"{trials} of each signal to every node at random moments",
        ("node", "signal", "when it came", "code 0", "tracebacks", "left safe", "exit s, median",
         "max s"),
        rows, figures, notes,
    )  # fmt: skip
    publish(section, before, out, record)


def vars_of(end: End) -> dict[str, Any]:
    """The end as plain data."""
    return {name: getattr(end, name) for name in End.__dataclass_fields__}


if __name__ == "__main__":
    typer.run(main)
