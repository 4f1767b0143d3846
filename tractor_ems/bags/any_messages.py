"""Messages of any topic and type in a bag, decoded with the definitions that the bag brings.

For vehicles that do not speak the wire contract; ``read`` is the reader of those that do.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag2 import Reader
from rosbags.typesys import get_types_from_idl, get_types_from_msg
from rosbags.typesys.store import Typestore

from tractor_ems.bags.chunk_limit import refuse_large_chunks
from tractor_ems.bags.read import brief, metadata_of, storage_file
from tractor_ems.bags.rosbags_messages import type_hash, typestore
from tractor_msgs_py.errors import BagError

MAX_DEFINITION = 1_000_000
"""Characters of a message definition with all it depends on; the largest have 20 thousand."""


@dataclass(frozen=True)
class BagTopic:
    """One topic of a bag: full name, message type, number of messages."""

    name: str
    type: str
    messages: int


@dataclass(frozen=True, slots=True)
class Heard:
    """One message: when the recorder heard it, when it was published (log time where the storage
    does not keep it), and itself, None where its bytes are no message of the topic's type."""

    topic: str
    log_ns: int
    publish_ns: int
    message: Any


class AnyBag:
    """A bag of any topics.

    Args:
        path: bag folder or storage file.

    Raises BagError where it is missing, cannot be read or is empty.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._file = path, storage_file(path)
        self._whole = path if metadata_of(path, self._file) else self._file
        if self._file.suffix == ".mcap":
            refuse_large_chunks(self._file)
        try:
            with Reader(self._whole) as reader:
                self._connections = list(reader.connections)
                count = reader.message_count
        except Exception as error:  # on foreign bytes the reader raises whatever its parsing meets
            raise BagError(f"{path}: not a readable bag ({brief(error)})") from None
        if not count:
            raise BagError(f"{path}: is empty")
        self._stores: dict[str, Typestore] = {}

    @property
    def topics(self) -> Mapping[str, BagTopic]:
        """Every topic by its full name; a topic of several publishers once.

        Raises BagError where one topic has two types.
        """
        found: dict[str, BagTopic] = {}
        for connection in self._connections:
            name, kind = connection.topic, connection.msgtype
            known = found.get(name, BagTopic(name, kind, 0))
            if known.type != kind:
                raise BagError(f"{self.path}: {name} is {known.type} and {kind}, expected one")
            found[name] = BagTopic(name, kind, known.messages + connection.msgcount)
        return found

    def decodable(self, topic: str) -> str | None:
        """Why a topic's messages cannot be decoded; None: they can."""
        try:
            self._store(topic)
        except BagError as error:
            return str(error)
        return None

    def messages(self, topics: Collection[str]) -> Iterator[Heard]:
        """The messages of these topics in the order in which they were recorded.

        Raises:
            BagError: a topic's type is unknown and the bag does not define it, or the bag is
                damaged.
        """
        stores = {topic: self._store(topic) for topic in topics}
        types = {topic: self.topics[topic].type for topic in topics}
        for topic, log_ns, publish_ns, data in self._raw(topics):
            try:
                message = stores[topic].deserialize_cdr(data, types[topic])
            except Exception:  # generated code: a malformed message can raise almost anything
                message = None
            yield Heard(topic, log_ns, publish_ns, message)

    def _raw(self, topics: Collection[str]) -> Iterator[tuple[str, int, int, bytes]]:
        if not topics:
            return
        try:
            if self._file.suffix == ".mcap":
                with self._file.open("rb") as stream:
                    # Not the rosbags reader, which does not tell the time of publication.
                    for _, channel, message in make_reader(stream).iter_messages(sorted(topics)):
                        yield channel.topic, message.log_time, message.publish_time, message.data
                return
            with Reader(self._whole) as reader:
                wanted = [c for c in reader.connections if c.topic in topics]
                for connection, log_ns, data in reader.messages(connections=wanted):
                    yield connection.topic, log_ns, log_ns, bytes(data)
        except Exception as error:  # as above
            raise BagError(f"{self.path}: not a readable bag ({brief(error)})") from None

    def _store(self, topic: str) -> Typestore:
        connection = next(c for c in self._connections if c.topic == topic)
        kind = connection.msgtype
        if kind not in self._stores:
            known = kind in typestore().fielddefs
            same = known and connection.digest in ("", type_hash(kind))
            self._stores[kind] = typestore() if same else self._defined(connection, known)
        return self._stores[kind]

    def _defined(self, connection: Connection, known: bool) -> Typestore:
        """A store of the types as the bag defines them."""
        kind, text = connection.msgtype, connection.msgdef.data
        problem = f"{self.path}: {connection.topic} is {kind}, "
        if not text.strip():
            if known:
                return typestore()
            raise BagError(f"{problem}which is no standard type, and the bag does not define it")
        if len(text) > MAX_DEFINITION:
            raise BagError(f"{problem}defined in {len(text)} characters, allowed {MAX_DEFINITION}")
        store = Typestore()
        try:
            if connection.msgdef.format is MessageDefinitionFormat.IDL:
                types = get_types_from_idl(text)
            else:
                types = get_types_from_msg(text, kind)
            store.register(types)
            if kind not in store.fielddefs:
                raise KeyError(kind)
        except Exception as error:  # a foreign text through a grammar
            raise BagError(f"{problem}whose definition cannot be read ({brief(error)})") from None
        return store
