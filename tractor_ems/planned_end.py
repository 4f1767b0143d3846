"""The end of the work as an operator plans it: a countdown in stamps. Pure.

A run that announces its length needs none of this; a vehicle announces nothing, and only its
operator knows when the work is done.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from tractor_msgs_py.observation import Observation

HOLD_S = 60.0
"""Time left that a policy is told once the planned end has passed: it then keeps SOC at the target
as if the work ended in so long, again and again [s].

Stochastic DP on eight operations of `field`, half an hour past the end: |SOC error| p95 0.22 with
a single step left, for which it never starts an engine; 0.030 with 30 s, 0.040 with 60 s, 0.067
with 120 s, 0.14 with 300 s, at 11, 8, 6 and 4 engine starts an hour.
"""


@dataclass(frozen=True, slots=True)
class PlannedEnd:
    """A countdown.

    Attributes:
        work_s: planned, counted from the first observation; 0: as the run says [s].
        left_ns: of it, >= 0 [ns].
        stamp_ns: of the observation that it was counted at; 0 before the first, and after the
            vehicle's clock was set back.
    """

    work_s: float = 0.0
    left_ns: int = 0
    stamp_ns: int = 0

    @property
    def passed(self) -> bool:
        """True where there was an end and it is over."""
        return self.work_s > 0.0 and self.left_ns == 0


def planned(work_s: float) -> PlannedEnd:
    """A countdown that begins at the next observation; 0, or what is no time, for none."""
    if not (math.isfinite(work_s) and work_s > 0.0):
        return PlannedEnd()
    return PlannedEnd(work_s, round(work_s * 1e9))


def counted(plan: PlannedEnd, observation: Observation) -> tuple[PlannedEnd, Observation]:
    """The countdown at an observation, and the observation with the time left that it says.

    Without a plan both are returned as they are. Stamps that go back take nothing off.
    """
    if not plan.work_s:
        return plan, observation
    since_ns = max(observation.stamp_ns - plan.stamp_ns, 0) if plan.stamp_ns else 0
    plan = replace(plan, left_ns=max(plan.left_ns - since_ns, 0), stamp_ns=observation.stamp_ns)
    left_s = HOLD_S if plan.passed else plan.left_ns / 1e9
    return plan, replace(observation, time_left_s=np.full(1, left_s))


def paused(plan: PlannedEnd) -> PlannedEnd:
    """The vehicle's clock was set back: go on from the next observation's stamp."""
    return replace(plan, stamp_ns=0)
