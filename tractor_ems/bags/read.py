"""Bags to runs: the recorded samples through the live node's codec, grouped, duplicates dropped.

Reads every bag that ``rosbags`` reads (MCAP or sqlite3, with or without metadata.yaml), in any
namespace. Judging a bag is ``check``'s job, and traces to learn from are made in ``transitions``.
"""

import hashlib
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from mcap.exceptions import McapError
from mcap.reader import make_reader
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader

from tractor_ems.bags.chunk_limit import refuse_large_chunks
from tractor_ems.bags.part_lock import refuse_live
from tractor_ems.bags.plain_yaml import parse_yaml
from tractor_ems.bags.rosbags_messages import deserialize, type_hash
from tractor_ems.bags.runs import Run, RunCollector
from tractor_msgs_py import topics
from tractor_msgs_py.codec import DECODERS
from tractor_msgs_py.errors import BagError
from tractor_msgs_py.types import Sample

PART_SUFFIX = ".part"
"""Ending of a recording that was not finalised."""

PART_FILES = f"[!.]*.mcap{PART_SUFFIX}"
"""Such recordings in a folder; names with a dot in front are files that were being written."""

PROVENANCE = "tractor_ems"
"""Name of the MCAP metadata record that says where a bag came from."""

CONTRACT = {topic.name: topic for topic in topics.RECORDED}


def find_bags(paths: Iterable[Path]) -> list[Path]:
    """Bags at or below the given paths, sorted per path; a path that is a bag stands for itself.

    Raises:
        BagError: a path does not exist or holds no bag.
    """
    found: list[Path] = []
    for path in paths:
        below = [path] if _is_bag(path) else sorted(p for p in path.rglob("*") if _is_bag_dir(p))
        if not path.exists():
            raise BagError(f"{path}: no such bag")
        if not below:
            raise BagError(f"{path}: holds no bag")
        found += below
    return found


def storage_file(path: Path) -> Path:
    """The one storage file of a bag.

    Raises:
        BagError: the bag is missing, is being recorded, was not finalised, or is spread over
            several files.
    """
    if path.is_file():
        return path
    if not path.exists():
        raise BagError(f"{path}: no such bag")
    for part in path.glob(PART_FILES):
        refuse_live(part)
        raise BagError(f"{path}: the recording was not finalised; run: ems bag recover {path}")
    files = sorted([*path.glob("*.mcap"), *path.glob("*.db3")])
    if len(files) != 1:
        raise BagError(f"{path}: {len(files)} storage files, expected one .mcap or .db3")
    if not files[0].is_file():
        raise BagError(f"{files[0]}: not a file that can be read")
    return files[0]


def bag_hash(path: Path) -> str:
    """SHA-256 of a bag's storage file, which names the bag in policy files and reports.

    Raises:
        BagError: there is no such bag, or its file cannot be read.
    """
    digest, file = hashlib.sha256(), storage_file(path)
    try:
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    except OSError as error:
        raise BagError(f"{path}: cannot be read ({error.strerror})") from None
    return digest.hexdigest()


def provenance_of(path: Path) -> dict[str, str]:
    """What the writer said about the bag: the MCAP record, which :func:`bag_hash` covers.

    metadata.yaml's custom data for a sqlite3 bag. Empty for a bag of another writer.
    """
    file = storage_file(path)
    metadata = metadata_of(path, file)
    try:
        if file.suffix != ".mcap":
            data = metadata.get("custom_data") or {}
            return {str(key): str(value) for key, value in data.items()}
        with file.open("rb") as stream:
            records = make_reader(stream).iter_metadata()
            return dict(next((r.metadata for r in records if r.name == PROVENANCE), {}))
    except (
        OSError,
        McapError,
        struct.error,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
    ) as error:
        raise BagError(f"{path}: provenance cannot be read ({brief(error)})") from None


def metadata_of(path: Path, file: Path) -> dict[str, Any]:
    """metadata.yaml's content, which must be about ``file`` as it is; empty where there is none.

    A file that it names instead would be read, and be no part of the bag's hash. What rosbag2
    compressed on top of its storage has no limit to what it expands to.
    """
    metadata = path / "metadata.yaml"
    if not metadata.is_file():
        return {}
    try:
        text = metadata.read_text(encoding="utf-8")
        document = parse_yaml(text, f"{path}: provenance cannot be read")
        content: dict[str, Any] = document["rosbag2_bagfile_information"]
        named = [str(name) for name in content["relative_file_paths"]]
        mode = str(content.get("compression_mode") or "").lower()
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise BagError(f"{path}: provenance cannot be read ({brief(error)})") from None
    if [Path(name).name for name in named] != [file.name]:
        raise BagError(f"{path}: metadata.yaml names {named}, expected [{file.name!r}]")
    if mode not in ("", "none"):
        raise BagError(f"{path}: compression_mode {mode!r}, allowed none (chunks may be)")
    return content


def read_bag(path: Path) -> list[Run]:
    """Every run in a bag, in the order of its start; aborted runs are there with complete False.

    Samples are taken in the order of their reception. Each namespace is a tractor of its own.

    Raises:
        BagError: the bag is missing, truncated, foreign or empty, a contract topic has another
            type or type hash, or a message has another layout.
    """
    file = storage_file(path)
    collectors: dict[str, RunCollector] = {}
    for namespace, name, data in _messages(path, file):
        collector = collectors.setdefault(namespace, RunCollector(namespace))
        try:
            collector.add(decode(name, data))
        except BagError as error:
            raise BagError(f"{path}: {name}: {error}") from None
    policies = provenance_of(path)
    runs = [run for c in collectors.values() for run in c.runs(policies)]
    if not any(run.demand for run in runs):
        raise BagError(f"{path}: holds no {topics.POWER_DEMAND.name}")
    return runs


def decode(name: str, data: bytes) -> Sample:
    """CDR bytes of a contract topic, by relative name, to a sample.

    Raises:
        BagError: the bytes are no message of the topic's type, or it has another layout.
    """
    decoder: Callable[[Any], Any] = DECODERS[name]
    sample: Sample = decoder(deserialize(data, CONTRACT[name].type))
    return sample


def _messages(path: Path, file: Path) -> Iterator[tuple[str, str, bytes]]:
    """Namespace, relative topic name and CDR bytes of the contract's messages."""
    whole = path if metadata_of(path, file) else file
    if file.suffix == ".mcap":
        refuse_large_chunks(file)
    try:
        with Reader(whole) as reader:
            wanted = _contract_connections(path, reader.connections)
            if not reader.message_count:
                raise BagError(f"{path}: is empty")
            for connection, _, data in reader.messages(connections=list(wanted)):
                namespace, _, name = connection.topic.rpartition("/")
                yield namespace or "/", name, bytes(data)
    except BagError:
        raise
    except Exception as error:  # on foreign bytes the reader raises whatever its parsing meets
        raise BagError(f"{path}: not a readable bag ({brief(error)})") from None


def _contract_connections(path: Path, connections: Sequence[Connection]) -> list[Connection]:
    """Connections of the namespaces that have a power demand; the others are not tractors."""
    found = [(c, *c.topic.rpartition("/")[::2]) for c in connections]
    tractors = {ns for _, ns, name in found if name == topics.POWER_DEMAND.name}
    wanted = [(c, name) for c, ns, name in found if ns in tractors and name in CONTRACT]
    if not wanted:
        held = ", ".join(sorted(c.topic for c in connections)) or "nothing"
        raise BagError(
            f"{path}: no topic {topics.POWER_DEMAND.name}, holds {held} (other topics need "
            "--signals; ems bag signals drafts a map)"
        )
    for connection, name in wanted:
        expected = CONTRACT[name].type
        if connection.msgtype != expected:
            raise BagError(
                f"{path}: {connection.topic} is {connection.msgtype}, expected {expected}"
            )
        if connection.digest and connection.digest != type_hash(expected):
            raise BagError(
                f"{path}: {connection.topic} has type hash {connection.digest}, "
                f"{expected} has {type_hash(expected)}"
            )
    return [connection for connection, _ in wanted]


def _is_bag_dir(path: Path) -> bool:
    return path.is_dir() and any(
        True
        for pattern in ("metadata.yaml", "*.mcap", "*.db3", PART_FILES)
        for _ in path.glob(pattern)
    )


def _is_bag(path: Path) -> bool:
    return (path.suffix in (".mcap", ".db3") and path.is_file()) or _is_bag_dir(path)


def brief(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
