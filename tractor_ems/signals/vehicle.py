"""What a live node and the reader of its bag must do alike, beside the ObservationBuilder: the
run of a vehicle that announces none, the values in a message, the sampling that a map asks for.
"""

from collections.abc import Iterable, Sequence
from typing import Any

from tractor_msgs_py.codec import stamp_to_ns
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.observation import SAMPLED_SIGNALS, DemandFilter, ObservationSpec
from tractor_msgs_py.sampling import LAG_S, Sampling
from tractor_msgs_py.signals import SIGNALS, SignalMap, Source
from tractor_msgs_py.types import MAX_STEPS, RunInfo


def vehicle_run(dt_s: float, soc_target: float, run_id: str = "vehicle") -> RunInfo:
    """The run of a vehicle that announces none; its ticks are whole multiples of ``dt_s``.

    Args:
        dt_s: the policy's period [s].
        soc_target: fraction.
        run_id: another one starts another run.
    """
    return RunInfo(
        run_id=run_id,
        cycle="",
        cycle_hash="",
        powertrain="",
        powertrain_hash="",
        t0_ns=round(dt_s * 1e9),
        dt_s=dt_s,
        steps=MAX_STEPS,
        p_aux_w=0.0,
        soc_initial=soc_target,
        soc_target=soc_target,
        lockstep=False,
    )


def sampling_of(signals: SignalMap) -> tuple[Sampling, ...]:
    """How each mapped signal is sampled: as the map says, or else its definition."""
    return tuple(
        Sampling(
            signal.name,
            signal.how or SIGNALS[signal.name].how,
            signal.max_age_s or SIGNALS[signal.name].max_age_s,
        )
        for signal in signals.signals
    )


def sampled_spec(
    signals: SignalMap,
    dt_s: float,
    filters: tuple[DemandFilter, ...] = (),
    needed: tuple[str, ...] = SAMPLED_SIGNALS,
) -> ObservationSpec:
    """What a policy that is trained through a map needs to see, every ``dt_s`` seconds."""
    return ObservationSpec(
        signals=needed,
        dt_s=dt_s,
        filters=filters,
        mode="sampled",
        sampling=sampling_of(signals),
        lag_s=min(LAG_S, dt_s),
    )


def values_of(
    sources: Iterable[Source], message: Any, publish_ns: int
) -> Sequence[tuple[Source, int, float]]:
    """Source, stamp [ns] and value of everything that a message says; for
    ``ObservationBuilder.sense``.

    A source whose field is not in this message is left out: JointStates may hold other entries
    each time.

    Args:
        sources: those of the message's topic.
        message: of rclpy or ``rosbags``.
        publish_ns: when it was published, for sources without a stamp of their own [ns].
    """
    found = []
    for source in sources:
        try:
            value = source.value(message)
            stamp_ns = publish_ns
            if source.stamp == "header":
                stamp_ns = stamp_to_ns(message.header.stamp)
        except (BagError, AttributeError):
            continue
        found.append((source, stamp_ns, value))
    return found


def reception_ns(run: RunInfo, stamp_ns: int, heard_ns: int, before_ns: int) -> int:
    """What to give ``ObservationBuilder.sense`` as the time of reception [ns].

    It is when a sample was heard, except in lockstep: there time passes with the stamps, as fast
    as the answers come.

    Args:
        run: the present one.
        stamp_ns, heard_ns: of the sample.
        before_ns: what this function returned for the sample before, 0 at the start of a run.
    """
    return max(stamp_ns, before_ns) if run.lockstep else heard_ns
