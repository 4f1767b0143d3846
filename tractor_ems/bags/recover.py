"""Finalise a recording that was killed: the recorder's own code, run later."""

from pathlib import Path

from tractor_ems.bags.finalise import Finalised, finalise
from tractor_ems.bags.part_lock import held
from tractor_ems.bags.read import PART_FILES, PART_SUFFIX
from tractor_msgs_py.errors import BagError


def recover(path: Path) -> Finalised:
    """Finalise the part file in a bag folder, and say what was saved and what was cut.

    Args:
        path: the bag folder, or the part file itself.

    Raises:
        BagError: there is no part file or more than one, it is still being recorded, or it
            holds no message; nothing is changed then.
    """
    if path.is_file() and path.name.endswith(PART_SUFFIX):
        with held(path):
            return finalise(path, recovered=True)
    if not path.is_dir():
        raise BagError(f"{path}: no such bag folder")
    parts = sorted(path.glob(PART_FILES))
    if len(parts) != 1:
        raise BagError(f"{path}: {len(parts)} part files, there must be one to recover")
    with held(parts[0]):
        for beside in path.glob(f".*{PART_SUFFIX}"):
            beside.unlink(missing_ok=True)  # a finalise was killed: a living one holds the part
        return finalise(parts[0], recovered=True)
