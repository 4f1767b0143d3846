"""Is a bag, read through a signal map, fit to learn from: covered, often enough, plausible?"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tractor_ems.bags.any_messages import AnyBag
from tractor_ems.bags.sampled import NEEDED, SampledBag, Wiring, read_sampled, wire
from tractor_ems.bags.topic_fields import Rhythm, rhythm_of
from tractor_ems.signals.vehicle import sampled_spec, values_of
from tractor_msgs_py.observation import SAMPLED_SIGNALS, SampledTick
from tractor_msgs_py.signals import MappedSignal, SignalMap, Source
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.powertrain import PowertrainParams

Outcome = Literal["pass", "warn", "fail"]

FRESH_ENOUGH = 0.9
"""Share of ticks at which a signal must be known, from its first one on."""

BALANCE_SHARE = 0.1
"""Bus balance that does not close to within this share of the usual demand is a wrong map."""

ACTIVE_SHARE, ENOUGH_TICKS = 0.05, 10
"""A battery works at a power above this share of the usual demand; of fewer such ticks nothing
follows."""

SOC_MOVED = 0.002
"""Change of SOC below which nothing follows from it."""


@dataclass(frozen=True)
class SignalReport:
    """One mapped signal in a bag; None where there is nothing to say.

    Attributes:
        covered: the bag has messages with every field of the signal.
        messages, rate_hz, jitter_s, largest_gap_s: of its slowest source.
        fresh: share of ticks with a value, from the first one with any on.
        low, mean, high: of the sampled values, in SI units.
    """

    signal: str
    outcome: Outcome
    detail: str
    covered: bool
    messages: int
    rate_hz: float | None
    jitter_s: float | None
    largest_gap_s: float | None
    fresh: float | None
    low: float | None
    mean: float | None
    high: float | None


@dataclass(frozen=True)
class Finding:
    """What several signals together say."""

    name: str
    outcome: Outcome
    detail: str


@dataclass(frozen=True)
class CoverageReport:
    """All of it; ``verdict`` is ``pass`` unless something fails."""

    bag: str
    signals_file: str
    namespace: str
    dt_s: float
    ticks: int
    signals: tuple[SignalReport, ...]
    findings: tuple[Finding, ...]
    refusals: dict[str, int]
    verdict: Literal["pass", "fail"]

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)


def check_coverage(
    path: Path,
    signals: SignalMap,
    dt_s: float,
    *,
    namespace: str | None = None,
    params: PowertrainParams | None = None,
) -> CoverageReport:
    """Judge a bag through a map, sampled every ``dt_s``.

    Args:
        path: bag folder or storage file.
        signals: the map.
        dt_s: period of the policy to be [s].
        namespace: of the map's relative topics; None: the only one that fits.
        params: powertrain whose battery SOC and battery power must agree with; None: not looked
            at.

    Raises:
        BagError: the bag cannot be read, or has no topic for the demand, or one of another type.
    """
    bag = AnyBag(path)
    wiring = wire(bag, signals, namespace)
    stamps = _stamps(bag, wiring)
    spec = sampled_spec(signals, dt_s, needed=NEEDED)
    sampled = read_sampled(path, signals, spec, namespace=wiring.namespace)
    ticks = [tick for run in sampled.runs for tick in run.ticks]
    reports = tuple(_report(signal, wiring, stamps, sampled, ticks) for signal in signals.signals)
    findings = [
        *_needed(signals),
        *_used(sampled, ticks),
        *_balance(ticks),
        *([] if params is None else _soc_follows_power(ticks, dt_s, params)),
    ]
    outcomes = [*(item.outcome for item in reports), *(item.outcome for item in findings)]
    return CoverageReport(
        bag=str(path),
        signals_file=signals.origin,
        namespace=wiring.namespace,
        dt_s=dt_s,
        ticks=len(ticks),
        signals=reports,
        findings=tuple(findings),
        refusals=dict(sampled.refusals),
        verdict="fail" if "fail" in outcomes else "pass",
    )


def _stamps(bag: AnyBag, wiring: Wiring) -> dict[Source, list[int]]:
    found: dict[Source, list[int]] = {s: [] for group in wiring.sources.values() for s in group}
    for heard in bag.messages(list(wiring.sources)):
        if heard.message is None:
            continue
        sources = wiring.sources[heard.topic]
        for source, stamp_ns, _ in values_of(sources, heard.message, heard.publish_ns):
            found[source].append(stamp_ns)
    return found


def _report(
    signal: MappedSignal,
    wiring: Wiring,
    stamps: dict[Source, list[int]],
    sampled: SampledBag,
    ticks: Sequence[SampledTick],
) -> SignalReport:
    name = signal.name
    missing = wiring.absent.get(name, ())
    empty = [s for s in signal.sources if not missing and not stamps[s]]
    rhythm = Rhythm(0, None, None, None)
    if not missing:
        rhythm = min((rhythm_of(stamps[s]) for s in signal.sources), key=lambda r: r.messages)
    values = [tick.frame.values[name] for tick in ticks if name in tick.frame.values]
    known = [name not in tick.frame.missing for tick in ticks]
    first = next(
        (k for k, tick in enumerate(ticks) if tick.frame.missing.get(name) != "absent"), len(ticks)
    )
    fresh = float(np.mean(known[first:])) if first < len(ticks) else None
    outcome, detail = _judge(name, missing, empty, fresh, sampled, ticks)
    return SignalReport(
        signal=name,
        outcome=outcome,
        detail=detail,
        covered=not missing and not empty,
        messages=rhythm.messages,
        rate_hz=rhythm.rate_hz,
        jitter_s=rhythm.jitter_s,
        largest_gap_s=rhythm.largest_gap_s,
        fresh=fresh,
        low=min(values, default=None),
        mean=float(np.mean(values)) if values else None,
        high=max(values, default=None),
    )


def _judge(
    name: str,
    missing: Sequence[str],
    empty: Sequence[Source],
    fresh: float | None,
    sampled: SampledBag,
    ticks: Sequence[SampledTick],
) -> tuple[Outcome, str]:
    vital: Outcome = "fail" if name in NEEDED else "warn"
    if missing:
        return vital, f"not in the bag: {', '.join(missing)}"
    if empty:
        return "fail", f"no message of {empty[0].topic} holds {empty[0].field}"
    wrong = sum(tick.frame.missing.get(name) == "implausible" for tick in ticks)
    if wrong:
        return "fail", f"{sampled.complaints.get(name, '')} ({wrong} of {len(ticks)} ticks)"
    if fresh is None:
        return vital, "never known: no sample of it could be used"
    if fresh < FRESH_ENOUGH:
        stale = sum(tick.frame.missing.get(name) == "stale" for tick in ticks)
        return vital, f"older than its max_age_s at {stale} of {len(ticks)} ticks"
    return "pass", ""


def _needed(signals: SignalMap) -> list[Finding]:
    names = signals.names
    lacking = [
        name
        for name in SAMPLED_SIGNALS
        if name not in names and not (name == "engine_power_w" and "battery_power_w" in names)
    ]
    if not lacking:
        return [Finding("policy_signals", "pass", "all that a policy needs to drive is mapped")]
    text = f"not mapped: {', '.join(lacking)}; enough to learn from, not to drive"
    return [Finding("policy_signals", "warn", text)]


def _used(sampled: SampledBag, ticks: Sequence[SampledTick]) -> list[Finding]:
    """How much of the bag came to nothing."""
    findings = []
    known = sum("power_demand_w" in tick.frame.values for tick in ticks)
    if known < 2:
        text = f"power_demand_w is known at {known} ticks, allowed from 2"
        findings.append(Finding("ticks", "fail", text))
    if silent := sampled.refusals.get("silent_ticks", 0):
        text = f"all topics are silent for {silent} more ticks, where traces end"
        findings.append(Finding("silence", "warn", text))
    if sampled.refused_samples:
        counts = sampled.refused_by_reason.items()
        text = "not used: " + ", ".join(f"{reason} {count}" for reason, count in counts)
        findings.append(Finding("samples", "warn", text))
    return findings


def _paired(ticks: Sequence[SampledTick], *names: str) -> list[FloatArray]:
    """Values of the ticks that have all of them, one array per name."""
    rows = [t.frame.values for t in ticks if all(name in t.frame.values for name in names)]
    return [np.array([row[name] for row in rows]) for name in names]


def _balance(ticks: Sequence[SampledTick]) -> list[Finding]:
    """Demand = battery + engine, where all three are there: signs, units and missing loads."""
    demand_w, battery_w, engine_w = _paired(
        ticks, "power_demand_w", "battery_power_w", "engine_power_w"
    )
    if len(demand_w) < 2:
        return []
    usual_w = max(float(np.median(np.abs(demand_w))), 1e3)
    active = np.abs(battery_w) > ACTIVE_SHARE * usual_w

    def off_w(battery_w: FloatArray) -> float:
        """Usually, or usually while the battery works, which alone shows its sign."""
        rest_w = np.abs(demand_w - battery_w - engine_w)
        working_w = rest_w[active] if active.sum() >= ENOUGH_TICKS else rest_w
        return float(max(np.median(rest_w), np.median(working_w)))

    share, flipped = off_w(battery_w) / usual_w, off_w(-battery_w) / usual_w
    text = f"demand - battery - engine is off by {share:.1%} of the usual demand"
    if share <= BALANCE_SHARE:
        return [Finding("power_balance", "pass", text)]
    if flipped <= BALANCE_SHARE:
        text += f", with the other sign of battery_power_w by {flipped:.1%}: sign: -1 in the map"
    return [Finding("power_balance", "fail", text)]


def _soc_follows_power(
    ticks: Sequence[SampledTick], dt_s: float, params: PowertrainParams
) -> list[Finding]:
    """SOC falls by the energy that the battery gives."""
    soc, battery_w = _paired(ticks, "soc", "battery_power_w")
    if len(soc) < 2:
        return []
    taken = np.cumsum(battery_w) * dt_s / params.battery.energy_j
    moved = float(taken.max() - taken.min())
    if moved < SOC_MOVED:
        text = f"battery power moves SOC by {moved:.2%} only, too little to compare"
        return [Finding("soc_follows_power", "warn", text)]
    slope = float(np.polyfit(taken, soc[0] - soc, 1)[0])
    text = f"SOC falls by {slope:.2f} of what battery_power_w and {params.name}'s battery say"
    if 0.7 <= slope <= 1.4:
        return [Finding("soc_follows_power", "pass", text)]
    if slope < 0:
        text += "; the sign of battery_power_w is wrong: > 0 discharges"
    elif slope < 0.7:
        text += "; the battery is larger, or the power too large"
    else:
        text += "; the battery is smaller, or the power too small"
    return [Finding("soc_follows_power", "fail", text)]
