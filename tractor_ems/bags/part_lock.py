"""Who holds a part file: the recorder that is writing it, or one recovery. Advisory file locks.

The kernel drops a lock with its process, so a killed recorder leaves none behind.
"""

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from tractor_msgs_py.errors import BagError


def hold(file: IO[bytes]) -> None:
    """Take the lock of an open part file, until it is closed."""
    fcntl.flock(file, fcntl.LOCK_EX)


def refuse_live(part: Path) -> None:
    """Raise BagError where a process holds the part file, or where it cannot be read."""
    with _opened(part, "rb") as file:
        _try_lock(file, part, fcntl.LOCK_SH)


@contextmanager
def held(part: Path) -> Iterator[None]:
    """Hold a part file that nobody else does. Raises BagError where somebody does."""
    with _opened(part, "r+b") as file:  # network file systems lock only what may be written
        _try_lock(file, part, fcntl.LOCK_EX)
        yield


def _opened(part: Path, mode: str) -> IO[bytes]:
    try:
        return part.open(mode)
    except OSError as error:
        raise BagError(f"{part}: cannot be opened ({error.strerror})") from None


def _try_lock(file: IO[bytes], part: Path, kind: int) -> None:
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        raise BagError(f"{part.parent}: still being recorded; stop the recorder first") from None
