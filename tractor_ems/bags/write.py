"""A live recording that survives SIGKILL: an unchunked MCAP part file, flushed per message.

Every message is handed to the operating system before :meth:`BagWriter.write` returns, and to
the disk with every :meth:`BagWriter.sync`. Chunks, index, CRCs and metadata come when the part
is finalised (``finalise``), by the same code after a clean stop and after a crash.
"""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType

import yaml
from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import CompressionType, IndexType, Writer

from tractor_ems.bags.finalise import Finalised, finalise
from tractor_ems.bags.part_lock import hold
from tractor_ems.bags.read import PART_SUFFIX, PROVENANCE
from tractor_ems.bags.rosbags_messages import definition, type_hash
from tractor_msgs_py import __version__
from tractor_msgs_py.atomic import sync_folder
from tractor_msgs_py.errors import BagError, RunAborted, TractorEmsError
from tractor_msgs_py.topics import Qos, Topic

_FOREVER = {"sec": 9223372036, "nsec": 854775807}
_UINT32 = 0xFFFF_FFFF


def qos_profiles(qos: Qos) -> str:
    """``offered_qos_profiles`` of a channel, as rosbag2 version 9 writes them."""
    profile = {
        "history": "keep_last",
        "depth": qos.depth,
        "reliability": qos.reliability,
        "durability": qos.durability,
        "deadline": _FOREVER,
        "lifespan": _FOREVER,
        "liveliness": "automatic",
        "liveliness_lease_duration": _FOREVER,
        "avoid_ros_namespace_conventions": False,
    }
    return yaml.safe_dump([profile], sort_keys=False).strip()


class BagWriter:
    """Records raw CDR messages into a new bag folder.

    Use as a context manager, or call :meth:`close`. A writer that is abandoned leaves its part
    file, which ``recover`` finalises. While it lives it holds the part file's lock.

    Args:
        folder: the bag to create; parents are created too.
        channels: full topic name to row of the wire contract.
        provenance: where the bag comes from, as text; the package version is added.

    Raises:
        BagError: ``folder`` exists already, or cannot be written.
    """

    def __init__(
        self, folder: Path, channels: Mapping[str, Topic], provenance: Mapping[str, str]
    ) -> None:
        self.folder = folder
        self.part = folder / f"{folder.name}_0.mcap{PART_SUFFIX}"
        self.messages = 0
        self._schemas: dict[str, int] = {}
        if not folder.name:
            raise BagError(f"{folder}: a bag needs a folder name of its own")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            raise BagError(f"{folder}: exists already, a recording overwrites nothing") from None
        except OSError as error:
            raise BagError(f"{folder}: cannot be created ({error.strerror})") from None
        with self._writing(BagError):
            self._file = self.part.open("xb")
            hold(self._file)
            self._writer = Writer(
                self._file,
                compression=CompressionType.NONE,
                index_types=IndexType.NONE,
                use_chunking=False,
            )
            self._writer.start(profile=Profile.ROS2, library=f"tractor_ems {__version__}")
            self._channels = {name: self._register(name, channels[name]) for name in channels}
            self._writer.add_metadata(PROVENANCE, {"package_version": __version__, **provenance})
            self._file.flush()
            os.fsync(self._file.fileno())
            sync_folder(folder)
            sync_folder(folder.parent)

    @contextmanager
    def _writing(self, kind: type[TractorEmsError] = RunAborted) -> Iterator[None]:
        """A failure to begin is a bad folder; one after that ends a run that was going on."""
        try:
            yield
        except OSError as error:
            reason = error.strerror or str(error)
            raise kind(f"{self.part}: cannot be written ({reason})") from None

    def _register(self, name: str, topic: Topic) -> int:
        if topic.type not in self._schemas:
            self._schemas[topic.type] = self._writer.register_schema(
                topic.type, SchemaEncoding.ROS2, definition(topic.type).encode()
            )
        metadata = {
            "offered_qos_profiles": qos_profiles(topic.qos),
            "topic_type_hash": type_hash(topic.type),
        }
        return self._writer.register_channel(
            name, MessageEncoding.CDR, self._schemas[topic.type], metadata
        )

    def write(
        self, name: str, data: bytes, log_time_ns: int, publish_time_ns: int, sequence: int = 0
    ) -> None:
        """Append one message and flush it.

        Args:
            name: full topic name, one of ``channels``.
            data: CDR bytes.
            log_time_ns, publish_time_ns: when it was received and published.
            sequence: the publisher's sequence number, 0 where unknown.

        Raises:
            RunAborted: the file cannot be written, for instance because the disk is full.
        """
        with self._writing():
            self._writer.add_message(
                self._channels[name],
                log_time=log_time_ns,
                data=data,
                publish_time=publish_time_ns,
                sequence=sequence & _UINT32,
            )
            self._file.flush()
        self.messages += 1

    def note(self, provenance: Mapping[str, str]) -> None:
        """Add to the provenance, now: a later value of a key replaces an earlier one."""
        with self._writing():
            self._writer.add_metadata(PROVENANCE, dict(provenance))
            self._file.flush()

    def sync(self) -> None:
        """Bring everything to the disk; call it about once a second."""
        with self._writing():
            self._file.flush()
            os.fsync(self._file.fileno())

    def close(self) -> Finalised:
        """Finalise the bag.

        Raises:
            BagError: nothing was written into it.
            RunAborted: it cannot be finalised.
                The part file stays either way, and ``recover`` tries again.
        """
        try:
            self.sync()
            return finalise(self.part, recovered=False)
        except BagError as error:
            if not self.messages:
                raise
            raise RunAborted(str(error)) from None
        finally:
            self._release()

    def discard(self) -> None:
        """Remove a recording that holds nothing worth keeping."""
        self._release()
        self.part.unlink(missing_ok=True)
        self.folder.rmdir()

    def _release(self) -> None:
        """Close the file, and with it the lock; what a full disk did not take is given up."""
        with suppress(OSError):
            self._file.close()

    def __enter__(self) -> "BagWriter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is None:
            self.close()
        else:
            self._release()
