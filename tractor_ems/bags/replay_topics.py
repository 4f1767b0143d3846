"""The messages of any bag as they were recorded, to be published again. Pure file reading.

Bytes are never decoded. ``replay_schedule`` decides when they are published.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader

from tractor_ems.bags.chunk_limit import refuse_large_chunks
from tractor_ems.bags.plain_yaml import parse_yaml
from tractor_ems.bags.read import storage_file
from tractor_msgs_py.errors import BagError, ConfigError
from tractor_msgs_py.topics import Qos

KEEP_ALL_DEPTH = 1000
"""History of a publisher whose recorded one kept everything."""


@dataclass(frozen=True)
class RecordedTopic:
    """One topic of a bag.

    Attributes:
        name: full name.
        type: ROS message type.
        qos: the strongest of what its publishers offered: it matches every subscription that
            theirs did.
        messages: how many there are.
        interval_s: mean recorded interval [s]; 0 for a single message.
    """

    name: str
    type: str
    qos: Qos
    messages: int
    interval_s: float


@dataclass(frozen=True, slots=True)
class RawMessage:
    """One message: CDR bytes, and when it was received, from the start of the replay on [s]."""

    at_s: float
    topic: str
    data: bytes


@dataclass(frozen=True)
class Choice:
    """Which part of a bag.

    Attributes:
        topics: full names; empty: all.
        exclude: full names that are left out.
        start_s, duration_s: from the first message of the bag on [s]; duration 0: to the end.
    """

    topics: Sequence[str] = ()
    exclude: Sequence[str] = ()
    start_s: float = 0.0
    duration_s: float = 0.0


def recorded_topics(path: Path, choice: Choice) -> list[RecordedTopic]:
    """The chosen topics of a bag, by name.

    Raises:
        BagError: the bag cannot be read or is empty.
        ConfigError: a name that is in no topic of the bag, nothing is left, or the bag ends
            before ``start_s``.
    """
    with _opened(path) as reader:
        held = {connection.topic for connection in reader.connections}
        for parameter, names in (("topics", choice.topics), ("exclude", choice.exclude)):
            for name in names:
                if _full(name) not in held:
                    raise ConfigError(
                        f"parameter {parameter}: {name!r} is not in {path}, "
                        f"which holds {', '.join(sorted(held))}"
                    )
        found: dict[str, list[Connection]] = {}
        for connection in _chosen(reader, choice):
            found.setdefault(connection.topic, []).append(connection)
        if not found:
            raise ConfigError(f"parameter exclude: nothing of {path} is left to publish")
        long_s = reader.duration * 1e-9
        if choice.start_s > long_s:
            raise ConfigError(
                f"parameter start_s: {choice.start_s:g}, allowed 0..{long_s:g} of {path}"
            )
    topics = []
    for name, connections in sorted(found.items()):
        types = sorted({connection.msgtype for connection in connections})
        if len(types) > 1:
            raise BagError(f"{path}: {name} has several types: {', '.join(types)}")
        formats = {
            getattr(connection.ext, "serialization_format", "") for connection in connections
        }
        if formats != {"cdr"}:
            raise BagError(f"{path}: {name} is serialised as {', '.join(formats)}, expected cdr")
        count = sum(connection.msgcount for connection in connections)
        interval_s = long_s / (count - 1) if count > 1 else 0.0
        topics.append(RecordedTopic(name, types[0], _qos_of(connections), count, interval_s))
    return topics


def messages_of(path: Path, choice: Choice, names: Sequence[str]) -> Iterator[RawMessage]:
    """Messages of the topics ``names`` in the order of their reception.

    The last message of each latched topic before ``start_s`` comes first: whoever began to
    listen then would have been given it.

    Raises:
        BagError: the bag breaks off.
    """
    with _opened(path) as reader:
        wanted = [c for c in reader.connections if c.topic in names]
        begin_ns = reader.start_time + round(choice.start_s * 1e9)
        end_ns = begin_ns + round(choice.duration_s * 1e9) if choice.duration_s else None
        latched = [c for c in wanted if _qos_of([c]).durability == "transient_local"]
        if latched and choice.start_s:
            last: dict[str, bytes] = {}
            for connection, _, data in reader.messages(connections=latched, stop=begin_ns):
                last[connection.topic] = bytes(data)
            for topic, data in last.items():
                yield RawMessage(0.0, topic, data)
        for connection, time_ns, data in reader.messages(
            connections=wanted, start=begin_ns, stop=end_ns
        ):
            yield RawMessage((time_ns - begin_ns) * 1e-9, connection.topic, bytes(data))


@contextmanager
def _opened(path: Path) -> Iterator[Reader]:
    """A reader of all of a bag's storage files."""
    files = sorted([*path.glob("*.mcap"), *path.glob("*.db3")]) if path.is_dir() else []
    described = path.is_dir() and (path / "metadata.yaml").is_file()
    try:
        if len(files) > 1 and described:
            whole = path
        else:
            files = [storage_file(path)]
            whole = path if described else files[0]
        for file in files:
            if file.suffix == ".mcap":
                refuse_large_chunks(file)
        if described:
            _refuse_compressed(path)
        with Reader(whole) as reader:
            if not reader.message_count:
                raise BagError(f"{path}: is empty")
            yield reader
    except (BagError, ConfigError):
        raise
    except Exception as error:  # on foreign bytes the reader raises whatever its parsing meets
        raise BagError(f"{path}: not a readable bag ({' '.join(str(error).split())})") from None


def _refuse_compressed(path: Path) -> None:
    """What rosbag2 compressed on top of its storage has no limit to what it expands to."""
    text = (path / "metadata.yaml").read_text(encoding="utf-8")
    content = parse_yaml(text, f"{path}: metadata.yaml cannot be read")
    mode = str(content["rosbag2_bagfile_information"].get("compression_mode") or "").lower()
    if mode not in ("", "none"):
        raise BagError(f"{path}: compression_mode {mode!r}, allowed none (chunks may be)")


def _full(name: str) -> str:
    return f"/{name.lstrip('/')}"


def _chosen(reader: Reader, choice: Choice) -> list[Connection]:
    only, without = set(map(_full, choice.topics)), set(map(_full, choice.exclude))
    return [
        connection
        for connection in reader.connections
        if (not only or connection.topic in only) and connection.topic not in without
    ]


def _qos_of(connections: Sequence[Connection]) -> Qos:
    """Reliable or latched if any publisher was; unknown is the default of ROS."""
    profiles: list[Any] = []
    for connection in connections:
        profiles += getattr(connection.ext, "offered_qos_profiles", None) or []
    if not profiles:
        return Qos()
    reliability = {profile.reliability.name for profile in profiles}
    durability = {profile.durability.name for profile in profiles}
    depths = [
        KEEP_ALL_DEPTH if profile.history.name == "KEEP_ALL" else int(profile.depth)
        for profile in profiles
    ]
    return Qos(
        "best_effort" if reliability == {"BEST_EFFORT"} else "reliable",
        "transient_local" if "TRANSIENT_LOCAL" in durability else "volatile",
        max(depths) or Qos().depth,
    )
