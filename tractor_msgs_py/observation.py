"""From samples to what a policy sees: joining, demand filters, refusals.

One :class:`ObservationBuilder` serves the live node, the bag reader and the in-process run.
``exact`` joins samples of equal stamp; "latest values" of two topics were wrong in 1.6-100 % of
ticks. ``sampled`` reads a vehicle's signals at every tick of a clock. Filters live only here.
"""

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from tractor_msgs_py.codec import wire_soc
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.refusal import refusal
from tractor_msgs_py.sampling import (
    LAG_S,
    EngineMemory,
    Frame,
    Sampler,
    Sampling,
    engine_power_w,
)
from tractor_msgs_py.signals import ENGINE_ON_W, OBSERVED, VITAL, SignalMap, Source
from tractor_msgs_py.trajectory import BoolArray, FloatArray
from tractor_msgs_py.types import (
    BatteryReading,
    PowerDemand,
    PowertrainReading,
    RunInfo,
)

MAX_PENDING = 64
"""Stamps that may wait for the rest of their samples."""

SIGNALS = ("power_demand_w", "soc", "powertrain_state")
"""Signals the ``exact`` mode can supply."""

SAMPLED_SIGNALS = ("power_demand_w", "soc", "engine_power_w")
"""Signals without which a ``sampled`` policy does not see enough; engine power follows from the
bus balance where battery power is there instead."""


@dataclass(frozen=True, slots=True)
class DemandFilter:
    """A causal filter of power demand.

    ``low_pass`` starts at the first sample and follows with ``time_constant_s``.
    ``running_mean`` is the mean of the run so far, with ``prior_w`` counted as if it had been
    seen for ``time_constant_s`` before.
    """

    kind: Literal["low_pass", "running_mean"]
    time_constant_s: float
    prior_w: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in ("low_pass", "running_mean"):
            raise PolicyError(f"filter kind {self.kind!r}, allowed low_pass, running_mean")
        if not (math.isfinite(self.time_constant_s) and self.time_constant_s > 0):
            raise PolicyError(f"filter time_constant_s {self.time_constant_s}, allowed > 0")
        if not math.isfinite(self.prior_w):
            raise PolicyError(f"filter prior_w {self.prior_w}, must be finite")


@dataclass(frozen=True, slots=True)
class ObservationSpec:
    """What a policy needs to see; stored in the policy file.

    Attributes:
        signals: names out of :data:`SIGNALS`, or, ``sampled``, of ``signals.OBSERVED``.
        dt_s: the step length the policy was made for [s]; None when any will do (``exact``).
        filters: demand filters, in the order of ``Observation.features``.
        mode: how samples are joined.
        sampling: ``sampled``: how signals are read at a tick; others in their own way.
        lag_s: ``sampled``: how long a tick waits for samples on their way [s].
    """

    signals: tuple[str, ...] = SIGNALS
    dt_s: float | None = None
    filters: tuple[DemandFilter, ...] = ()
    mode: Literal["exact", "sampled"] = "exact"
    sampling: tuple[Sampling, ...] = ()
    lag_s: float = LAG_S

    def __post_init__(self) -> None:
        if self.mode not in ("exact", "sampled"):
            raise PolicyError(f"observation mode {self.mode!r}, allowed: exact, sampled")
        supplied = SIGNALS if self.mode == "exact" else OBSERVED
        for signal in self.signals:
            if signal not in supplied:
                raise PolicyError(f"observation needs signal {signal!r}, supplied: {supplied}")
        if self.mode == "exact":
            if self.sampling:
                raise PolicyError("observation sampling: only in mode sampled")
            return
        if self.dt_s is None or not 1e-3 <= self.dt_s <= 3600.0:
            raise PolicyError(f"observation dt_s {self.dt_s}, sampled needs 0.001..3600")
        if not 0.0 <= self.lag_s <= self.dt_s:
            raise PolicyError(f"observation lag_s {self.lag_s}, allowed 0..dt_s {self.dt_s}")

    def to_json(self) -> dict[str, Any]:
        """Plain data for a policy file."""
        data: dict[str, Any] = {
            "mode": self.mode,
            "signals": list(self.signals),
            "dt_s": self.dt_s,
            "filters": [
                {"kind": f.kind, "time_constant_s": f.time_constant_s, "prior_w": f.prior_w}
                for f in self.filters
            ],
        }
        if self.mode == "sampled":
            data["sampling"] = [
                {"signal": way.signal, "how": way.how, "max_age_s": way.max_age_s}
                for way in self.sampling
            ]
            data["lag_s"] = self.lag_s
        return data

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> "ObservationSpec":
        """Inverse of :meth:`to_json`. Raises PolicyError on anything else."""
        try:
            return cls(
                signals=tuple(data["signals"]),
                dt_s=None if data["dt_s"] is None else float(data["dt_s"]),
                filters=tuple(DemandFilter(**item) for item in data["filters"]),
                mode=data["mode"],
                sampling=tuple(Sampling(**item) for item in data.get("sampling", ())),
                lag_s=float(data.get("lag_s", LAG_S)),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise PolicyError(f"observation spec: {error!r}") from None


@dataclass(frozen=True)
class Observation:
    """What a batch of B policies sees at one tick; every array has shape (B,) unless said.

    Attributes:
        stamp_ns: t_k, equal for the batch.
        power_demand_w: demand at the bus [W].
        soc: SOC with float32 resolution, 0..1.
        soc_target: the SOC this run should end at, 0..1.
        engine_on, time_in_state_s, engine_power_w: engine state before the decision.
        charge_limit_w, discharge_limit_w, engine_limit_w: present limits, magnitudes >= 0 [W];
            sampled: infinite where no signal says, for ``safety.within_powertrain`` to bound.
        features: filtered demand, shape (B, F) [W].
        time_left_s: to the planned end of the work, (B,) or (1,) [s]; infinite where none is.
    """

    stamp_ns: int
    power_demand_w: FloatArray
    soc: FloatArray
    soc_target: FloatArray
    engine_on: BoolArray
    time_in_state_s: FloatArray
    engine_power_w: FloatArray
    charge_limit_w: FloatArray
    discharge_limit_w: FloatArray
    engine_limit_w: FloatArray
    features: FloatArray
    time_left_s: FloatArray = field(default_factory=lambda: np.full(1, np.inf))


@dataclass(frozen=True)
class FilterState:
    """Values of the demand filters, shape (B, F), after ``ticks`` samples."""

    values_w: FloatArray
    ticks: int = 0


def init_filters(spec: ObservationSpec, batch: int) -> FilterState:
    """Filters that have seen nothing."""
    return FilterState(np.zeros((batch, len(spec.filters))))


def update_filters(
    spec: ObservationSpec, state: FilterState, power_demand_w: FloatArray, dt_s: float
) -> FilterState:
    """One sample of demand, shape (B,), through every filter."""
    values = np.empty_like(state.values_w)
    for column, item in enumerate(spec.filters):
        old = state.values_w[:, column]
        if item.kind == "running_mean":
            seen_s = item.time_constant_s + state.ticks * dt_s
            old = old if state.ticks else np.full_like(old, item.prior_w)
            values[:, column] = old + (power_demand_w - old) * dt_s / (seen_s + dt_s)
        else:
            old = old if state.ticks else power_demand_w
            gain = 1.0 - math.exp(-dt_s / item.time_constant_s)
            values[:, column] = old + gain * (power_demand_w - old)
    return FilterState(values, state.ticks + 1)


def filter_trace(spec: ObservationSpec, power_demand_w: FloatArray, dt_s: float) -> FloatArray:
    """Features of a whole demand trace: (T,) to (T, F), equal to what a live run computes."""
    state = init_filters(spec, 1)
    features = np.empty((len(power_demand_w), len(spec.filters)))
    for k, power_w in enumerate(power_demand_w):
        state = update_filters(spec, state, np.array([power_w]), dt_s)
        features[k] = state.values_w[0]
    return features


@dataclass(frozen=True)
class SampledTick:
    """One tick of a sampled run: what was known, and the observation if that was enough."""

    frame: Frame
    observation: Observation | None


def sampler_of(spec: ObservationSpec, signals: SignalMap | None) -> Sampler:
    """The sampler for a sampled spec.

    Raises:
        PolicyError: a signal the spec needs is not in the map.
    """
    names = () if signals is None else signals.names
    for name in spec.signals:
        balance = name == "engine_power_w" and "battery_power_w" in names
        if name not in names and not balance:
            raise PolicyError(
                f"observation needs signal {name}, the signal map has {', '.join(names) or 'none'}"
            )
    assert signals is not None and spec.dt_s is not None
    return Sampler(signals.signals, spec.sampling, round(spec.dt_s * 1e9), round(spec.lag_s * 1e9))


@dataclass
class ObservationBuilder:
    """Makes one run's samples into observations of batch one.

    Call :meth:`start_run` for every run_info, then, ``exact``, :meth:`add` for every sample, or,
    ``sampled``, :meth:`sense` for every value of a source and :meth:`poll` as time passes. A
    sample that must not be used is refused and counted in ``refusals`` by reason; it never
    raises.

    Args:
        spec: what the policy needs.
        signals: where the signals come from; ``sampled`` only.

    Raises PolicyError where the map supplies less than the spec needs.
    """

    spec: ObservationSpec
    signals: SignalMap | None = None
    run: RunInfo | None = None
    refusals: Counter[str] = field(default_factory=Counter)
    last_stamp_ns: int = 0
    _filters: FilterState = field(default_factory=lambda: FilterState(np.zeros((1, 0))))
    _pending: dict[int, dict[type, Any]] = field(default_factory=dict)
    _sampler: Sampler | None = None
    _engine: EngineMemory = field(default_factory=EngineMemory)

    def __post_init__(self) -> None:
        if self.spec.mode == "sampled":
            self._sampler = sampler_of(self.spec, self.signals)
            self._sampler.refusals = self.refusals

    def start_run(self, run: RunInfo, time_scale: float = 1.0) -> None:
        """Forget the previous run. Repeating the present run id changes nothing.

        Args:
            run: what was announced, or made up for a vehicle that announces nothing.
            time_scale: ``sampled``: seconds of stamps per second of the local clock.

        Raises PolicyError where the run's step length is not the one the spec was made for; a
        sampled policy has a clock of its own.
        """
        if self.run is not None and self.run.run_id == run.run_id:
            return
        spec = self.spec
        if spec.mode == "exact" and spec.dt_s is not None and abs(spec.dt_s - run.dt_s) > 1e-9:
            raise PolicyError(f"observation dt_s {run.dt_s}, the policy needs {spec.dt_s}")
        self.run = run
        self._forget()
        if self._sampler is not None:
            self._sampler.start(run.t0_ns, time_scale)

    def _forget(self) -> None:
        self.last_stamp_ns = 0
        self._filters = init_filters(self.spec, 1)
        self._pending = {}
        self._engine = EngineMemory()

    @property
    def complaints(self) -> dict[str, str]:
        """``sampled``: signal to the last text about an implausible value."""
        return {} if self._sampler is None else self._sampler.complaints

    def sense(
        self, source: Source, stamp_ns: int, value: float, received_ns: int
    ) -> list[SampledTick]:
        """``sampled``: a source said something; the ticks that have come by it."""
        if self._sampler is None or self.run is None:
            self.refusals["no_run_info"] += 1
            return []
        if source.per_step:
            value /= self.run.dt_s
        ticks = self.poll(received_ns)
        jumps = self._sampler.clock.jumps
        self._sampler.add(source, stamp_ns, value, received_ns)
        if self._sampler.clock.jumps != jumps:
            self._forget()
        return ticks + self.poll(received_ns)

    def poll(self, received_ns: int) -> list[SampledTick]:
        """``sampled``: the ticks that have come by the passing of time, oldest first."""
        frames = [] if self._sampler is None else self._sampler.due(received_ns)
        return [self._tick(frame) for frame in frames]

    def wait_ns(self, received_ns: int) -> int | None:
        """``sampled``: how long until :meth:`poll` has the next tick, unless samples bring it
        earlier; None before the first sample [ns]."""
        return None if self._sampler is None else self._sampler.wait_ns(received_ns)

    def _tick(self, frame: Frame) -> SampledTick:
        run, values = self.run, frame.values
        assert run is not None and self.spec.dt_s is not None
        blind = [n for n in OBSERVED if n in frame.missing or (n in VITAL and n not in values)]
        engine_w = engine_power_w(values)
        if blind or engine_w is None:
            for name in blind or ["engine_power_w"]:
                self.refusals[f"{frame.missing.get(name, 'absent')}_{name}"] += 1
            return SampledTick(frame, None)
        on = bool(values.get("engine_on", float(engine_w > ENGINE_ON_W)) >= 0.5)
        self._engine = self._engine.after(on, frame.stamp_ns)
        demand_w = np.array([values["power_demand_w"]])
        self._filters = update_filters(self.spec, self._filters, demand_w, self.spec.dt_s)
        self.last_stamp_ns = frame.stamp_ns

        def value(name: str, default: float) -> FloatArray:
            return np.array([values.get(name, default)])

        return SampledTick(
            frame,
            Observation(
                stamp_ns=frame.stamp_ns,
                power_demand_w=demand_w,
                soc=np.atleast_1d(wire_soc(values["soc"])),
                soc_target=np.array([run.soc_target]),
                engine_on=np.array([on]),
                time_in_state_s=value("time_in_state_s", self._engine.time_in_state_s),
                engine_power_w=np.array([engine_w]),
                charge_limit_w=value("charge_limit_w", math.inf),
                discharge_limit_w=value("discharge_limit_w", math.inf),
                engine_limit_w=value("engine_limit_w", math.inf),
                features=self._filters.values_w.copy(),
                time_left_s=np.array([run.time_left_s(frame.stamp_ns)]),
            ),
        )

    def add(self, sample: PowerDemand | BatteryReading | PowertrainReading) -> Observation | None:
        """The observation that ``sample`` completes, or None.

        Stamps not newer than the last observation (resends), before a run, and whatever
        :func:`refusal` names are refused. Of the stamps that wait for the rest of their samples
        the newest are kept; the others are counted as ``unjoined``.
        """
        run = self.run
        reason = refusal(sample, run)
        if reason is None and sample.stamp_ns <= self.last_stamp_ns:
            reason = "repeated_or_old_stamp"
        if reason is not None or run is None:
            self.refusals[reason or "no_run_info"] += 1
            return None
        joined = self._pending.setdefault(sample.stamp_ns, {})
        joined[type(sample)] = sample
        if len(joined) < 3:
            if len(self._pending) > MAX_PENDING:
                del self._pending[min(self._pending)]
                self.refusals["unjoined"] += 1
            return None
        demand: PowerDemand = joined[PowerDemand]
        battery: BatteryReading = joined[BatteryReading]
        state: PowertrainReading = joined[PowertrainReading]
        if self.last_stamp_ns and sample.stamp_ns != self.last_stamp_ns + run.dt_ns:
            self.refusals["gap"] += 1  # counted, not refused: the newest state is still right
        self.last_stamp_ns = sample.stamp_ns
        self._pending = {s: v for s, v in self._pending.items() if s > sample.stamp_ns}
        self._filters = update_filters(
            self.spec, self._filters, np.array([demand.power_w]), run.dt_s
        )
        return Observation(
            stamp_ns=sample.stamp_ns,
            power_demand_w=np.array([demand.power_w]),
            soc=np.atleast_1d(wire_soc(battery.soc)),
            soc_target=np.array([run.soc_target]),
            engine_on=np.array([state.engine_on]),
            time_in_state_s=np.array([state.time_in_state_s]),
            engine_power_w=np.array([state.engine_power_w]),
            charge_limit_w=np.array([state.charge_limit_w]),
            discharge_limit_w=np.array([state.discharge_limit_w]),
            engine_limit_w=np.array([state.engine_limit_w]),
            features=self._filters.values_w.copy(),
            time_left_s=np.array([run.time_left_s(sample.stamp_ns)]),
        )
