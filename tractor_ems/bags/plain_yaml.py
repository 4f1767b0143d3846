"""YAML that came with a bag, which may be anybody's: bounded, and with one kind of error."""

from typing import Any

import yaml

from tractor_msgs_py.errors import BagError

MAX_CHARACTERS = 10_000_000
"""Largest document with its aliases written out; rosbag2's own are some kilobytes."""


def parse_yaml(text: str, where: str) -> Any:
    """Plain data. Raises BagError, which begins with ``where``, on anything else.

    Aliases are allowed, as writers use them for equal durations; a few aliases of aliases that
    would be gigabytes once they are written out as text are not.
    """
    try:
        data = yaml.safe_load(text)
        if _expanded(data, {}) > MAX_CHARACTERS:
            raise ValueError(f"aliases expand it beyond {MAX_CHARACTERS} characters")
    except (yaml.YAMLError, ValueError, RecursionError, OverflowError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise BagError(f"{where}: {reason}") from None
    return data


def _expanded(data: Any, known: dict[int, int]) -> int:
    """Characters of a value with every alias written out; each shared part is counted once."""
    if not isinstance(data, dict | list | tuple | set):
        return len(data) if isinstance(data, str | bytes) else 1
    if id(data) not in known:
        known[id(data)] = MAX_CHARACTERS + 1  # found again below itself: without end
        parts = [*data, *data.values()] if isinstance(data, dict) else list(data)
        known[id(data)] = 1 + sum(_expanded(part, known) for part in parts)
    return known[id(data)]
