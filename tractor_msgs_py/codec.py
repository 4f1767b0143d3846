"""Samples to messages and back: the one place that knows message layouts.

Decoding reads attributes only, so the same code serves rclpy's classes and those of the
``rosbags`` reader. Encoding goes through a :class:`MessageFactory`
(``tractor_msgs_py.ros.messages`` for rclpy). Changing a carrier type is a change of this file.
"""

import dataclasses
import json
import math
from collections.abc import Sequence
from typing import Any, Protocol, TypeVar

import numpy as np

from tractor_msgs_py import topics
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.types import (
    MAX_STEPS,
    BatteryPowerCommand,
    BatteryReading,
    CommandMode,
    DutyCycleDemand,
    DutyCycleInfo,
    PlayerSample,
    PowerDemand,
    PowertrainReading,
    Reason,
    RunInfo,
    Sample,
)

DEMAND_NAMES = ("power_demand",)
DUTY_CYCLE_NAMES = ("duty_cycle_demand",)
COMMAND_NAMES = ("battery_power", "engine_power", "mode")
REASON_NAME = "reason"
"""Fourth entry of a command that is not the policy's own wish; others do without it."""

POWERTRAIN_NAMES = (
    "engine_on",
    "time_in_state_s",
    "engine_power",
    "charge_limit",
    "discharge_limit",
    "engine_limit",
    "applied_battery_power",
    "applied_engine_power",
    "fuel_kg",
    "shortfall_j",
    "dissipated_j",
)
_POWERTRAIN_FIELDS = tuple(field.name for field in dataclasses.fields(PowertrainReading))[1:]


MIN_DT_S, MAX_DT_S = 1e-3, 3600.0
"""Step lengths that can be announced [s]."""

_STAMP_END_NS = 2**63
_Info = TypeVar("_Info", RunInfo, DutyCycleInfo)


class MessageFactory(Protocol):
    """Builds messages of the three carrier types; one implementation per serialisation stack."""

    def joint_state(self, stamp_ns: int, names: Sequence[str], efforts: Sequence[float]) -> Any:
        """A JointState with header stamp, names and efforts."""

    def battery_state(
        self, stamp_ns: int, *, percentage: float, voltage: float, current: float
    ) -> Any:
        """A BatteryState whose unknown numeric fields are NaN."""

    def string(self, data: str) -> Any:
        """A std_msgs String."""


def wire_soc(soc: Any) -> Any:
    """SOC as a reader of ``battery_state`` sees it: rounded to float32, back as float64.

    In-process runs pass observations through this so that they equal ROS runs bit for bit.
    """
    return np.asarray(soc, dtype=np.float32).astype(np.float64)


def stamp_to_ns(stamp: Any) -> int:
    """builtin_interfaces/Time to integer nanoseconds."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _efforts(msg: Any, names: Sequence[str], topic: str) -> list[float]:
    got = [str(name) for name in msg.name]
    efforts = [float(value) for value in msg.effort]
    if got != list(names) or len(efforts) != len(names):
        raise BagError(
            f"{topic}: JointState names {got} with {len(efforts)} efforts, "
            f"expected {list(names)} with {len(names)}"
        )
    return efforts


def encode_power_demand(sample: PowerDemand, factory: MessageFactory) -> Any:
    """PowerDemand to a message."""
    return factory.joint_state(sample.stamp_ns, DEMAND_NAMES, (sample.power_w,))


def decode_power_demand(msg: Any) -> PowerDemand:
    """Message to PowerDemand. Raises BagError on another layout."""
    (power_w,) = _efforts(msg, DEMAND_NAMES, topics.POWER_DEMAND.name)
    return PowerDemand(stamp_to_ns(msg.header.stamp), power_w)


def encode_battery(sample: BatteryReading, factory: MessageFactory) -> Any:
    """BatteryReading to a message; SOC, voltage and current become float32."""
    return factory.battery_state(
        sample.stamp_ns,
        percentage=float(wire_soc(sample.soc)),
        voltage=sample.voltage_v,
        current=sample.current_a,
    )


def decode_battery(msg: Any) -> BatteryReading:
    """Message to BatteryReading."""
    return BatteryReading(
        stamp_to_ns(msg.header.stamp),
        float(np.float32(msg.percentage)),
        float(msg.voltage),
        float(msg.current),
    )


def encode_powertrain(sample: PowertrainReading, factory: MessageFactory) -> Any:
    """PowertrainReading to a message."""
    efforts = [float(getattr(sample, name)) for name in _POWERTRAIN_FIELDS]
    return factory.joint_state(sample.stamp_ns, POWERTRAIN_NAMES, efforts)


def decode_powertrain(msg: Any) -> PowertrainReading:
    """Message to PowertrainReading. Raises BagError on another layout."""
    engine_on, *rest = _efforts(msg, POWERTRAIN_NAMES, topics.POWERTRAIN.name)
    return PowertrainReading(stamp_to_ns(msg.header.stamp), engine_on != 0.0, *rest)


def encode_command(sample: BatteryPowerCommand, factory: MessageFactory) -> Any:
    """BatteryPowerCommand to a message."""
    names: tuple[str, ...] = COMMAND_NAMES
    efforts: tuple[float, ...] = (
        sample.battery_power_w,
        sample.engine_power_w,
        float(sample.mode),
    )
    if sample.reason is not Reason.NONE:
        names, efforts = (*names, REASON_NAME), (*efforts, float(sample.reason))
    return factory.joint_state(sample.stamp_ns, names, efforts)


def decode_command(msg: Any) -> BatteryPowerCommand:
    """Message to BatteryPowerCommand. Powers may be non-finite: refusing them is the plant's job.

    Raises BagError on another layout, an unknown mode or an unknown reason.
    """
    where = topics.COMMAND.name
    names: tuple[str, ...] = COMMAND_NAMES
    if len(msg.name) > len(names):
        names = (*names, REASON_NAME)
    battery_power_w, engine_power_w, mode, *rest = _efforts(msg, names, where)
    if mode not in list(CommandMode):
        raise BagError(f"{where}: mode {mode}, expected 0, 1 or 2")
    reason = rest[0] if rest else Reason.NONE
    if reason not in list(Reason):
        raise BagError(f"{where}: reason {reason}, expected 0 to {max(Reason)}")
    return BatteryPowerCommand(
        stamp_to_ns(msg.header.stamp),
        battery_power_w,
        engine_power_w,
        CommandMode(int(mode)),
        Reason(int(reason)),
    )


def encode_duty_cycle_demand(sample: DutyCycleDemand, factory: MessageFactory) -> Any:
    """DutyCycleDemand to a message."""
    return factory.joint_state(sample.stamp_ns, DUTY_CYCLE_NAMES, (sample.power_w,))


def decode_duty_cycle_demand(msg: Any) -> DutyCycleDemand:
    """Message to DutyCycleDemand. Raises BagError on another layout."""
    (power_w,) = _efforts(msg, DUTY_CYCLE_NAMES, topics.DUTY_CYCLE_DEMAND.name)
    return DutyCycleDemand(stamp_to_ns(msg.header.stamp), power_w)


def encode_duty_cycle_info(sample: DutyCycleInfo, factory: MessageFactory) -> Any:
    """DutyCycleInfo to a String holding JSON."""
    return factory.string(json.dumps(dataclasses.asdict(sample), sort_keys=True, allow_nan=False))


def decode_duty_cycle_info(msg: Any) -> DutyCycleInfo:
    """String to DutyCycleInfo. Raises BagError as :func:`decode_run_info` does."""
    return _info_of(msg, DutyCycleInfo, topics.DUTY_CYCLE_INFO.name)


def encode_run_info(sample: RunInfo, factory: MessageFactory) -> Any:
    """RunInfo to a String holding JSON."""
    return factory.string(json.dumps(dataclasses.asdict(sample), sort_keys=True, allow_nan=False))


def decode_run_info(msg: Any) -> RunInfo:
    """String to RunInfo. Raises BagError where a field is missing, mistyped or out of range.

    Unknown keys are ignored, so that a newer writer stays readable.
    """
    info = _info_of(msg, RunInfo, topics.RUN_INFO.name)
    for name in ("soc_initial", "soc_target"):
        if not 0.0 <= getattr(info, name) <= 1.0:
            raise BagError(f"{topics.RUN_INFO.name}: {name} {getattr(info, name)}, allowed 0..1")
    return info


def _info_of(msg: Any, cls: type[_Info], where: str) -> _Info:
    """What a latched announcement says about its steps and their stamps, checked."""
    try:
        data = json.loads(msg.data, parse_constant=_refuse_constant)
    except (ValueError, RecursionError, OverflowError) as error:
        raise BagError(f"{where}: not JSON ({error})") from None
    if not isinstance(data, dict):
        raise BagError(f"{where}: JSON {type(data).__name__}, expected an object")
    values: dict[str, Any] = {}
    for field in dataclasses.fields(cls):
        if field.name not in data:
            if field.default is dataclasses.MISSING:
                raise BagError(f"{where}: field {field.name} is missing")
            continue
        value: Any = data[field.name]
        kind: Any = field.type
        wrong = not isinstance(value, int | float) if kind is float else type(value) is not kind
        if wrong or (kind is float and isinstance(value, bool)):
            raise BagError(f"{where}: field {field.name} is {value!r}, expected {kind}")
        values[field.name] = _finite(where, field.name, value) if kind is float else value
    info = cls(**values)
    if not MIN_DT_S <= info.dt_s <= MAX_DT_S:
        raise BagError(f"{where}: dt_s {info.dt_s}, allowed {MIN_DT_S}..{MAX_DT_S}")
    if not 1 <= info.steps <= MAX_STEPS:
        raise BagError(f"{where}: steps {_brief(info.steps)}, allowed 1..{MAX_STEPS}")
    if info.t0_ns < 1 or info.stamp_ns(info.steps) >= _STAMP_END_NS:
        raise BagError(
            f"{where}: t0_ns {_brief(info.t0_ns)}, allowed from 1 to where the last stamp is "
            f"below {_STAMP_END_NS}"
        )
    return info


def _refuse_constant(text: str) -> float:
    raise ValueError(f"{text} is no JSON number")


def _finite(where: str, name: str, value: int | float) -> float:
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise BagError(f"{where}: {name} {_brief(value)}, must be finite")
    return number


def _brief(value: int | float) -> str:
    """A number in a few characters: integers may have thousands of digits."""
    return str(value) if abs(value) < 1 << 64 else "beyond 64 bits"


DECODERS = {
    topics.POWER_DEMAND.name: decode_power_demand,
    topics.BATTERY.name: decode_battery,
    topics.POWERTRAIN.name: decode_powertrain,
    topics.COMMAND.name: decode_command,
    topics.RUN_INFO.name: decode_run_info,
    topics.DUTY_CYCLE_DEMAND.name: decode_duty_cycle_demand,
    topics.DUTY_CYCLE_INFO.name: decode_duty_cycle_info,
}
"""Relative topic name to decoder."""


def encode(sample: Sample | PlayerSample, factory: MessageFactory) -> tuple[topics.Topic, Any]:
    """Any sample to its topic and message."""
    match sample:
        case PowerDemand():
            return topics.POWER_DEMAND, encode_power_demand(sample, factory)
        case BatteryReading():
            return topics.BATTERY, encode_battery(sample, factory)
        case PowertrainReading():
            return topics.POWERTRAIN, encode_powertrain(sample, factory)
        case BatteryPowerCommand():
            return topics.COMMAND, encode_command(sample, factory)
        case RunInfo():
            return topics.RUN_INFO, encode_run_info(sample, factory)
        case DutyCycleDemand():
            return topics.DUTY_CYCLE_DEMAND, encode_duty_cycle_demand(sample, factory)
        case DutyCycleInfo():
            return topics.DUTY_CYCLE_INFO, encode_duty_cycle_info(sample, factory)
