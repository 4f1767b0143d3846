"""Messages without a ROS installation: the carrier types of the ``rosbags`` typestore.

Serves the bag reader and the in-process writer. A live node uses ``tractor_msgs_py.ros.messages``
instead; both go through the same codec.
"""

import math
import struct
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from tractor_msgs_py.errors import BagError


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """Message types of ROS 2 Jazzy."""
    return get_typestore(Stores.ROS2_JAZZY)


@lru_cache(maxsize=32)
def definition(type_name: str) -> str:
    """Definition text of a message type, dependencies included (``ros2msg``)."""
    text, _ = typestore().generate_msgdef(type_name, ros_version=2)
    return text


@lru_cache(maxsize=32)
def type_hash(type_name: str) -> str:
    """RIHS01 hash of a message type, as rmw and rosbag2 write it."""
    return typestore().hash_rihs01(type_name)


def has_header(type_name: str) -> bool | None:
    """Whether messages of a type begin with a std_msgs/Header; None: no type of ROS 2 Jazzy."""
    found = typestore().fielddefs.get(type_name)
    if found is None:
        return None
    fields = found[1]
    return bool(fields) and fields[0][0] == "header" and fields[0][1][1] == "std_msgs/msg/Header"


def serialize(message: Any, type_name: str) -> bytes:
    """Message to CDR bytes; equal messages give equal bytes (rclpy leaves random padding)."""
    return bytes(typestore().serialize_cdr(message, type_name))


def deserialize(data: bytes, type_name: str) -> Any:
    """CDR bytes to a message.

    Raises:
        BagError: the bytes are not a message of this type.
    """
    try:
        return typestore().deserialize_cdr(data, type_name)
    except Exception as error:  # generated code: a malformed message can raise almost anything
        raise BagError(f"{len(data)} bytes are not a {type_name} ({error!r})") from None


def header_stamp_ns(data: bytes) -> int:
    """Stamp of a message that begins with a std_msgs/Header, without decoding the rest.

    Raises:
        BagError: the bytes are too short for one.
    """
    if len(data) < 12:
        raise BagError(f"{len(data)} bytes hold no message with a header")
    sec, nanosec = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return int(sec) * 1_000_000_000 + int(nanosec)


class RosbagsMessages:
    """``codec.MessageFactory`` over the typestore's message classes."""

    def __init__(self) -> None:
        types = typestore().types
        self._time: Any = types["builtin_interfaces/msg/Time"]
        self._header: Any = types["std_msgs/msg/Header"]
        self._joint_state: Any = types["sensor_msgs/msg/JointState"]
        self._battery_state: Any = types["sensor_msgs/msg/BatteryState"]
        self._string: Any = types["std_msgs/msg/String"]

    def _stamped(self, stamp_ns: int) -> Any:
        sec, nanosec = divmod(stamp_ns, 1_000_000_000)
        return self._header(stamp=self._time(sec=sec, nanosec=nanosec), frame_id="")

    def joint_state(self, stamp_ns: int, names: Sequence[str], efforts: Sequence[float]) -> Any:
        """A JointState with header stamp, names and efforts."""
        return self._joint_state(
            header=self._stamped(stamp_ns),
            name=list(names),
            position=np.zeros(0),
            velocity=np.zeros(0),
            effort=np.array(efforts, dtype=np.float64),
        )

    def battery_state(
        self, stamp_ns: int, *, percentage: float, voltage: float, current: float
    ) -> Any:
        """A BatteryState whose unknown numeric fields are NaN."""
        cls = self._battery_state
        return cls(
            header=self._stamped(stamp_ns),
            voltage=voltage,
            temperature=math.nan,
            current=current,
            charge=math.nan,
            capacity=math.nan,
            design_capacity=math.nan,
            percentage=percentage,
            power_supply_status=cls.POWER_SUPPLY_STATUS_UNKNOWN,
            power_supply_health=cls.POWER_SUPPLY_HEALTH_UNKNOWN,
            power_supply_technology=cls.POWER_SUPPLY_TECHNOLOGY_LION,
            present=True,
            cell_voltage=np.zeros(0, dtype=np.float32),
            cell_temperature=np.zeros(0, dtype=np.float32),
            location="",
            serial_number="",
        )

    def string(self, data: str) -> Any:
        """A std_msgs String."""
        return self._string(data=data)
