"""An MCAP file below its samples: CRCs, channels, sequence numbers."""

import os
import struct
import zlib
from collections import defaultdict
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import IO

import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, DataEnd, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from tractor_ems.bags.chunk_limit import refuse_large_chunks
from tractor_msgs_py.errors import BagError

MAGIC_BYTES = 8
FOOTER_BYTES = 1 + 8 + 20
"""Opcode, length, and start of summary, start of summary offsets, CRC."""

_DAMAGE = (
    OSError,
    McapError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    MemoryError,  # a length field that says terabytes
    OverflowError,
)


@dataclass(frozen=True)
class ScannedChannel:
    """One channel.

    Attributes:
        topic, type: full topic name and message type.
        type_hash, qos: the channel's metadata, empty where the writer left them out.
        messages: how many it holds.
        lost: messages missing between two sequence numbers; None where there are none.
    """

    topic: str
    type: str
    type_hash: str
    qos: str
    messages: int
    lost: int | None


@dataclass(frozen=True)
class Scan:
    """What one pass over a file found; every CRC in it was validated.

    Attributes:
        chunks, chunks_without_crc: how many there are.
        data_crc: the data section has a CRC of its own.
        channels: in the order of their ids.
    """

    chunks: int
    chunks_without_crc: int
    data_crc: bool
    channels: tuple[ScannedChannel, ...]


def scan_mcap(file: Path) -> Scan:
    """Read a whole file and validate the CRCs of chunks, data section and summary.

    Raises:
        BagError: a CRC is wrong, or the file is truncated or not MCAP.
    """
    chunks = without_crc = 0
    data_crc: bool | None = None
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    sequences: dict[int, list[int]] = defaultdict(list)
    refuse_large_chunks(file)
    try:
        with file.open("rb") as stream:
            _validate_summary(stream)
            for record in StreamReader(stream, emit_chunks=True, validate_crcs=True).records:
                inner: list[McapRecord] = [record]
                if isinstance(record, Chunk):
                    chunks += 1
                    without_crc += record.uncompressed_crc == 0
                    inner = breakup_chunk(record, validate_crc=True)
                elif isinstance(record, DataEnd):
                    data_crc = record.data_section_crc != 0
                for item in inner:
                    match item:
                        case Schema():
                            schemas[item.id] = item
                        case Channel():
                            channels[item.id] = item
                        case Message():
                            sequences[item.channel_id].append(item.sequence)
    except _DAMAGE as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise BagError(f"{file}: damaged ({reason})") from None
    if data_crc is None:
        raise BagError(f"{file}: damaged (no end of data)")
    return Scan(
        chunks,
        without_crc,
        data_crc,
        tuple(
            _channel(channel, schemas.get(channel.schema_id), sequences[key])
            for key, channel in sorted(channels.items())
        ),
    )


def _validate_summary(stream: IO[bytes]) -> None:
    """The one CRC that the MCAP library writes but does not read; leaves the stream at 0."""
    stream.seek(-FOOTER_BYTES - MAGIC_BYTES, os.SEEK_END)
    end = stream.tell() + FOOTER_BYTES - 4
    _, _, start, _, expected = struct.unpack("<BQQQI", stream.read(FOOTER_BYTES))
    stream.seek(start)
    if expected and zlib.crc32(stream.read(end - start)) != expected:
        raise BagError(f"{stream.name}: damaged (summary CRC)")
    stream.seek(0)


def _channel(channel: Channel, schema: Schema | None, sequences: list[int]) -> ScannedChannel:
    return ScannedChannel(
        topic=channel.topic,
        type="" if schema is None else schema.name,
        type_hash=channel.metadata.get("topic_type_hash", ""),
        qos=channel.metadata.get("offered_qos_profiles", ""),
        messages=len(sequences),
        lost=_lost(sequences),
    )


def _lost(sequences: list[int]) -> int | None:
    """Numbers skipped. A number that does not grow is another publisher's, for instance that of
    the next run; 0 throughout means that the writer had none."""
    if not any(sequences):
        return None
    return sum(max(b - a - 1, 0) for a, b in pairwise(sequences))
