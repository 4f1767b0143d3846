"""One estimated parameter: its value, its error, and whether the recording can tell at all."""

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["identified", "bound", "announced", "not_identified"]


@dataclass(frozen=True)
class Estimate:
    """One parameter.

    Attributes:
        name: dotted, as in the vehicle's file, or of a quantity behind it.
        value: SI; None where there is none.
        error: standard error, residual correlation allowed for; None where it has no meaning.
        verdict: ``identified``; ``bound``: the true value is at least or at most this (``why``
            says which); ``announced``: the vehicle said so, nothing was measured;
            ``not_identified``.
        why: what it rests on, or what the recording lacks.
    """

    name: str
    value: float | None
    error: float | None
    verdict: Verdict
    why: str
