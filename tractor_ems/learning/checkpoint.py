"""Checkpoints of a training run: named arrays and one JSON document in a safetensors file.

A run that is resumed from one ends with the same bytes as a run that was never interrupted.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from tractor_msgs_py.atomic import write_bytes
from tractor_msgs_py.errors import ConfigError

FORMAT_VERSION = 3
_KEY = "tractor_ems.checkpoint"


def checkpoint_path(out: Path) -> Path:
    """Where the checkpoint of the run that writes ``out`` lies."""
    return out.with_name(f"{out.stem}.checkpoint")


def save_checkpoint(
    path: Path, tensors: Mapping[str, Any], state: Mapping[str, Any], run: Mapping[str, Any]
) -> None:
    """Write whole or not at all.

    Args:
        tensors: arrays by name.
        state: step and generator states, plain data.
        run: what must be equal for a run to be continued: configuration, bag hashes.
    """
    document = json.dumps(
        {"format_version": FORMAT_VERSION, "state": state, "run": run},
        sort_keys=True,
        allow_nan=False,
    )
    whole = {name: np.ascontiguousarray(value) for name, value in tensors.items()}
    write_bytes(path, save(whole, metadata={_KEY: document}))


def load_checkpoint(
    path: Path, run: Mapping[str, Any]
) -> tuple[dict[str, np.ndarray[Any, Any]], dict[str, Any]]:
    """Arrays and state.

    Raises:
        ConfigError: the file is missing, cut short, not a checkpoint, or of another run; the
            message names the first setting that differs.
    """
    try:
        with safe_open(path, framework="numpy") as file:
            document = (file.metadata() or {}).get(_KEY)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except OSError as error:
        raise ConfigError(f"{path}: no checkpoint to resume ({error.strerror or error})") from None
    except (SafetensorError, TypeError, ValueError) as error:
        raise ConfigError(f"{path}: damaged checkpoint ({' '.join(str(error).split())})") from None
    try:
        data = json.loads(document or "")
        version, state, stored = data["format_version"], data["state"], data["run"]
    except (ValueError, KeyError, TypeError, RecursionError):
        raise ConfigError(f"{path}: not a checkpoint of this package") from None
    if version != FORMAT_VERSION:
        raise ConfigError(
            f"{path}: checkpoint version {version!r}, this package reads {FORMAT_VERSION}"
        )
    wanted = json.loads(json.dumps(run))
    for name in sorted({*wanted, *stored}):
        if wanted.get(name) != stored.get(name):
            raise ConfigError(f"{path}: belongs to another run, {name} differs; start afresh")
    return tensors, state
