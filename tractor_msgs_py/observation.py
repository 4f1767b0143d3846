"""From samples to what a policy sees: joining by stamp, demand filters, refusals.

One :class:`ObservationBuilder` serves the live node, the bag reader and the in-process run.
``exact`` joins samples of equal stamp; pairing "latest values" of two topics was measured wrong
in 1.6-100 % of ticks. Filters live only here and reset with every run id.
"""

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from tractor_msgs_py.codec import wire_soc
from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.trajectory import BoolArray, FloatArray
from tractor_msgs_py.types import (
    BatteryPowerCommand,
    BatteryReading,
    PowerDemand,
    PowertrainReading,
    RunInfo,
)

MAX_PENDING = 64
"""Stamps that may wait for the rest of their samples."""

MAX_POWER_W = 1e9
"""A demand beyond this is no tractor's [W]."""

SIGNALS = ("power_demand_w", "soc", "powertrain_state")
"""Signals the ``exact`` mode can supply."""


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
        signals: names out of :data:`SIGNALS`.
        dt_s: the step length the policy was made for [s]; None when any will do.
        filters: demand filters, in the order of ``Observation.features``.
        mode: how samples are joined.
    """

    signals: tuple[str, ...] = SIGNALS
    dt_s: float | None = None
    filters: tuple[DemandFilter, ...] = ()
    mode: Literal["exact"] = "exact"

    def __post_init__(self) -> None:
        if self.mode != "exact":
            raise PolicyError(f"observation mode {self.mode!r}, allowed: exact")
        for signal in self.signals:
            if signal not in SIGNALS:
                raise PolicyError(f"observation needs signal {signal!r}, supplied: {SIGNALS}")

    def to_json(self) -> dict[str, Any]:
        """Plain data for a policy file."""
        return {
            "mode": self.mode,
            "signals": list(self.signals),
            "dt_s": self.dt_s,
            "filters": [
                {"kind": f.kind, "time_constant_s": f.time_constant_s, "prior_w": f.prior_w}
                for f in self.filters
            ],
        }

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> "ObservationSpec":
        """Inverse of :meth:`to_json`. Raises PolicyError on anything else."""
        try:
            return cls(
                signals=tuple(data["signals"]),
                dt_s=None if data["dt_s"] is None else float(data["dt_s"]),
                filters=tuple(DemandFilter(**item) for item in data["filters"]),
                mode=data["mode"],
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
        charge_limit_w, discharge_limit_w, engine_limit_w: present limits, magnitudes >= 0 [W].
        features: filtered demand, shape (B, F) [W].
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


@dataclass
class ObservationBuilder:
    """Joins one run's samples by equal stamp into observations of batch one.

    Call :meth:`start_run` for every run_info, :meth:`add` for every sample. A sample that must
    not be used is refused and counted in ``refusals`` by reason; it never raises.
    """

    spec: ObservationSpec
    run: RunInfo | None = None
    refusals: Counter[str] = field(default_factory=Counter)
    last_stamp_ns: int = 0
    _filters: FilterState = field(default_factory=lambda: FilterState(np.zeros((1, 0))))
    _pending: dict[int, dict[type, Any]] = field(default_factory=dict)

    def start_run(self, run: RunInfo) -> None:
        """Forget the previous run. Repeating the present run id changes nothing.

        Raises PolicyError where the run's step length is not the one the spec was made for.
        """
        if self.run is not None and self.run.run_id == run.run_id:
            return
        if self.spec.dt_s is not None and abs(self.spec.dt_s - run.dt_s) > 1e-9:
            raise PolicyError(f"observation dt_s {run.dt_s}, the policy needs {self.spec.dt_s}")
        self.run = run
        self.last_stamp_ns = 0
        self._filters = init_filters(self.spec, 1)
        self._pending = {}

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
        )


def refusal(
    sample: PowerDemand | BatteryReading | PowertrainReading | BatteryPowerCommand,
    run: RunInfo | None,
) -> str | None:
    """Why a sample must not be used, or None: one rule for the live node and the bag reader.

    ``zero_stamp``; with a run ``stamp_outside_run`` and, in lockstep, ``stamp_off_grid``;
    ``soc_out_of_range``, ``not_finite``, ``demand_out_of_range``. The values of a command are
    not judged: the plant projects whatever a policy answered.
    """
    if sample.stamp_ns <= 0:
        return "zero_stamp"
    if run is not None:
        if not run.t0_ns <= sample.stamp_ns <= run.stamp_ns(run.steps):
            return "stamp_outside_run"
        if run.lockstep and (sample.stamp_ns - run.t0_ns) % run.dt_ns:
            return "stamp_off_grid"
    match sample:
        case PowerDemand():
            values: tuple[float, ...] = (sample.power_w,)
        case BatteryReading():
            return None if 0.0 <= sample.soc <= 1.0 else "soc_out_of_range"
        case BatteryPowerCommand():
            return None
        case PowertrainReading():
            values = (
                sample.time_in_state_s,
                sample.engine_power_w,
                sample.charge_limit_w,
                sample.discharge_limit_w,
                sample.engine_limit_w,
                sample.applied_battery_power_w,
                sample.applied_engine_power_w,
                sample.fuel_kg,
                sample.shortfall_j,
                sample.dissipated_j,
            )
    if not all(math.isfinite(value) for value in values):
        return "not_finite"
    if isinstance(sample, PowerDemand) and abs(sample.power_w) > MAX_POWER_W:
        return "demand_out_of_range"
    return None
