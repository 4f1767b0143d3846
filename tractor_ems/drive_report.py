"""What a policy's node tells people: diagnostics, a line at the end, a JSON file. Pure."""

import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from tractor_ems.decide import Decider, Decision
from tractor_ems.latency import Latencies
from tractor_ems.policies.protocol import Policy
from tractor_ems.shadow_log import ShadowLog
from tractor_msgs_py import supervisor
from tractor_msgs_py.atomic import write_json
from tractor_msgs_py.supervisor import Condition
from tractor_msgs_py.types import BatteryPowerCommand, RunInfo


class Answers(Protocol):
    """What ``Answerer`` and ``SampledAnswerer`` have in common."""

    @property
    def policy(self) -> Policy: ...

    @property
    def decider(self) -> Decider: ...

    @property
    def decision(self) -> Decision | None: ...

    @property
    def run(self) -> RunInfo | None: ...

    @property
    def refusals(self) -> Counter[str]: ...

    @property
    def counters(self) -> dict[str, int]: ...

    @property
    def active(self) -> bool: ...

    def start_run(self, run: RunInfo) -> None: ...

    def aim(self, soc_target: float | None) -> None: ...

    def overdue(self, now_s: float) -> BatteryPowerCommand | None: ...

    def shutdown_command(self) -> BatteryPowerCommand | None: ...


def state_of(answers: Answers) -> str:
    """Where it is, in a few words."""
    decider = answers.decider
    if not answers.active and decider.trust.condition is Condition.INIT:
        return "waiting for a run" if answers.run is None else "waiting for observations"
    mode, trust = decider.mode.name.lower(), decider.trust
    driving = "driving" if decider.handover.commanding else "following"
    if trust.condition in (Condition.INIT, Condition.NOMINAL):
        if decider.away:
            return f"{driving}, fallback law: outside what the policy was trained on"
        return driving if mode in ("engaged", "shadow") else f"{driving}, {mode}"
    return supervisor.describe(trust)


def values_of(
    answers: Answers,
    latencies: Latencies,
    mismatches: Mapping[str, str],
    log: ShadowLog | None,
    others: int,
) -> dict[str, object]:
    """Everything people may want to see, flat."""
    decider = answers.decider
    missing: Mapping[str, str] = getattr(answers, "missing", {})
    complaints: Mapping[str, str] = getattr(answers, "complaints", {})
    values: dict[str, object] = {
        "policy": answers.policy.name,
        "run_id": answers.run.run_id if answers.run else "",
        "mode": decider.mode.name.lower(),
        "condition": decider.trust.condition.name,
        "reason": supervisor.REASON_TEXT[decider.trust.reason],
        "other_policies": others,
        **answers.counters,
        **{f"bad_{reason}": count for reason, count in sorted(decider.reasons.items())},
        **{f"latency_{key}": value for key, value in latencies.summary.items()},
    }
    for name, why in missing.items():
        values[f"missing_{name}"] = complaints.get(name, why) if why == "implausible" else why
    values |= {f"qos_{topic}": f"a peer's {policy}" for topic, policy in mismatches.items()}
    for name, text in (("implausible", decider.complaint), ("policy_error", decider.trouble)):
        if text:
            values[name] = text
    values |= _envelope_values(decider) | _planned_values(decider)
    if log is not None:
        values["shadow_log"] = log.sum.line
        if log.trouble:
            values["shadow_log_error"] = log.trouble
    return values


def _envelope_values(decider: Decider) -> dict[str, object]:
    """What lies, or lay a moment ago, outside what the policy was trained on, and how often."""
    if decider.config.envelope is None:
        return {}
    watch, counted = decider.envelope, sorted(decider.outside_ticks.items())
    said = "away" if watch.away else "outside" if watch.suspect else "inside"
    values: dict[str, object] = {"envelope": said}
    if watch.suspect:
        values["outside_envelope"] = watch.text
    return values | {f"outside_{signal}": count for signal, count in counted}


def _planned_values(decider: Decider) -> dict[str, object]:
    """The planned end, where there is one."""
    seen, work_s = decider.observation, decider.plan.work_s
    values: dict[str, object] = {"planned_work_s": work_s} if work_s else {}
    if decider.plan.passed:
        return values | {"time_left_s": 0.0, "planned_end": "passed: holding the SOC target"}
    left_s = math.inf if seen is None else float(seen.time_left_s[0])
    return values | ({"time_left_s": left_s} if math.isfinite(left_s) else {})


def warns(
    answers: Answers, mismatches: Mapping[str, str], log: ShadowLog | None, others: int
) -> bool:
    """True where somebody should look."""
    decider = answers.decider
    trusted = decider.trust.condition in (Condition.INIT, Condition.NOMINAL)
    doubled = others > 0 and decider.handover.commanding
    spoken = decider.corrected > 0 or decider.fallbacks > 0
    spoken |= decider.envelope.suspect
    lacking = bool(getattr(answers, "missing", {})) or (log is not None and log.trouble != "")
    return doubled or spoken or lacking or bool(mismatches) or not trusted


def line_of(answers: Answers, latencies: Latencies, log: ShadowLog | None) -> str:
    """The end of a node's life in one line; empty where it did nothing."""
    if not latencies.count and (log is None or not log.sum.ticks):
        return ""
    parts = []
    if latencies.count:
        ms = {name: 1e3 * latencies.summary[name] for name in ("p50_s", "p99_s", "max_s")}
        missed = answers.counters.get("missed_ticks")
        parts.append(
            f"{latencies.count} commands"
            + ("" if missed is None else f", {missed} missed ticks")
            + f", {answers.decider.fallbacks} fallbacks, latency p50 {ms['p50_s']:.2f} ms, "
            f"p99 {ms['p99_s']:.2f} ms, max {ms['max_s']:.2f} ms"
        )
    if log is not None:
        parts.append(log.sum.line)
    return "; ".join(parts)


def write_report(path: Path, values: Mapping[str, object]) -> None:
    """The values as JSON, whole or not at all. Raises ConfigError where it cannot be written."""
    document: dict[str, Any] = dict(values)
    write_json(path, document)
