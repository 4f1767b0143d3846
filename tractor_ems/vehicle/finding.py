"""One finding about a vehicle, and the collector that the judges share."""

import math
from dataclasses import dataclass, field
from typing import Literal

Severity = Literal["error", "warning", "note"]
_ORDER = ("error", "warning", "note")


@dataclass(frozen=True)
class Finding:
    """One value to look at again.

    Attributes:
        severity: ``error``: the vehicle cannot work like this; ``warning``: outside what was
            measured on such machines; ``note``: good to know.
        field: the setting by its name in the file, or the figure that follows from several.
        value: what it is, SI; None where there is none.
        plausible: the range it should be in.
        why: where the range comes from, and what a value outside of it leads to.
    """

    severity: Severity
    field: str
    value: float | None
    plausible: str
    why: str


@dataclass
class Judge:
    """Collects findings; every method adds one where its claim does not hold."""

    findings: list[Finding] = field(default_factory=list)

    def say(
        self, severity: Severity, name: str, value: float | None, plausible: str, why: str
    ) -> None:
        """Add a finding."""
        number = None if value is None or not math.isfinite(value) else float(value)
        self.findings.append(Finding(severity, name, number, plausible, why))

    def between(
        self,
        severity: Severity,
        name: str,
        value: float | None,
        allowed: tuple[float, float],
        why: str,
        absent: str = "",
    ) -> None:
        """Claim that ``value`` lies in a closed range; None is a note saying ``absent``."""
        text = f"{allowed[0]:g}..{allowed[1]:g}"
        if value is None:
            self.say("note", name, None, text, absent)
        elif not allowed[0] <= value <= allowed[1]:
            self.say(severity, name, value, text, why)

    def at_most(
        self, severity: Severity, name: str, value: float | None, most: float, why: str
    ) -> None:
        """Claim that ``value`` is at most ``most``."""
        if value is not None and not value <= most:
            self.say(severity, name, value, f"<= {most:g}", why)

    def worst_first(self) -> tuple[Finding, ...]:
        """Errors, warnings, notes; within each in the order of judging."""
        return tuple(sorted(self.findings, key=lambda f: _ORDER.index(f.severity)))
