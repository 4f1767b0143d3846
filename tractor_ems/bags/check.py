"""A verdict on a bag: named checks, each passed, failed or not applicable.

The verdict starts as "no data" and becomes "pass" only when every check was run and none failed,
so that a crash or an empty bag can never look like a pass.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tractor_ems.bags.announced_cycle import compare
from tractor_ems.bags.read import CONTRACT, read_bag, storage_file
from tractor_ems.bags.rosbags_messages import type_hash
from tractor_ems.bags.runs import Run, trajectory_of
from tractor_ems.bags.scan import Scan, ScannedChannel, scan_mcap
from tractor_ems.bags.transitions import traces_of
from tractor_ems.drive import drive
from tractor_ems.policies.protocol import ANY_RUN
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.observation import Observation, ObservationSpec
from tractor_msgs_py.trajectory import HASHED_COLUMNS, Trajectory, trajectory_hash
from tractor_sim.config import load_powertrain
from tractor_sim.powertrain import Command, PowertrainParams
from tractor_sim.powertrain_json import powertrain_hash
from tractor_sim.resources import resource_path

Outcome = Literal["pass", "fail", "not_applicable", "not_run"]

POWER_TOLERANCE_W = 1e-3
SOC_TOLERANCE = 1e-6
"""SOC travels as float32, whose resolution near 1 is 6e-8."""


@dataclass(frozen=True)
class Check:
    """One check: its name, how it went, and why."""

    name: str
    outcome: Outcome
    detail: str = ""


@dataclass(frozen=True)
class CheckReport:
    """The verdict on one bag.

    Attributes:
        bag: its path.
        verdict: ``pass``; ``fail`` when a check failed; ``no data`` when it cannot be read.
        checks: in a fixed order, every one of :data:`CHECKS`.
    """

    bag: str
    verdict: Literal["no data", "fail", "pass"]
    checks: tuple[Check, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)

    def outcome(self, name: str) -> Outcome:
        """How the named check went."""
        return next(check.outcome for check in self.checks if check.name == name)


@dataclass(frozen=True)
class _Evidence:
    runs: list[Run]
    scan: Scan | None
    params: PowertrainParams | None

    @property
    def channels(self) -> list[ScannedChannel]:
        """Channels of the wire contract."""
        found = () if self.scan is None else self.scan.channels
        return [c for c in found if c.topic.rpartition("/")[2] in CONTRACT]

    @property
    def driven(self) -> list[Run]:
        """Runs with states; demand alone cannot break a limit."""
        return [run for run in self.runs if any(run.driven)]

    def params_of(self, run: Run) -> PowertrainParams | None:
        """The run's powertrain: the given one, or the shipped one of its hash."""
        if self.params is not None or run.info is None:
            return self.params
        return shipped_powertrain(run.info.powertrain_hash)


Finding = tuple[Outcome, str]


def check(path: Path, params: PowertrainParams | None = None) -> CheckReport:
    """Run every check on a bag.

    Args:
        path: bag folder or storage file.
        params: the powertrain that was driven; None: the shipped one of the same hash.

    Raises:
        BagError: there is no such bag, or it was not finalised.
    """
    file = storage_file(path)
    done: list[Check] = []
    try:
        runs = read_bag(path)
        scan = None
        done.append(Check("readable", "pass", f"{len(runs)} runs"))
    except BagError as error:
        done.append(Check("readable", "fail", str(error)))
        done += [Check(name, "not_run") for name in CHECKS[1:]]
        return CheckReport(str(path), "no data", tuple(done))
    try:
        scan = scan_mcap(file) if file.suffix == ".mcap" else None
        done.append(Check("crcs", *_crcs(scan)))
    except BagError as error:
        done.append(Check("crcs", "fail", str(error)))
    evidence = _Evidence(runs, scan, params)
    done += [Check(name, *judge(evidence)) for name, judge in _JUDGES.items()]
    failed = any(item.outcome == "fail" for item in done)
    return CheckReport(str(path), "fail" if failed else "pass", tuple(done))


def shipped_powertrain(digest: str) -> PowertrainParams | None:
    """The shipped powertrain of this hash, or None."""
    for file in sorted(resource_path("config", "powertrain").glob("*.yaml")):
        params = load_powertrain(file)
        if powertrain_hash(params) == digest:
            return params
    return None


def _crcs(scan: Scan | None) -> Finding:
    if scan is None:
        return "not_applicable", "no MCAP file"
    if scan.chunks == 0 and not scan.data_crc:
        return "not_applicable", "not chunked"
    if scan.chunks_without_crc and not scan.data_crc:
        return "not_applicable", "the writer left CRCs out"
    return "pass", f"{scan.chunks} chunks"


def _type_hashes(evidence: _Evidence) -> Finding:
    """Message types are the contract's, and so are their RIHS01 hashes."""
    hashed = [c for c in evidence.channels if c.type_hash]
    if not hashed:
        return "not_applicable", "the writer left type hashes out"
    wrong = [c.topic for c in hashed if c.type_hash != type_hash(c.type)]
    return _verdict(wrong, f"{len(hashed)} topics")


def _qos(evidence: _Evidence) -> Finding:
    """Each channel says what QoS was offered."""
    if not evidence.channels:
        return "not_applicable", "no MCAP file"
    missing = [c.topic for c in evidence.channels if not c.qos.strip("[] \n")]
    return _verdict(missing, f"{len(evidence.channels)} topics")


def _stamps(evidence: _Evidence) -> Finding:
    """Stamps are set, ascend, and lie on the announced grid, or at equal steps."""
    reasons = ("zero_stamp", "stamp_backwards", "stamp_off_grid", "stamp_outside_run")
    wrong = [
        f"{run.refusals[reason]} x {reason}"
        for run in evidence.runs
        for reason in reasons
        if run.refusals.get(reason)
    ]
    for run in evidence.runs:
        irregular = sum(trace.irregular for trace in traces_of(run))
        if irregular:
            wrong.append(f"{irregular} intervals off by more than 1 %")
    return _verdict(wrong, f"{sum(len(run.demand) for run in evidence.runs)} ticks")


def _values(evidence: _Evidence) -> Finding:
    """Nothing but finite numbers, SOC within 0..1."""
    wrong = [
        f"{run.refusals[reason]} x {reason}"
        for run in evidence.runs
        for reason in ("not_finite", "soc_out_of_range", "demand_out_of_range")
        if run.refusals.get(reason)
    ]
    commands = [c for run in evidence.runs for c in run.command.values()]
    bad = sum(
        not math.isfinite(c.battery_power_w) or math.isinf(c.engine_power_w) for c in commands
    )
    return _verdict([*wrong, *([f"{bad} commands not finite"] if bad else [])], "all finite")


def _complete(evidence: _Evidence) -> Finding:
    """Every announced run reaches its last step."""
    announced = [run for run in evidence.runs if run.info is not None]
    if not announced:
        return "not_applicable", "demand only"
    wrong = [
        f"run {run.info.run_id}: {sum(run.driven)} of {run.info.steps} steps"
        for run in announced
        if run.info is not None and not run.complete
    ]
    return _verdict(wrong, f"{len(announced)} runs")


def _sequence(evidence: _Evidence) -> Finding:
    """No message and no tick is missing in between."""
    wrong = [f"{c.topic}: {c.lost} lost" for c in evidence.channels if c.lost]
    wrong += [f"{run.gaps} steps missing" for run in evidence.runs if run.gaps]
    wrong += [
        f"demand in {len(pieces)} pieces"
        for run in evidence.runs
        if not any(run.driven) and len(pieces := traces_of(run)) != 1
    ]
    return _verdict(wrong, "no gap")


def _soc_limits(evidence: _Evidence) -> Finding:
    """SOC stays within the powertrain's window."""
    known = [(run, evidence.params_of(run)) for run in evidence.driven]
    pairs = [(run, params.battery) for run, params in known if params is not None]
    if not pairs:
        return "not_applicable", "no states, or the powertrain is not known"
    wrong = []
    for run, battery in pairs:
        soc = [sample.soc for sample in run.battery.values()]
        low, high = min(soc), max(soc)
        if low < battery.soc_min - SOC_TOLERANCE or high > battery.soc_max + SOC_TOLERANCE:
            wrong.append(
                f"SOC {low:.6f}..{high:.6f}, allowed {battery.soc_min}..{battery.soc_max}"
            )
    return _verdict(wrong, f"{len(pairs)} runs")


def _power_limits(evidence: _Evidence) -> Finding:
    """Battery and engine power stay within the limits published before each step."""
    if not evidence.driven:
        return "not_applicable", "no states"
    broken = 0
    for run in evidence.driven:
        for before, after in _driven_pairs(run):
            state, then = run.powertrain[before], run.powertrain[after]
            battery_w, engine_w = then.applied_battery_power_w, then.applied_engine_power_w
            within = (
                -state.charge_limit_w - POWER_TOLERANCE_W
                <= battery_w
                <= state.discharge_limit_w + POWER_TOLERANCE_W
                and 0.0 <= engine_w <= state.engine_limit_w + POWER_TOLERANCE_W
            )
            broken += not within
    return _verdict([f"{broken} steps"] if broken else [], "every step")


def _energy_balance(evidence: _Evidence) -> Finding:
    """P_dem dt = (P_batt + P_eng) dt + shortfall - dissipated, at the bus."""
    if not evidence.driven:
        return "not_applicable", "no states"
    worst_w = 0.0
    for run in evidence.driven:
        assert run.info is not None
        for before, after in _driven_pairs(run):
            then = run.powertrain[after]
            supplied_w = then.applied_battery_power_w + then.applied_engine_power_w
            missing_w = (then.shortfall_j - then.dissipated_j) / run.info.dt_s
            worst_w = max(worst_w, abs(run.demand[before].power_w - supplied_w - missing_w))
    wrong = [f"imbalance up to {worst_w:g} W"] if worst_w > POWER_TOLERANCE_W else []
    return _verdict(wrong, f"worst {worst_w:g} W")


def _cycle(evidence: _Evidence) -> Finding:
    """The recorded demand, less the announced auxiliaries, is the announced cycle."""
    pairs = [(run, run.info) for run in evidence.runs if run.info is not None and run.complete]
    if not pairs:
        return "not_applicable", "no complete run"
    answers = [
        (compare(np.array([run.demand[stamp].power_w for stamp in run.stamps_ns]), said), said)
        for run, said in pairs
    ]
    wrong = [f"run {said.run_id}: not cycle {said.cycle}" for a, said in answers if a == "other"]
    same = [said.p_aux_w for answer, said in answers if answer == "same"]
    hidden = len(answers) - len(wrong) - len(same)
    lost = f"{hidden} runs of a cycle that is not listed, auxiliaries come off with rounding only"
    if not wrong and not same:
        return "not_applicable", lost
    aux = " and ".join(f"{power_w:g} W" for power_w in sorted({*same} - {0.0}))
    right = f"{len(same)} runs" + (f", less auxiliaries of {aux}" if aux else "")
    return _verdict(wrong, right + (f"; not compared: {lost}" if hidden else ""))


def _parity(evidence: _Evidence) -> Finding:
    """The commands, driven on the plant once more, give the same trajectory."""
    wrong, same = [], 0
    for run in evidence.driven:
        params, announced = evidence.params_of(run), run.info
        if params is None or announced is None or run.gaps or not announced.lockstep:
            continue
        if powertrain_hash(params) != announced.powertrain_hash:
            wrong.append(f"run {announced.run_id}: another powertrain than {params.name}")
            continue
        recorded = trajectory_of(run)
        again = drive(
            Replay(recorded),
            params,
            recorded.power_demand_w[None, :],
            announced.soc_initial,
            announced.soc_target,
            announced.t0_ns,
        )[0]
        if trajectory_hash(again) == trajectory_hash(recorded):
            same += 1
        else:
            wrong.append(f"run {announced.run_id}: {first_difference(recorded, again)}")
    if not wrong and not same:
        return "not_applicable", "no lockstep run without gaps on a known powertrain"
    return _verdict(wrong, f"{same} runs")


@dataclass(frozen=True)
class Replay:
    """A policy that repeats recorded commands; its state is the tick."""

    trajectory: Trajectory
    name: str = "replay"
    spec: ObservationSpec = ANY_RUN

    def init(self, batch: int) -> int:
        """The first tick."""
        return 0

    def act(self, observation: Observation, state: int) -> tuple[Command, int]:
        """The command of this tick."""
        columns = self.trajectory
        return (
            Command(
                columns.command_battery_power_w[state : state + 1],
                columns.command_engine_power_w[state : state + 1],
            ),
            state + 1,
        )


def first_difference(one: Trajectory, other: Trajectory) -> str:
    """Where two trajectories of equal length part, in words."""
    steps = {}
    for name in HASHED_COLUMNS:
        a, b = np.asarray(getattr(one, name)), np.asarray(getattr(other, name))
        apart = np.flatnonzero(~((a == b) | (np.isnan(a) & np.isnan(b))))
        if len(apart):
            steps[name] = int(apart[0])
    if not steps:
        return "no difference"
    name = min(steps, key=lambda key: steps[key])
    k = steps[name]
    return f"{name} differs from step {k}: {getattr(one, name)[k]}, not {getattr(other, name)[k]}"


def _driven_pairs(run: Run) -> list[tuple[int, int]]:
    """Stamps before and after each driven step."""
    assert run.info is not None
    pairs = zip(run.stamps_ns, run.ends_ns, run.driven, strict=True)
    return [(before, after) for before, after, driven in pairs if driven]


def _verdict(wrong: Sequence[str], right: str) -> Finding:
    if not wrong:
        return "pass", right
    more = len(wrong) - 3
    return "fail", "; ".join(wrong[:3]) + (f"; {more} more" if more > 0 else "")


_JUDGES: dict[str, Callable[[_Evidence], Finding]] = {
    "type_hashes": _type_hashes,
    "qos": _qos,
    "stamps": _stamps,
    "values": _values,
    "complete": _complete,
    "sequence": _sequence,
    "soc_limits": _soc_limits,
    "power_limits": _power_limits,
    "energy_balance": _energy_balance,
    "cycle": _cycle,
    "parity": _parity,
}

CHECKS = ("readable", "crcs", *_JUDGES)
"""Names of all checks, in the order of a report."""
