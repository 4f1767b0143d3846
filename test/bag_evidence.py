"""Evidence about bags that owes nothing to the code under test: raw records, the message
packages' own hashes, rclpy's deserialiser."""

import importlib
import json
import struct
from pathlib import Path

import rclpy.serialization
from mcap.reader import make_reader

MAGIC = b"\x89MCAP0\r\n"
MESSAGE = 5


def whole_messages(part: bytes) -> list[bytes]:
    """CDR bytes of the complete message records of an unchunked file, without the MCAP library."""
    found, at = [], len(MAGIC)
    while at + 9 <= len(part):
        opcode, length = struct.unpack_from("<BQ", part, at)
        end = at + 9 + length
        if end > len(part):
            break
        if opcode == MESSAGE:
            found.append(part[at + 9 + 22 : end])
        at = end
    return found


def messages_of(bag: Path) -> list[bytes]:
    """CDR bytes of a finalised bag in file order, chunk CRCs validated."""
    with next(bag.glob("*.mcap")).open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        return [m.data for _, _, m in reader.iter_messages(log_time_order=False)]


def decoded_by_rclpy(bag: Path) -> dict[str, list]:
    """Every message by topic, through the ROS installation's own deserialiser."""
    found: dict[str, list] = {}
    with next(bag.glob("*.mcap")).open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            package, folder, short = schema.name.split("/")
            cls = getattr(importlib.import_module(f"{package}.{folder}"), short)
            decoded = rclpy.serialization.deserialize_message(message.data, cls)
            found.setdefault(channel.topic, []).append(decoded)
    return found


def type_hashes_of(bag: Path) -> dict[str, str]:
    """Message type to the RIHS01 hash that its channels state."""
    with next(bag.glob("*.mcap")).open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return {
        summary.schemas[channel.schema_id].name: channel.metadata["topic_type_hash"]
        for channel in summary.channels.values()
    }


def installed_type_hash(name: str) -> str:
    """RIHS01 hash in the installed message package, for instance of ``std_msgs/msg/String``."""
    package, folder, short = name.split("/")
    home = Path(str(importlib.import_module(package).__file__))
    # Beside lib/ in an apt installation and in a venv alike; the wheels set no ament index.
    tails = [prefix / "share" / package / folder / f"{short}.json" for prefix in home.parents]
    path = next(path for path in tails if path.is_file())
    hashes = json.loads(path.read_text())["type_hashes"]
    return next(row["hash_string"] for row in hashes if row["type_name"] == name)
