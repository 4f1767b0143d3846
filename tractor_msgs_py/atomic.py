"""Files that are either whole or absent: write beside, fsync, replace."""

import contextlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

from tractor_msgs_py.errors import ConfigError


def write_bytes_with(path: Path, write: Callable[[IO[bytes]], Any]) -> None:
    """Let ``write`` fill a temporary file beside ``path``, then put it in place.

    Raises:
        ConfigError: the folder cannot be written to.
    """
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with beside.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
        sync_folder(path.parent)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from None
    finally:
        with contextlib.suppress(OSError):  # it may never have been there
            beside.unlink()


def write_bytes(path: Path, data: bytes) -> None:
    """Write ``data`` whole or not at all."""
    write_bytes_with(path, lambda file: file.write(data))


def write_json(path: Path, document: Any) -> None:
    """Write one JSON document; a number that is not finite raises ValueError, nothing stays."""
    write_bytes(path, (json.dumps(document, indent=2, allow_nan=False) + "\n").encode())


def sync_folder(path: Path) -> None:
    """fsync a folder, so that a rename in it survives a power cut."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
