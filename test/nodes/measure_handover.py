"""A real policy that is engaged and disengaged at random moments while it drives a real plant: the
worst step of the generator's set-point against the ramp that was asked for. A report, no test.

python test/nodes/measure_handover.py [--trials N] [--out FILE.json]
"""

import random
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import typer
from measuring import Section, machine, publish, quantiles
from nodes.scripted import SOC, TENTH, write_cycle
from nodes.stage import Stage, stage
from std_srvs.srv import SetBool

from tractor_msgs_py import topics
from tractor_msgs_py.types import BatteryPowerCommand, CommandMode, PowertrainReading

PERIOD_S = 0.1
DEMAND_W = 100e3
"""The rule leaves it to the battery, the fallback law to the engine: a hand-over moves it all."""

RAMP_W_PER_S = 60e3
TOLERANCE_W = 1.0
LONGEST_S = 3.5
"""Longest time between two calls; a hand-over takes 2 s."""

MODES: dict[str, dict[str, Any]] = {"exact": {}, "sampled": {"signals": "signals"}}


class Drive:
    """Plant and policy, what the plant did, and the service that engages."""

    def __init__(self, on: Stage, mode: str, steps: int) -> None:
        self.on = on
        self.powers_w: dict[int, float] = {}
        self.commands: list[BatteryPowerCommand] = []
        peer = on.graph.peer(topics.POWERTRAIN, topics.COMMAND, name="watcher")
        peer.on_sample = self._hear
        cycle = write_cycle(on.folder / "even.csv", [DEMAND_W] * steps, PERIOD_S)
        self.policy = on.start(
            "rule_based_policy", powertrain=TENTH, ramp_w_per_s=RAMP_W_PER_S, **MODES[mode]
        )
        self.plant = on.start(
            "plant_sim", powertrain=TENTH, cycle=cycle, mode="real_time", soc_initial=SOC
        )
        self._client = peer.node.create_client(SetBool, "/rule_based_policy/enable")

    def _hear(self, sample: Any) -> None:
        if isinstance(sample, PowertrainReading):
            self.powers_w[sample.stamp_ns] = sample.applied_engine_power_w
        elif isinstance(sample, BatteryPowerCommand):
            self.commands.append(sample)

    @property
    def power_w(self) -> float:
        """The generator's, over the newest step [W]."""
        return self.powers_w[max(self.powers_w)]

    def enable(self, wanted: bool) -> Any:
        """Call the service; its answer."""
        # A service is found before both its topics are, and a call made then gets no answer.
        self.on.graph.spin_until(self._client.service_is_ready, "the service")
        asked = self._client.call_async(SetBool.Request(data=wanted))
        self.on.graph.spin_until(asked.done, "an answer of the service")
        return asked.result()

    def worst(self) -> list[str]:
        """Every step beyond the ramp, with what the policy had said last."""
        stamps, period_ns = sorted(self.powers_w), round(PERIOD_S * 1e9)
        told = []
        for a, b in pairwise(stamps):
            step_w = self.powers_w[b] - self.powers_w[a]
            if b - a != period_ns or abs(step_w) <= RAMP_W_PER_S * PERIOD_S + TOLERANCE_W:
                continue
            said = [command for command in self.commands if command.stamp_ns <= a]
            last = max(said, key=lambda command: command.stamp_ns, default=None)
            what = "nothing" if last is None else f"{last.mode.name}, {last.reason.name}"
            age_s = 0.0 if last is None else (a - last.stamp_ns) * 1e-9
            told.append(f"{step_w * 1e-3:+.3f} kW, {age_s:.1f} s after the policy said {what}")
        return told

    def steps_w(self) -> list[float]:
        """Every change of generator power from one step to the next [W]."""
        stamps = sorted(self.powers_w)
        period_ns = round(PERIOD_S * 1e9)
        return [
            abs(self.powers_w[b] - self.powers_w[a])
            for a, b in pairwise(stamps)
            if b - a == period_ns
        ]


def hand_over(mode: str, trials: int, rng: random.Random) -> dict[str, Any]:
    """Out of the drive and into it again, ``trials`` times."""
    with stage() as on:
        drive = Drive(on, mode, round(trials * 3.0 * LONGEST_S / PERIOD_S) + 600)
        # The start is no hand-over: begin when the policy drives.
        on.graph.spin_until(lambda: drive.powers_w and drive.power_w == 0.0, "the policy to drive")
        on.graph.spin_to(time.monotonic() + 1.0)
        drive.powers_w = {max(drive.powers_w): 0.0}
        refused, between, engaged, left = [], 0, 0, 0
        for _ in range(trials):
            for wanted in (False, True):
                between += 1.0 < drive.power_w < DEMAND_W - 1.0
                while not (answer := drive.enable(wanted)).success and len(refused) < trials:
                    refused.append(answer.message)
                    on.graph.spin_to(time.monotonic() + PERIOD_S)
                # From the middle of a ramp to long after it.
                on.graph.spin_to(time.monotonic() + rng.uniform(0.1, LONGEST_S))
                engaged += wanted and drive.power_w == 0.0
                left += not wanted and drive.power_w == DEMAND_W
        codes = [on.end(drive.policy), on.end(drive.plant)]
        modes = [command.mode for command in drive.commands]
        policy_said = drive.policy.output
        assert codes == [0, 0], policy_said + drive.plant.output
    return {
        "steps_w": quantiles(drive.steps_w()),
        "ticks": len(drive.powers_w),
        "beyond": len(drive.worst()),
        "worst": drive.worst(),
        "policy_said": policy_said.splitlines()[-20:],
        "calls": 2 * trials,
        "refused": refused,
        "in_mid_ramp": between,
        "engaged": engaged,
        "left": left,
        "fallback_commands": sum(said is CommandMode.FALLBACK for said in modes),
    }


def row(mode: str, found: dict[str, Any]) -> tuple[str, ...]:
    """One line of the table."""
    return (
        mode,
        str(found["calls"]),
        str(len(found["refused"])),
        str(found["in_mid_ramp"]),
        f"{found['left']} / {found['engaged']}",
        str(found["ticks"]),
        f"{found['steps_w']['max'] * 1e-3:.3f}",
        f"{RAMP_W_PER_S * PERIOD_S * 1e-3:.3f}",
        str(found["beyond"]),
    )


def main(
    trials: int = 100, seed: int = 0, out: Path | None = None, record: str | None = None
) -> None:
    """Hand over TRIALS times there and back, by equal stamps and through a signal map."""
    before, rng = machine(), random.Random(seed)
    found = {mode: hand_over(mode, trials, rng) for mode in MODES}
    notes = [
        f"BEYOND THE RAMP, {mode}: {f['beyond']} of {f['ticks']} ticks, worst "
        f"{f['steps_w']['max'] * 1e-3:.3f} kW: {'; '.join(f['worst'])}"
        for mode, f in found.items()
        if f["beyond"]
    ]
    notes += [
        f"REFUSED, {mode}: {len(f['refused'])} calls, the last: {f['refused'][-1]}"
        for mode, f in found.items()
        if f["refused"]
    ]
    notes.append(
        f"Demand is {DEMAND_W * 1e-3:g} kW all the time: the policy leaves it to the battery, the "
        "fallback law to the engine, so every hand-over moves all of it. The plant limits nothing "
        "itself. In mid-ramp: calls that came while an earlier hand-over was under way."
    )
    section = Section(
        f"Out of the drive and into it, {trials} times at random moments, ramp "
        f"{RAMP_W_PER_S * 1e-3:g} kW/s",
        ("observations", "calls", "refused", "in mid-ramp", "came to the end, out / in", "ticks",
         "worst step kW", "allowed kW", "beyond"),
        [row(mode, f) for mode, f in found.items()],
        found,
        notes,
    )  # fmt: skip
    publish(section, before, out, record)


if __name__ == "__main__":
    typer.run(main)
