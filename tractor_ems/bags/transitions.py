"""Recorded runs as traces and transitions to learn from, policy-free.

Powers are those that were APPLIED, as ``powertrain_state`` reports them, never the commanded
ones. A recording of demand alone yields demand-only traces, enough for counterfactual learning.
"""

from collections.abc import Iterable
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tractor_ems.bags.read import bag_hash, find_bags, read_bag
from tractor_ems.bags.runs import Run
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.observation import ObservationSpec, filter_trace
from tractor_msgs_py.trajectory import BoolArray, FloatArray, IntArray
from tractor_sim.duty_cycle.cycle import DutyCycle

JITTER = 0.01
"""A stamp interval that differs from the step by more than this fraction is irregular."""

GAP = 0.5
"""One that differs by more than this fraction ends a trace: a sample is missing or too many."""


@dataclass(frozen=True)
class Trace:
    """T steps in a row of one run, without a gap.

    A run is one trace unless samples are missing in it. Columns of the demand are always there;
    the others are None in a demand-only trace (see :attr:`demand_only`).

    Attributes:
        stamp_ns: t_k, shape (T,).
        power_demand_w: demand at the bus, auxiliaries included, shape (T,).
        dt_s: step length; without run_info the median stamp interval, to the millisecond.
        p_aux_w: auxiliary power within the demand; 0 where no run_info says so.
        soc: observed SOC at t_0 .. t_T with float32 resolution, shape (T + 1,).
        battery_power_w, engine_power_w: applied over step k, at the bus, shape (T,).
        engine_on: engine state at t_0 .. t_T, shape (T + 1,); [1:] is that during the steps.
        time_in_state_s: how long it had been so at t_0 .. t_T, shape (T + 1,).
        fuel_kg: burnt over step k, start fuel included, shape (T,).
        shortfall_j, dissipated_j: over step k, shape (T,).
        soc_target: SOC the run should end at; None where no run_info says so.
        from_start, to_end: the trace holds the run's first and last step.
        irregular: stamp intervals off by more than 1 % of the step.
        refusals: samples of the whole run that were refused.
        run_id, cycle, cycle_hash, powertrain, powertrain_hash, policy: where it comes from;
            empty where unknown.
        bag, bag_hash: path and SHA-256 of the bag.
    """

    stamp_ns: IntArray
    power_demand_w: FloatArray
    dt_s: float
    p_aux_w: float
    soc: FloatArray | None
    battery_power_w: FloatArray | None
    engine_power_w: FloatArray | None
    engine_on: BoolArray | None
    time_in_state_s: FloatArray | None
    fuel_kg: FloatArray | None
    shortfall_j: FloatArray | None
    dissipated_j: FloatArray | None
    soc_target: float | None
    from_start: bool
    to_end: bool
    irregular: int
    refusals: int
    run_id: str
    cycle: str
    cycle_hash: str
    powertrain: str
    powertrain_hash: str
    policy: str
    bag: str
    bag_hash: str

    def __len__(self) -> int:
        return len(self.stamp_ns)

    @property
    def demand_only(self) -> bool:
        """Nothing but demand is known."""
        return self.soc is None


@dataclass(frozen=True)
class Transitions:
    """N steps as (state, applied action, outcome, next state), every column of shape (N,).

    ``truncated`` marks the last step of a trace whose successor demand is known: the recording
    or the cycle ended there, which is no terminal state.
    """

    power_demand_w: FloatArray
    soc: FloatArray
    engine_on: BoolArray
    battery_power_w: FloatArray
    engine_power_w: FloatArray
    fuel_kg: FloatArray
    shortfall_j: FloatArray
    next_power_demand_w: FloatArray
    next_soc: FloatArray
    next_engine_on: BoolArray
    truncated: BoolArray
    dt_s: FloatArray

    def __len__(self) -> int:
        return len(self.power_demand_w)


def iter_traces(paths: Iterable[Path]) -> list[Trace]:
    """Every trace in the bags at or below ``paths``, in a fixed order.

    Raises:
        BagError: a bag is missing, truncated, foreign or empty, or breaks the wire contract.
    """
    traces: list[Trace] = []
    for bag in find_bags(paths):
        digest = bag_hash(bag)
        for run in read_bag(bag):
            traces += traces_of(run, str(bag), digest)
    return traces


def cycle_of_bag(path: Path) -> DutyCycle:
    """The duty cycle in a bag: the demand of its only run, less the auxiliaries the plant added.

    Raises:
        BagError: the bag cannot be read, holds several runs, or samples are missing in it.
    """
    found = [trace for run in read_bag(path) for trace in demand_traces(run, str(path), "")]
    if len(found) != 1:
        raise BagError(f"{path}: {len(found)} stretches of demand, a cycle needs exactly one")
    trace = found[0]
    return DutyCycle(
        name=trace.cycle or path.stem,
        power_demand_w=trace.power_demand_w - trace.p_aux_w,
        dt_s=trace.dt_s,
        operation="bag",
        source=str(path),
    )


def traces_of(run: Run, bag: str = "", digest: str = "") -> list[Trace]:
    """The traces of one run: one, none, or several where samples are missing."""
    if run.info is None or not any(run.driven):
        return demand_traces(run, bag, digest)
    return _driven_traces(run, bag, digest)


def features_of(trace: Trace, spec: ObservationSpec) -> FloatArray:
    """Demand filters of ``spec`` along a trace, shape (T, F).

    Equal to what a live policy saw when the trace holds the run's first step.
    """
    return filter_trace(spec, trace.power_demand_w, trace.dt_s)


def transitions_of(traces: Iterable[Trace]) -> Transitions:
    """The transitions of every trace that has states; demand-only traces have none.

    The last step of a trace has no successor demand and is left out.
    """
    columns: dict[str, list[NDArray[Any]]] = {field.name: [] for field in fields(Transitions)}
    for trace in traces:
        soc, engine_on = trace.soc, trace.engine_on
        battery_w, engine_w = trace.battery_power_w, trace.engine_power_w
        fuel_kg, shortfall_j = trace.fuel_kg, trace.shortfall_j
        if (
            soc is None
            or engine_on is None
            or battery_w is None
            or engine_w is None
            or fuel_kg is None
            or shortfall_j is None
        ):
            continue
        count = len(trace) - 1
        truncated = np.zeros(count, dtype=bool)
        truncated[-1:] = True
        row = (
            trace.power_demand_w[:-1],
            soc[:-2],
            engine_on[:-2],
            battery_w[:-1],
            engine_w[:-1],
            fuel_kg[:-1],
            shortfall_j[:-1],
            trace.power_demand_w[1:],
            soc[1:-1],
            engine_on[1:-1],
            truncated,
            np.full(count, trace.dt_s),
        )
        for name, values in zip(columns, row, strict=True):
            columns[name].append(values)
    return Transitions(
        **{name: np.concatenate(values or [_NONE[name]]) for name, values in columns.items()}
    )


_FLAGS = ("engine_on", "next_engine_on", "truncated")
_NONE: dict[str, NDArray[Any]] = {
    field.name: np.zeros(0, dtype=bool if field.name in _FLAGS else np.float64)
    for field in fields(Transitions)
}


def _driven_traces(run: Run, bag: str, digest: str) -> list[Trace]:
    info = run.info
    assert info is not None
    stamps, ends = run.stamps_ns, run.ends_ns
    traces = []
    for first, last in _stretches(np.array(run.driven)):
        during = stamps[first:last]
        after_last = ends[last - 1]
        states = [run.powertrain[stamp] for stamp in (*during, after_last)]
        applied = states[1:]
        traces.append(
            Trace(
                stamp_ns=np.array(during, dtype=np.int64),
                power_demand_w=np.array([run.demand[stamp].power_w for stamp in during]),
                dt_s=info.dt_s,
                p_aux_w=info.p_aux_w,
                soc=np.array([run.battery[stamp].soc for stamp in (*during, after_last)]),
                battery_power_w=np.array([s.applied_battery_power_w for s in applied]),
                engine_power_w=np.array([s.applied_engine_power_w for s in applied]),
                engine_on=np.array([s.engine_on for s in states]),
                time_in_state_s=np.array([s.time_in_state_s for s in states]),
                fuel_kg=np.array([s.fuel_kg for s in applied]),
                shortfall_j=np.array([s.shortfall_j for s in applied]),
                dissipated_j=np.array([s.dissipated_j for s in applied]),
                soc_target=info.soc_target,
                from_start=during[0] == info.t0_ns,
                to_end=after_last == info.stamp_ns(info.steps),
                irregular=_irregular(np.diff((*during, after_last)), info.dt_s),
                refusals=sum(run.refusals.values()),
                run_id=info.run_id,
                cycle=info.cycle,
                cycle_hash=info.cycle_hash,
                powertrain=info.powertrain,
                powertrain_hash=info.powertrain_hash,
                policy=run.policy,
                bag=bag,
                bag_hash=digest,
            )
        )
    return traces


def demand_traces(run: Run, bag: str, digest: str) -> list[Trace]:
    """Demand alone: cut where samples are missing, the step from the stamps."""
    info = run.info
    stamp_ns = np.array(list(run.demand), dtype=np.int64)
    power_w = np.array([sample.power_w for sample in run.demand.values()])
    if len(stamp_ns) < 2:
        return []
    intervals_ns = np.diff(stamp_ns)
    dt_s = round(float(np.median(intervals_ns)) / 1e9, 3) if info is None else info.dt_s
    cuts = np.flatnonzero(np.abs(intervals_ns * 1e-9 - dt_s) > GAP * dt_s) + 1
    edges = [0, *cuts.tolist(), len(stamp_ns)]
    return [
        Trace(
            stamp_ns=stamp_ns[first:last],
            power_demand_w=power_w[first:last],
            dt_s=dt_s,
            p_aux_w=0.0 if info is None else info.p_aux_w,
            soc=None,
            battery_power_w=None,
            engine_power_w=None,
            engine_on=None,
            time_in_state_s=None,
            fuel_kg=None,
            shortfall_j=None,
            dissipated_j=None,
            soc_target=None if info is None else info.soc_target,
            from_start=first == 0,
            to_end=last == len(stamp_ns),
            irregular=_irregular(np.diff(stamp_ns[first:last]), dt_s),
            refusals=sum(run.refusals.values()),
            run_id="" if info is None else info.run_id,
            cycle="" if info is None else info.cycle,
            cycle_hash="" if info is None else info.cycle_hash,
            powertrain="" if info is None else info.powertrain,
            powertrain_hash="" if info is None else info.powertrain_hash,
            policy=run.policy,
            bag=bag,
            bag_hash=digest,
        )
        for first, last in pairwise(edges)
        if last - first > 1
    ]


def _irregular(intervals_ns: IntArray, dt_s: float) -> int:
    return int(np.sum(np.abs(intervals_ns * 1e-9 - dt_s) > JITTER * dt_s))


def _stretches(there: BoolArray) -> list[tuple[int, int]]:
    """Half-open ranges of consecutive True."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], there, [False]))))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
