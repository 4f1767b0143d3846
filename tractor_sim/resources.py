"""Finds the files that ship with the package: configuration, data and golden bags.

One lookup for a source tree, a pip install and a colcon install, so that every executable starts
from any folder. Standard library only: the ROS shell and the pure core both use it.
"""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

from tractor_msgs_py.errors import ConfigError

_HERE = Path(__file__).resolve()
_SOURCE_FOLDERS = {"config": "config", "data": "tractor_sim/data", "bags": "bags"}


def _source_root() -> Path | None:
    """Return the checkout this module runs from, None when it is installed."""
    root = _HERE.parents[1]
    return root if (root / "package.xml").is_file() else None


def _candidate_shares() -> Iterator[Path]:
    """Yield where share/tractor_ems may be, the installation of this very file first."""
    prefixes = [*_HERE.parents, Path(sys.prefix)]
    prefixes += [Path(p) for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    seen: set[Path] = set()
    for prefix in prefixes:
        share = prefix / "share" / "tractor_ems"
        if share not in seen:
            seen.add(share)
            yield share


def share_dir() -> Path:
    """Return the folder that holds package.xml: the checkout, or <prefix>/share/tractor_ems.

    Raises:
        ConfigError: the package is in none of the places where an installation puts it.
    """
    source = _source_root()
    if source is not None:
        return source
    candidates = list(_candidate_shares())
    for share in candidates:
        if (share / "package.xml").is_file():
            return share
    raise ConfigError(
        "share/tractor_ems not found, looked for package.xml in " + ", ".join(map(str, candidates))
    )


def resource_path(kind: str, *parts: str) -> Path:
    """Return the path of a shipped file or folder, which exists.

    Args:
        kind: "config", "data" or "bags".
        parts: path below it, e.g. resource_path("config", "powertrain", "paper.yaml").

    Raises:
        ConfigError: unknown kind, or no such file; the message names where it was looked for.
    """
    if kind not in _SOURCE_FOLDERS:
        raise ConfigError(f"unknown resource kind {kind!r}, one of {', '.join(_SOURCE_FOLDERS)}")
    share = share_dir()
    folder = share / (kind if share != _source_root() else _SOURCE_FOLDERS[kind])
    path = folder.joinpath(*parts)
    if not path.exists():
        raise ConfigError(f"{'/'.join((kind, *parts))} not found, looked in {folder}")
    return path
