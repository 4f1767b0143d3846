"""For how long observations have been outside what a policy was trained on. Pure.

Its hysteresis is a bucket: time outside fills it, time inside empties it. Full, the policy is
away from what it knows; empty, it is back.
"""

from dataclasses import dataclass, replace

from tractor_ems.policies.envelope import Envelope, outside
from tractor_msgs_py.observation import Observation

OUTSIDE_S = 10.0
"""How long outside is away, unless told otherwise [s]."""


@dataclass(frozen=True, slots=True)
class EnvelopeState:
    """Where the watch is.

    Attributes:
        outside: what lies outside at the newest observation, a text per signal.
        last: the same of the newest observation that was outside.
        outside_s: the bucket, 0 to the limit [s].
        away: the bucket was full, and has not been empty since.
    """

    outside: tuple[str, ...] = ()
    last: tuple[str, ...] = ()
    outside_s: float = 0.0
    away: bool = False

    @property
    def suspect(self) -> bool:
        """True from an observation outside until as much time has passed inside."""
        return bool(self.outside) or self.outside_s > 0.0

    @property
    def text(self) -> str:
        """What lies outside, or did last, in one line."""
        return "; ".join(self.outside or self.last)


def watched(
    envelope: Envelope,
    limit_s: float,
    state: EnvelopeState,
    observation: Observation,
    dt_s: float,
) -> EnvelopeState:
    """The state after an observation.

    Args:
        envelope: what training saw.
        limit_s: how long outside is away, >= 0; 0: at once, and back at once [s].
        state: before it.
        observation: of batch one.
        dt_s: time between observations, > 0 [s].
    """
    found = outside(envelope, observation)
    if found:
        filled_s = min(state.outside_s + dt_s, limit_s)
        full = filled_s >= limit_s
        return EnvelopeState(found, found, filled_s, state.away or full)
    filled_s = max(min(state.outside_s, limit_s) - dt_s, 0.0)
    return replace(state, outside=(), outside_s=filled_s, away=state.away and filled_s > 0.0)


def signals_of(texts: tuple[str, ...]) -> tuple[str, ...]:
    """Names of the signals that texts of :func:`outside` are about."""
    return tuple(text.split(":")[0] for text in texts)
