"""How large an MCAP file gets when it is read: chunks that expand too far are refused first.

The readers expand a chunk whole. Ours are below a megabyte; 10 kB can claim to be gigabytes.
"""

import io
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from tractor_msgs_py.errors import BagError

MAX_CHUNK_BYTES = 64 << 20
"""Largest chunk that is read [bytes]."""

_MAGIC_BYTES, _FOOTER_BYTES = 8, 29
_FOOTER, _CHUNK, _CHUNK_INDEX = 0x02, 0x06, 0x08
_PIECE_BYTES = 1 << 18


class _Chunk(NamedTuple):
    """What a chunk and its index entry both say."""

    compression: bytes
    compressed: int
    uncompressed: int


def refuse_large_chunks(file: Path) -> None:
    """Raise BagError where a chunk of an MCAP file is, or expands to, more than the limit.

    A file that is damaged otherwise is left to its reader. An index that names a chunk which
    is not one of the file's records is refused, because readers follow it.
    """
    chunks: dict[int, _Chunk] = {}
    boundary = False
    try:
        with file.open("rb") as stream:
            summary_start = _summary_start(stream)
            for start, opcode, length in _records(stream):
                boundary |= start == summary_start
                if opcode == _CHUNK:
                    chunks[start] = _checked(file, stream, length)
                elif opcode == _CHUNK_INDEX:
                    offset, chunk = _index_entry(stream.read(length))
                    if chunks.get(offset) != chunk:
                        raise BagError(f"{file}: damaged (its index names no chunk)")
    except (OSError, struct.error):
        return
    if summary_start and not boundary:
        raise BagError(f"{file}: not a readable bag (summary at no record)")


def _summary_start(stream: IO[bytes]) -> int:
    stream.seek(-_FOOTER_BYTES - _MAGIC_BYTES, os.SEEK_END)
    opcode, _, start = struct.unpack("<BQQ", stream.read(17))
    return int(start) if opcode == _FOOTER else 0


def _records(stream: IO[bytes]) -> Iterator[tuple[int, int, int]]:
    """Start, opcode and length of each record that is whole; the stream is at its content."""
    size, start = stream.seek(0, os.SEEK_END), _MAGIC_BYTES
    while start + 9 <= size:
        stream.seek(start)
        opcode, length = struct.unpack("<BQ", stream.read(9))
        if start + 9 + length > size:
            return
        yield start, opcode, length
        start += 9 + length


def _index_entry(content: bytes) -> tuple[int, _Chunk]:
    offset, _, map_bytes = struct.unpack_from("<QQI", content, 16)
    name_at = 16 + 20 + map_bytes + 8
    (name_bytes,) = struct.unpack_from("<I", content, name_at)
    name = content[name_at + 4 : name_at + 4 + name_bytes]
    return offset, _Chunk(name, *struct.unpack_from("<QQ", content, name_at + 4 + name_bytes))


def _checked(file: Path, stream: IO[bytes], length: int) -> _Chunk:
    uncompressed, _, name_bytes = struct.unpack("<16xQII", stream.read(32))
    name = stream.read(min(name_bytes, length))
    (compressed,) = struct.unpack("<Q", stream.read(8))
    if max(uncompressed, compressed) > MAX_CHUNK_BYTES:
        raise BagError(f"{file}: chunk of {max(uncompressed, compressed)} bytes, {_ALLOWED}")
    data = stream.read(compressed)
    if name in (b"zstd", b"lz4") and _expands_too_far(name, data):
        raise BagError(f"{file}: chunk expands further than it says, {_ALLOWED}")
    return _Chunk(name, compressed, uncompressed)


_ALLOWED = f"allowed {MAX_CHUNK_BYTES}"


def _expands_too_far(name: bytes, data: bytes) -> bool:
    """Expand piece by piece, and count."""
    source, total = io.BytesIO(data), 0
    try:
        if name == b"zstd":
            reader = zstandard.ZstdDecompressor().stream_reader(source, read_across_frames=True)
        else:
            reader = lz4.frame.LZ4FrameFile(source)
        while piece := reader.read(_PIECE_BYTES):
            total += len(piece)
            if total > MAX_CHUNK_BYTES:
                return True
    except (zstandard.ZstdError, RuntimeError, EOFError, OSError):
        return False  # damage, which the reader names
    return False
