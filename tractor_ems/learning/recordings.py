"""Which recordings a training run learns from: read, checked, sorted by who drove."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tractor_ems.bags.sampled_traces import iter_sampled_traces
from tractor_ems.bags.transitions import Trace, iter_traces
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.signals import SignalMap
from tractor_msgs_py.trajectory import FloatArray
from tractor_sim.duty_cycle.shipped import held_out_name
from tractor_sim.powertrain import PowertrainParams
from tractor_sim.powertrain_json import powertrain_hash

EXPERT = ("dp", "")
"""Provenance that counts as DP: its name, or none, where the user's word stands."""


@dataclass(frozen=True)
class Recordings:
    """Traces by who drove them, and the map through which they were read, if through one.

    Attributes:
        dp: from ``bags``, driven by DP, by nobody that is known, or demand only.
        rule: from ``rule_bags``, and those of ``bags`` whose provenance names another policy.
    """

    dp: tuple[Trace, ...]
    rule: tuple[Trace, ...]
    signals: SignalMap | None = None

    @property
    def traces(self) -> tuple[Trace, ...]:
        """All of them."""
        return (*self.dp, *self.rule)

    @property
    def bag_hashes(self) -> list[str]:
        """SHA-256 of every bag, sorted."""
        return sorted({trace.bag_hash for trace in self.traces if trace.bag_hash})

    @property
    def identity(self) -> dict[str, Any]:
        """What must be equal for a run to be resumed: who counts as expert is part of it."""
        return {
            "dp_bag_hashes": sorted({trace.bag_hash for trace in self.dp}),
            "rule_bag_hashes": sorted({trace.bag_hash for trace in self.rule}),
            **self.map_json,
        }

    @property
    def map_json(self) -> dict[str, Any]:
        """The signal map as plain data under ``signals``; empty where there is none."""
        if self.signals is None:
            return {}
        data = asdict(self.signals)
        del data["origin"]  # a path of this machine
        return {"signals": data}

    @property
    def cycle_hashes(self) -> list[str]:
        """SHA-256 of every duty cycle that is known, sorted."""
        return sorted({trace.cycle_hash for trace in self.traces if trace.cycle_hash})

    @property
    def cycles(self) -> list[str]:
        """Names of the duty cycles, sorted."""
        return sorted({trace.cycle for trace in self.traces if trace.cycle})


def read_recordings(
    bags: Sequence[Path],
    rule_bags: Sequence[Path],
    params: PowertrainParams,
    *,
    allow_other_powertrain: bool = False,
    allow_held_out: bool = False,
    signals: SignalMap | None = None,
    namespace: str | None = None,
    driven: bool = False,
) -> Recordings:
    """Read and check every bag at or below the given paths.

    With ``signals`` they are a vehicle's bags, sampled every step of the powertrain (see
    ``iter_sampled_traces`` for ``namespace`` and ``driven``), else the project's own. Traces are
    in an order of their own, by bag hash, run and time: the names and the order of the bags
    decide nothing.

    Raises:
        BagError: a bag cannot be read, steps by another time, was recorded on another powertrain
            or on a held-out cycle (unless those are allowed).
    """

    def read(paths: Sequence[Path]) -> list[Trace]:
        if not paths:
            return []
        if signals is None:
            return iter_traces(paths)
        return iter_sampled_traces(paths, signals, params.dt_s, namespace=namespace, driven=driven)

    given, rule = read(bags), read(rule_bags)
    for trace in (*given, *rule):
        check_trace(trace, params, allow_other_powertrain=allow_other_powertrain)
        if not allow_held_out:
            _refuse_held_out(trace)
    return Recordings(
        dp=_in_order(trace for trace in given if trace.policy in EXPERT),
        rule=_in_order((*(trace for trace in given if trace.policy not in EXPERT), *rule)),
        signals=signals,
    )


def _in_order(traces: Iterable[Trace]) -> tuple[Trace, ...]:
    return tuple(sorted(traces, key=lambda t: (t.bag_hash, t.run_id, int(t.stamp_ns[0]))))


def _refuse_held_out(trace: Trace) -> None:
    name = held_out_name_of(trace)
    if name is not None:
        raise BagError(
            f"{trace.bag}: drives {name}, a held-out cycle that training must not see "
            "(unless allow_held_out says so)"
        )


def held_out_name_of(trace: Trace) -> str | None:
    """Name of the held-out cycle that a trace drives, as far as that can be known, or None.

    By what its run announced and by what it holds, also where each second of the cycle was
    recorded several times. Cycles are listed at steps of 1 s: which sample is a second's first is
    not known, nor whether the recording caught the first and the last second. Part of a cycle, or
    one with a sensor's noise, is not known.
    """
    name = held_out_name(trace.power_demand_w, trace.dt_s, trace.cycle_hash, trace.cycle)
    if name is not None:
        return name
    per_second = round(1.0 / trace.dt_s)
    if per_second < 2 or abs(per_second * trace.dt_s - 1.0) > 1e-9:
        return None
    last = len(trace) - 1
    for phase in range(per_second):
        # Of each second its last sample; of one that is cut at an end what is left of it.
        ends = list(range(phase, last + 1, per_second))
        ends += [last] if ends[-1:] != [last] else []
        for skip, drop in ((0, 0), (1, 0), (0, 1), (1, 1)):
            seconds_w = trace.power_demand_w[ends[skip : len(ends) - drop]]
            if len(seconds_w) > 1:
                name = held_out_name(seconds_w, 1.0)
                if name is not None:
                    return name
    return None


def check_trace(trace: Trace, params: PowertrainParams, *, allow_other_powertrain: bool) -> None:
    """Refuse what cannot teach this powertrain.

    Raises:
        BagError: other step length, or other powertrain.
    """
    if abs(trace.dt_s - params.dt_s) > 1e-3 * params.dt_s:
        raise BagError(
            f"{trace.bag}: dt_s {trace.dt_s:g}, powertrain {params.name} steps by {params.dt_s:g}"
        )
    own = powertrain_hash(params)
    if trace.powertrain_hash not in ("", own) and not allow_other_powertrain:
        raise BagError(
            f"{trace.bag}: recorded on powertrain {trace.powertrain or 'unknown'} "
            f"({trace.powertrain_hash[:12]}), training is for {params.name} ({own[:12]})"
        )


def distinct_demands(traces: Sequence[Trace]) -> list[FloatArray]:
    """Demand of every trace, each series once: a cycle driven by two experts is one experience of
    the demand."""
    series = {np.ascontiguousarray(t.power_demand_w).tobytes(): t.power_demand_w for t in traces}
    return list(series.values())
