"""One recorded run: its samples by stamp, and what follows from them.

Pure grouping and joining of decoded samples; files are ``read``'s business.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeAlias

import numpy as np

from tractor_msgs_py.errors import BagError
from tractor_msgs_py.observation import Observation, ObservationBuilder, ObservationSpec
from tractor_msgs_py.refusal import refusal
from tractor_msgs_py.trajectory import Trajectory
from tractor_msgs_py.types import (
    BatteryPowerCommand,
    BatteryReading,
    CommandMode,
    PowerDemand,
    PowertrainReading,
    RunInfo,
    Sample,
)

StampedSample: TypeAlias = PowerDemand | BatteryReading | PowertrainReading | BatteryPowerCommand


@dataclass(frozen=True)
class Run:
    """One run of one tractor as it was recorded.

    Attributes:
        info: what the plant announced; None for a demand-only recording.
        namespace: of its topics, ``/`` or for instance ``/tractor1``.
        policy: who commanded, as the recorder saw it; empty when unknown.
        demand, battery, powertrain: stamp [ns] to the first accepted sample, stamps ascending.
        command: stamp to the first nominal answer to it.
        duplicates: repeated samples that were dropped (the plant resends what is unanswered).
        refusals: samples that must not be used, counted by reason.
    """

    info: RunInfo | None
    namespace: str
    policy: str
    demand: Mapping[int, PowerDemand]
    battery: Mapping[int, BatteryReading]
    powertrain: Mapping[int, PowertrainReading]
    command: Mapping[int, BatteryPowerCommand]
    duplicates: int
    refusals: Mapping[str, int]

    @cached_property
    def stamps_ns(self) -> Sequence[int]:
        """Stamps of the decisions: of the recorded demand, or of the announced grid.

        The grid ends at the last recorded stamp: a run that stopped early has fewer stamps than
        announced steps.
        """
        if self.info is None or not self.info.lockstep:
            return tuple(self.demand)
        recorded = (self.demand, self.battery, self.powertrain, self.command)
        last_ns = max((max(samples) for samples in recorded if samples), default=0)
        end_ns = min(last_ns + 1, self.info.stamp_ns(self.info.steps))
        return range(self.info.t0_ns, end_ns, self.info.dt_ns)

    @cached_property
    def ends_ns(self) -> Sequence[int]:
        """Stamps of the states after the decisions."""
        stamps = self.stamps_ns
        if self.info is None or not stamps:
            return stamps[1:]
        if isinstance(stamps, range):
            return range(stamps.start + stamps.step, stamps[-1] + stamps.step + 1, stamps.step)
        return (*stamps[1:], self.info.stamp_ns(self.info.steps))

    @cached_property
    def driven(self) -> tuple[bool, ...]:
        """Per decision: demand, state before and after, and in lockstep the answer, are there."""
        if self.info is None:
            return (False,) * len(self.stamps_ns)
        return tuple(
            stamp in self.demand
            and stamp in self.battery
            and stamp in self.powertrain
            and end in self.battery
            and end in self.powertrain
            and (stamp in self.command or not self.info.lockstep)
            for stamp, end in zip(self.stamps_ns, self.ends_ns, strict=True)
        )

    @property
    def complete(self) -> bool:
        """Every announced step was driven and recorded."""
        return self.info is not None and len(self.driven) == self.info.steps and all(self.driven)

    @property
    def gaps(self) -> int:
        """Steps missing before the last one that is there: stopping early is no gap."""
        last = max((k for k, there in enumerate(self.driven) if there), default=-1)
        return sum(not there for there in self.driven[: last + 1])


def trajectory_of(run: Run) -> Trajectory:
    """The columns of a recorded run; its hash equals that of the run that was recorded.

    Battery power, engine power, fuel and engine state of step k come from ``powertrain_state``
    k + 1, the command is the first nominal answer stamped t_k. Of an aborted run the driven
    steps are returned.

    Raises:
        BagError: there is no run_info, no driven step, or a step is missing in between.
    """
    if run.info is None:
        raise BagError("no run_info: a demand-only recording has no trajectory")
    if run.gaps:
        raise BagError(f"run {run.info.run_id}: {run.gaps} steps are missing")
    steps = sum(run.driven)
    if not steps:
        raise BagError(f"run {run.info.run_id}: no step was driven")
    stamps = run.stamps_ns[:steps]
    ends = run.ends_ns[:steps]
    after = [run.powertrain[stamp] for stamp in ends]
    unanswered = BatteryPowerCommand(0, math.nan)
    commands = [run.command.get(stamp, unanswered) for stamp in stamps]
    soc = np.array([run.battery[stamp].soc for stamp in stamps])
    return Trajectory(
        stamp_ns=np.array(stamps, dtype=np.int64),
        power_demand_w=np.array([run.demand[stamp].power_w for stamp in stamps]),
        soc_observed=soc,
        command_battery_power_w=np.array([command.battery_power_w for command in commands]),
        command_engine_power_w=np.array([command.engine_power_w for command in commands]),
        battery_power_w=np.array([state.applied_battery_power_w for state in after]),
        engine_power_w=np.array([state.applied_engine_power_w for state in after]),
        fuel_kg=np.array([state.fuel_kg for state in after]),
        engine_on=np.array([state.engine_on for state in after]),
        shortfall_j=np.array([state.shortfall_j for state in after]),
        dissipated_j=np.array([state.dissipated_j for state in after]),
        soc=soc,
        soc_final=run.battery[ends[-1]].soc,
    )


def observations_of(
    run: Run, spec: ObservationSpec
) -> tuple[list[Observation], Mapping[str, int]]:
    """What a policy of this spec would have seen, by the live node's builder, and its refusals.

    Raises:
        PolicyError: the spec is for another step length.
    """
    builder = ObservationBuilder(spec)
    if run.info is not None:
        builder.start_run(run.info)
    observations = []
    for stamp, demand in run.demand.items():
        samples = (demand, run.battery.get(stamp), run.powertrain.get(stamp))
        for sample in samples:
            observation = None if sample is None else builder.add(sample)
            if observation is not None:
                observations.append(observation)
    return observations, builder.refusals


@dataclass
class _Draft:
    """A run while it is being read."""

    info: RunInfo | None = None
    demand: dict[int, PowerDemand] = field(default_factory=dict)
    battery: dict[int, BatteryReading] = field(default_factory=dict)
    powertrain: dict[int, PowertrainReading] = field(default_factory=dict)
    command: dict[int, BatteryPowerCommand] = field(default_factory=dict)
    latest_ns: dict[type, int] = field(default_factory=dict)
    duplicates: int = 0
    refusals: Counter[str] = field(default_factory=Counter)

    def belongs(self, sample: StampedSample) -> bool:
        """Stamps of one topic never go back within a run, nor leave its announced steps."""
        info, stamp_ns = self.info, sample.stamp_ns
        if stamp_ns <= 0:
            return True  # unset: refused, whatever run it is of
        if stamp_ns < self.latest_ns.get(type(sample), 0):
            return False
        if info is None:
            return True
        return info.t0_ns <= stamp_ns and (
            not info.lockstep or stamp_ns <= info.stamp_ns(info.steps)
        )

    def add(self, sample: StampedSample) -> None:
        if 0 < sample.stamp_ns < self.latest_ns.get(type(sample), 0):
            self.refusals["stamp_backwards"] += 1
            return
        if sample.stamp_ns > 0:
            self.latest_ns[type(sample)] = sample.stamp_ns
        if isinstance(sample, BatteryPowerCommand) and sample.mode is not CommandMode.NOMINAL:
            return  # fallback and shutdown commands answer no tick
        reason = refusal(sample, self.info)
        if reason is not None:
            self.refusals[reason] += 1
            return
        if sample.stamp_ns in self._stamps(sample):
            self.duplicates += 1
            return
        match sample:
            case PowerDemand():
                self.demand[sample.stamp_ns] = sample
            case BatteryReading():
                self.battery[sample.stamp_ns] = sample
            case PowertrainReading():
                self.powertrain[sample.stamp_ns] = sample
            case BatteryPowerCommand():
                self.command[sample.stamp_ns] = sample

    def _stamps(self, sample: StampedSample) -> Mapping[int, StampedSample]:
        match sample:
            case PowerDemand():
                return self.demand
            case BatteryReading():
                return self.battery
            case PowertrainReading():
                return self.powertrain
            case BatteryPowerCommand():
                return self.command

    def finish(self, namespace: str, policies: Mapping[str, str]) -> Run:
        key = "" if self.info is None else self.info.run_id
        return Run(
            info=self.info,
            namespace=namespace,
            policy=policies.get(f"policy:{key}", ""),
            demand=self.demand,
            battery=self.battery,
            powertrain=self.powertrain,
            command=self.command,
            duplicates=self.duplicates,
            refusals=dict(self.refusals),
        )


@dataclass
class RunCollector:
    """Splits one namespace's samples into runs.

    ``run_info`` and the samples travel on different topics, so the first samples of a run may
    be received before it: samples that cannot belong to the present run wait for the next one.
    """

    namespace: str
    drafts: list[_Draft] = field(default_factory=list)
    waiting: list[StampedSample] = field(default_factory=list)

    def add(self, sample: Sample) -> None:
        """The next sample in the order of reception.

        Raises BagError where a run id comes back after another run.
        """
        if isinstance(sample, RunInfo):
            self._start(sample)
        elif self.drafts and self.drafts[-1].belongs(sample):
            self.drafts[-1].add(sample)
        else:
            self.waiting.append(sample)

    def _start(self, info: RunInfo) -> None:
        if self.drafts and self.drafts[-1].info == info:
            return
        if any(d.info is not None and d.info.run_id == info.run_id for d in self.drafts):
            raise BagError(f"run {info.run_id} is announced twice: two plants in one namespace?")
        draft = _Draft(info)
        self.drafts.append(draft)
        waiting, self.waiting = self.waiting, []
        for sample in waiting:
            if draft.belongs(sample):
                draft.add(sample)
            else:
                draft.refusals["stamp_outside_run"] += 1

    def runs(self, policies: Mapping[str, str]) -> Iterator[Run]:
        """The runs in the order of their start; ``policies`` is the bag's provenance."""
        if not self.drafts:
            self.drafts.append(_Draft())
        for sample in self.waiting:  # of no announced run
            if self.drafts[-1].info is None:
                self.drafts[-1].add(sample)
            else:
                self.drafts[-1].refusals["stamp_outside_run"] += 1
        self.waiting = []
        for draft in self.drafts:
            yield draft.finish(self.namespace, policies)
