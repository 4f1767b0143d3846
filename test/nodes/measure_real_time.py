"""A real policy that drives a real plant at 10 Hz in real time: how many ticks were missed, and
how long it took from an observation that is complete to its command. A report, no test.

python test/nodes/measure_real_time.py [--seconds 600] [--policy FILE] [--out FILE.json]
"""

import json
import time
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import psutil
import typer
from measuring import Section, machine, publish, quantiles, shown
from nodes.scripted import random_demand, write_cycle
from nodes.stage import Process, Stage, stage

from tractor_ems.policies.q_policy import load_policy
from tractor_msgs_py import topics
from tractor_msgs_py.codec import decode_command, stamp_to_ns
from tractor_msgs_py.ros.messages import CLASSES
from tractor_msgs_py.ros.shell import qos_profile
from tractor_msgs_py.types import CommandMode
from tractor_sim.run_files import read_run

PERIOD_S = 0.1
POWERTRAIN = "paper:dt_s=0.1"
MODES = {"exact": {}, "sampled": {"signals": "signals"}}
TELLS = (topics.POWER_DEMAND, topics.BATTERY, topics.POWERTRAIN)
DISCOVERY_S = 60.0


@dataclass
class Heard:
    """When each tick's words were published, by the publishers' own stamps in the middleware, so
    that this process's pace does not count [ns].

    Attributes:
        said: topic to tick to time; the first publication counts.
        answered: tick to time of its first nominal command.
        fallbacks: commands that were not nominal, after the first that was.
    """

    said: dict[str, dict[int, int]] = field(default_factory=lambda: {t.name: {} for t in TELLS})
    answered: dict[int, int] = field(default_factory=dict)
    fallbacks: int = 0

    def listen(self, on: Stage) -> None:
        """Subscribe to both sides."""
        node = on.graph.node("listener")
        for topic in (*TELLS, topics.COMMAND):
            node.create_subscription(
                CLASSES[topic.type], topic.name, self._receiver(topic), qos_profile(topic.qos)
            )

    def _receiver(self, topic: topics.Topic) -> Any:
        def command(msg: Any, info: Any) -> None:
            said = decode_command(msg)
            if said.mode is CommandMode.NOMINAL:
                self.answered.setdefault(said.stamp_ns, info["source_timestamp"])
            else:
                self.fallbacks += bool(self.answered)

        def tick(msg: Any, info: Any) -> None:
            stamp_ns = stamp_to_ns(msg.header.stamp)
            self.said[topic.name].setdefault(stamp_ns, info["source_timestamp"])

        return command if topic is topics.COMMAND else tick


def cpu_share(process: Process, since: tuple[float, float] | None) -> tuple[float, float]:
    """CPU seconds of a process and the time now, or the share since then as the first value."""
    used = psutil.Process(process.process.pid).cpu_times()
    now = (used.user + used.system, time.monotonic())
    return now if since is None else ((now[0] - since[0]) / (now[1] - since[1]), now[1])


def drive(mode: str, seconds: float, executable: str, file: Path | None) -> dict[str, Any]:
    """One run, watched."""
    which = {"powertrain": POWERTRAIN} if file is None else {"policy_file": file.resolve()}
    with stage() as on:
        heard = Heard()
        heard.listen(on)
        steps = round(seconds / PERIOD_S)
        cycle = write_cycle(on.folder / "work.csv", random_demand(0, steps), PERIOD_S)
        report, output = on.folder / "report.json", on.folder / "run"
        policy = on.start(executable, **which, report=report, history_depth=100, **MODES[mode])
        plant = on.start(
            "plant_sim", powertrain=POWERTRAIN, cycle=cycle, mode="real_time", output=output,
            expected_recorders=1, command_timeout_s=0.5, history_depth=100,
        )  # fmt: skip
        on.graph.spin_until(lambda: heard.answered, "the first answer")
        before = [cpu_share(node, None) for node in (policy, plant)]
        deadline_s = time.monotonic() + seconds + DISCOVERY_S
        shares: list[float] = []
        while plant.process.poll() is None and time.monotonic() < deadline_s:
            on.graph.spin_to(time.monotonic() + 0.5)
            if len(heard.answered) > 0.95 * steps and not shares:
                pairs = zip((policy, plant), before, strict=True)
                shares = [cpu_share(node, since)[0] for node, since in pairs]
        codes = [on.end(plant), on.end(policy)]
        assert codes == [0, 0], plant.output + policy.output
        _, result = read_run(output)
        said = json.loads(report.read_text())
    return {"cpu": shares, "plant": result["counters"], "policy": said, **judged(heard)}


def judged(heard: Heard) -> dict[str, Any]:
    """Latencies and missed ticks; the first second, in which everybody finds everybody, too."""
    demand = heard.said[topics.POWER_DEMAND.name]
    ticks = sorted(demand)
    complete = {
        stamp: max(times)
        for stamp in ticks
        if len(times := [heard.said[t.name][stamp] for t in TELLS if stamp in heard.said[t.name]])
        == len(TELLS)
    }
    latency = [(heard.answered[s] - complete[s]) * 1e-6 for s in complete if s in heard.answered]
    period = [(demand[b] - demand[a]) * 1e-6 for a, b in pairwise(ticks)]
    late = [
        s for s, after in pairwise(ticks)
        if s in heard.answered and heard.answered[s] > demand[after]
    ]  # fmt: skip
    return {
        "ticks": len(ticks),
        "unheard_ticks": len(ticks) - len(complete),
        "unanswered": sum(s not in heard.answered for s in ticks),
        "answered_late": len(late),
        "fallback_commands": heard.fallbacks,
        "latency_ms": quantiles(latency),
        "period_ms": quantiles(period),
        "plant_late": sum(p > 1.5e3 * PERIOD_S for p in period),
    }


def row(mode: str, found: dict[str, Any]) -> tuple[str, ...]:
    """One line of the table."""
    own = {k: 1e3 * v for k, v in latency_of(found["policy"]).items() if k.endswith("_s")}
    return (
        mode,
        str(found["ticks"]),
        f"{found['unanswered']} + {found['answered_late']}",
        str(found["plant"]["fallback_ticks"]),
        str(found["plant_late"]),
        " / ".join(f"{own[k]:.1f}" for k in ("p50_s", "p99_s", "max_s")) if own else "-",
        " / ".join(shown(found["latency_ms"], "p50", "p99", "max", digits=1)),
        " / ".join(shown(found["period_ms"], "min", "p50", "max", digits=1)),
        " / ".join(f"{100 * share:.0f}" for share in found["cpu"]),
    )


def latency_of(report: dict[str, Any]) -> dict[str, float]:
    """The policy node's own latencies in its report."""
    return {name: report[f"latency_{name}"] for name in ("p50_s", "p99_s", "max_s")}


def main(
    seconds: float = 600.0,
    executable: str = "rule_based_policy",
    policy: Path | None = None,
    out: Path | None = None,
    record: str | None = None,
) -> None:
    """Drive for SECONDS with observations of equal stamp, then as long through a signal map.

    With --policy, a policy file for that powertrain, ddqn_policy drives instead; one that was
    learnt through a signal map drives through the plant's alone.
    """
    before = machine()
    modes = list(MODES)
    if policy is not None:
        executable = "ddqn_policy"
        if load_policy(policy).spec.mode == "sampled":
            modes = ["sampled"]
    found = {mode: drive(mode, seconds, executable, policy) for mode in modes}
    missed = {
        mode: f["unanswered"] + f["plant"]["fallback_ticks"] + f["plant_late"]
        for mode, f in found.items()
    }
    notes = [f"MISSED TICKS, {mode}: {count}" for mode, count in missed.items() if count]
    notes += [
        "Missed: ticks without a command + ticks answered after the next tick was out; steps that "
        "the plant drove by its fallback law; steps that came more than half a period late.",
        "Latencies in ms, p50 / p99 / max: the policy's own from the last sample of an "
        "observation that it took up to its command handed to the middleware; as the wire saw "
        "it from the plant's last publication of a tick to the policy's of its command. A tick of "
        "sampled signals waits up to 20 ms for samples on their way.",
        f"Powertrain {POWERTRAIN}, {executable}; a third process listens to every topic.",
    ]
    section = Section(
        f"{seconds:g} s at 10 Hz in real time",
        ("observations", "ticks", "unanswered + late", "fallback steps", "late steps",
         "own latency ms", "wire latency ms", "plant period ms, min / p50 / max",
         "CPU %, policy / plant"),
        [row(mode, f) for mode, f in found.items()],
        found,
        notes,
    )  # fmt: skip
    publish(section, before, out, record)


if __name__ == "__main__":
    typer.run(main)
