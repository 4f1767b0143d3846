"""A part file becomes a rosbag2 bag: chunks, index, CRCs, metadata.yaml.

Whatever can be read of the part up to its end, or to where a crash cut it, is kept. Every file
is written beside and put in place, and the part goes last, so that a crash in here loses nothing
and the next attempt starts over.
"""

import json
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any

import yaml
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.well_known import Profile
from mcap.writer import CompressionType, Writer

from tractor_ems.bags.read import PART_SUFFIX, PROVENANCE, decode
from tractor_msgs_py import __version__, topics
from tractor_msgs_py.atomic import sync_folder, write_bytes, write_bytes_with
from tractor_msgs_py.errors import BagError, ConfigError
from tractor_msgs_py.types import RunInfo

ROSBAG2_VERSION = 9
MAX_RECORD_BYTES = 1 << 26
"""A record that claims to be longer is damage: the contract's messages are below a kilobyte."""


@dataclass(frozen=True)
class Finalised:
    """What became of a part file.

    Attributes:
        bag: the bag folder.
        messages: messages saved per topic.
        recovered: made by ``recover``, not by the recorder itself.
        cut_bytes: bytes at the end that a crash left unreadable.
    """

    bag: Path
    messages: dict[str, int]
    recovered: bool
    cut_bytes: int


@dataclass
class _Transcript:
    """What a part file held, gathered while it is copied."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    provenance: dict[str, str] = field(default_factory=dict)
    runs: dict[str, RunInfo] = field(default_factory=dict)
    first_ns: int = 0
    last_ns: int = 0
    read_bytes: int = 0

    @property
    def custom_data(self) -> dict[str, str]:
        """Provenance and the announced runs, as rosbag2's text-to-text map."""
        runs = [asdict(info) for info in self.runs.values()]
        return {**self.provenance, "runs": json.dumps(runs, sort_keys=True)}

    def account(self, message: Message) -> None:
        """Count a message, and keep what it announces."""
        first = not self.counts
        self.first_ns = message.log_time if first else min(self.first_ns, message.log_time)
        self.last_ns = max(self.last_ns, message.log_time)
        self.counts[message.channel_id] += 1
        name = self.channels[message.channel_id].topic.rpartition("/")[2]
        if name == topics.RUN_INFO.name:
            try:
                info = decode(name, message.data)
            except BagError:
                return  # kept in the bag, refused by its readers
            if isinstance(info, RunInfo):
                self.runs[info.run_id] = info


def finalise(part: Path, recovered: bool) -> Finalised:
    """Turn ``NAME_0.mcap.part`` into a readable bag in its folder, and drop the part.

    Raises:
        BagError: the part cannot be read or holds no message, or the folder cannot be written.
            The part is still there then.
    """
    target = part.with_name(part.name.removesuffix(PART_SUFFIX))
    seen = _Transcript()
    try:
        size = part.stat().st_size
        with part.open("rb") as source:
            write_bytes_with(target, lambda file: _transcode(source, file, seen, recovered, size))
        document = {"rosbag2_bagfile_information": _metadata(target.name, seen)}
        write_bytes(target.with_name("metadata.yaml"), _yaml(document).encode())
        part.unlink()
        sync_folder(part.parent)
    except OSError as error:
        raise BagError(f"{part}: cannot be finalised ({error.strerror or error})") from None
    except ConfigError as error:
        raise BagError(str(error)) from None
    counts = {channel.topic: seen.counts[key] for key, channel in seen.channels.items()}
    return Finalised(part.parent, counts, recovered, size - seen.read_bytes)


def _transcode(
    source: IO[bytes], file: IO[bytes], seen: _Transcript, recovered: bool, size: int
) -> None:
    """Copy what can be read into chunks with CRCs; ids are kept in the order of registration."""
    writer = Writer(file, compression=CompressionType.ZSTD, enable_data_crcs=True)
    writer.start(profile=Profile.ROS2, library=f"tractor_ems {__version__}")
    schema_ids: dict[int, int] = {}
    channel_ids: dict[int, int] = {}
    for record in _readable(source, seen):
        match record:
            case Schema():
                schema_ids[record.id] = writer.register_schema(
                    record.name, record.encoding, record.data
                )
            case Channel():
                channel_ids[record.id] = writer.register_channel(
                    record.topic,
                    record.message_encoding,
                    schema_ids[record.schema_id],
                    record.metadata,
                )
            case Message():
                writer.add_message(
                    channel_ids[record.channel_id],
                    log_time=record.log_time,
                    data=record.data,
                    publish_time=record.publish_time,
                    sequence=record.sequence,
                )
    if not seen.counts:
        raise BagError(f"{source.name}: holds no message, there is nothing to finalise")
    seen.provenance["recovered"] = "true" if recovered else "false"
    seen.provenance["cut_bytes"] = str(size - seen.read_bytes)
    writer.add_metadata(PROVENANCE, seen.custom_data)
    target = Path(source.name).name.removesuffix(PART_SUFFIX)
    writer.add_metadata("rosbag2", {"serialized_metadata": _yaml(_metadata(target, seen))})
    writer.finish()  # type: ignore[no-untyped-call]


def _readable(source: IO[bytes], seen: _Transcript) -> Iterator[McapRecord]:
    """Records in file order until the end, a cut, or damage; each is accounted for in ``seen``."""
    records = StreamReader(source, emit_chunks=True, record_size_limit=MAX_RECORD_BYTES).records
    while True:
        try:
            record = next(records)
        except (McapError, struct.error, ValueError, StopIteration):
            return
        match record:
            case Chunk():
                return  # a part has none: not a recording of ours from here on
            case Schema():
                seen.schemas[record.id] = record
            case Channel():
                if record.schema_id not in seen.schemas:
                    return
                seen.channels[record.id] = record
            case Metadata():
                if record.name == PROVENANCE:
                    seen.provenance.update(record.metadata)
            case Message():
                if record.channel_id not in seen.channels:
                    return
                seen.account(record)
        seen.read_bytes = source.tell()
        yield record


def _metadata(file_name: str, seen: _Transcript) -> dict[str, Any]:
    """metadata.yaml of rosbag2, version 9."""
    count = seen.counts.total()
    duration = {"nanoseconds": seen.last_ns - seen.first_ns}
    start = {"nanoseconds_since_epoch": seen.first_ns}
    return {
        "version": ROSBAG2_VERSION,
        "storage_identifier": "mcap",
        "duration": duration,
        "starting_time": start,
        "message_count": count,
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": channel.topic,
                    "type": seen.schemas[channel.schema_id].name,
                    "serialization_format": channel.message_encoding,
                    "offered_qos_profiles": yaml.safe_load(
                        channel.metadata["offered_qos_profiles"]
                    ),
                    "type_description_hash": channel.metadata["topic_type_hash"],
                },
                "message_count": seen.counts[key],
            }
            for key, channel in seen.channels.items()
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file_name],
        "files": [
            {
                "path": file_name,
                "starting_time": start,
                "duration": duration,
                "message_count": count,
            }
        ],
        "custom_data": seen.custom_data,
        "ros_distro": "jazzy",
    }


def _yaml(document: dict[str, Any]) -> str:
    class Plain(yaml.SafeDumper):
        """Without anchors: the durations and times above are shared objects."""

        def ignore_aliases(self, data: Any) -> bool:
            return True

    return yaml.dump(document, Dumper=Plain, sort_keys=False, allow_unicode=True)
