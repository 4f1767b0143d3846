"""Checks of the knots of a curve; an error names the entry, its value and what is allowed.

Entries count from 0, as they do in the errors of the YAML schema.
"""

from collections.abc import Sequence

import numpy as np

from tractor_msgs_py.errors import ConfigError
from tractor_msgs_py.trajectory import BoolArray, FloatArray


def check_entries(
    field: str, values: Sequence[float] | FloatArray, good: BoolArray, allowed: str
) -> None:
    """Refuse the first entry that is not good.

    Args:
        field: dotted name of the curve.
        values: (K,), its knots.
        good: (K,), which of them are allowed.
        allowed: the range, in words.

    Raises:
        ConfigError: an entry is not good.
    """
    if not np.all(good):
        k = int(np.argmin(good))
        raise ConfigError(f"{field}.{k}: {float(values[k])}, allowed {allowed}")


def check_rising(field: str, values: Sequence[float] | FloatArray, *, level: bool = False) -> None:
    """Refuse the first entry that is not above the one before it.

    Args:
        field: dotted name of the curve.
        values: (K,), its knots.
        level: equal to the one before is allowed too.

    Raises:
        ConfigError: such an entry, or one that is not a number.
    """
    knots = np.asarray(values, dtype=np.float64)
    steps = np.diff(knots)
    good = steps >= 0 if level else steps > 0
    if not np.all(good):
        k = int(np.argmin(good)) + 1
        raise ConfigError(
            f"{field}.{k}: {float(knots[k])}, allowed {'>=' if level else '>'} "
            f"{float(knots[k - 1])}, the entry before"
        )
