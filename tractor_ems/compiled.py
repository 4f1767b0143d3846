"""Where numba keeps compiled code: a folder named by the sources that went into it.

numba looks only at the age of the file that a function stands in. A loop that calls another
file's function, or uses its constants, would stay old when that file changes.
"""

import hashlib
import os
import sys
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[1]
_SOURCES = (
    "tractor_ems/learning/*.py",
    "tractor_ems/optimal/*.py",
    "tractor_ems/policies/genset.py",
    "tractor_ems/policies/one_step.py",
    "tractor_ems/policies/run_or_stand.py",
    "tractor_ems/study/experts.py",
    "tractor_ems/tuning/closed_loop.py",
    "tractor_sim/*.py",
)
"""Every file with compiled functions, and every file whose constants they use."""


def sources_digest() -> str:
    """Hash of the files that compiled code may be made of."""
    digest = hashlib.sha256()
    for pattern in _SOURCES:
        for path in sorted(_ROOT.glob(pattern)):
            digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def keep_apart() -> None:
    """Point numba at the folder of these sources, unless NUMBA_CACHE_DIR is set.

    Where that folder cannot be written to, numba finds a place of its own.
    """
    if "NUMBA_CACHE_DIR" in os.environ:
        return
    folder = Path(__file__).resolve().parent / "__pycache__" / f"numba-{sources_digest()}"
    if "numba" in sys.modules:  # it has read its environment already
        sys.modules["numba"].config.CACHE_DIR = str(folder)
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
