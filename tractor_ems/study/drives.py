"""What experts' bags hold, read once: hundreds of bags take a minute, and every agent wants them.

The production reader reads them; a file beside the bags keeps the columns until a bag changes.
"""

import json
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from tractor_ems.learning.recorded import Drive, drive_of_trace
from tractor_ems.learning.recordings import read_recordings
from tractor_msgs_py.atomic import write_bytes
from tractor_msgs_py.errors import BagError
from tractor_sim.powertrain import PowertrainParams
from tractor_sim.powertrain_json import powertrain_hash

_KEY = "tractor_ems.bags"


def read_drives(bags: Sequence[Path], params: PowertrainParams) -> tuple[Drive, ...]:
    """The driven run of every bag; all lie in one folder.

    Raises:
        BagError: a bag is missing, damaged, of another powertrain, or holds no whole driven run.
    """
    if not bags:
        return ()
    kept = bags[0].parent / f"drives-{len(bags)}.safetensors"
    key = json.dumps([powertrain_hash(params), *(_state(bag) for bag in bags)])
    found = _load(kept, key)
    if found is None:
        found = _read(bags, params)
        arrays = {
            f"{number}.{field.name}": np.ascontiguousarray(getattr(drive, field.name))
            for number, drive in enumerate(found)
            for field in fields(Drive)
        }
        write_bytes(kept, save(arrays, metadata={_KEY: key}))
    return found


def _read(bags: Sequence[Path], params: PowertrainParams) -> tuple[Drive, ...]:
    """One by one, so that the order is the bags' and not that of hashes, which a command line
    recorded in them would change."""
    drives = []
    for bag in bags:
        found = [drive_of_trace(trace) for trace in read_recordings([bag], [], params).traces]
        if len(found) != 1 or found[0] is None:
            raise BagError(f"{bag}: holds no whole driven run; remove it and run again")
        drives.append(found[0])
    return tuple(drives)


def _load(path: Path, key: str) -> tuple[Drive, ...] | None:
    """The kept columns, if they are of these very bags."""
    try:
        with safe_open(path, framework="numpy") as file:
            if (file.metadata() or {}).get(_KEY) != key:
                return None
            count = 1 + max(int(name.split(".")[0]) for name in file.keys())  # noqa: SIM118
            return tuple(
                Drive(
                    **{
                        field.name: file.get_tensor(f"{number}.{field.name}")
                        for field in fields(Drive)
                        if field.name != "soc_target"
                    },
                    soc_target=file.get_tensor(f"{number}.soc_target").item(),
                )
                for number in range(count)
            )
    except (OSError, SafetensorError, ValueError):
        return None


def _state(bag: Path) -> list[str | int]:
    """Name, size and time of a bag's files: what a change of it would change."""
    try:
        found = [(path.name, path.stat()) for path in sorted(bag.iterdir())]
    except OSError as error:
        raise BagError(f"{bag}: cannot be read ({error.strerror or error})") from None
    return [bag.name, *(value for name, s in found for value in (name, s.st_size, s.st_mtime_ns))]
