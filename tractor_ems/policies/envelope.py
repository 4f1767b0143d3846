"""What a policy has seen in training, and whether an observation lies outside it.

numpy only: a node asks at every tick. Stored in a policy file as ``metadata["envelope"]``.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

from tractor_msgs_py.errors import PolicyError
from tractor_msgs_py.observation import (
    Observation,
    ObservationSpec,
    init_filters,
    update_filters,
)
from tractor_msgs_py.trajectory import FloatArray

Envelope: TypeAlias = Mapping[str, Sequence[float]]
"""Signal to the least and the most seen: ``power_demand_w``, ``feature0`` and so on in the order
of the spec's filters [W], and ``soc`` [fraction] where training drew it from a range."""

MARGIN = 0.01
"""Part of its range by which a signal may lie outside: readings are rounded."""


def envelope_of(
    spec: ObservationSpec,
    demand_traces: Sequence[FloatArray],
    dt_s: float,
    soc: tuple[float, float] | None = None,
) -> dict[str, list[float]]:
    """The least and most of everything that a policy saw in training, as plain data.

    Args:
        spec: whose filters it sees.
        demand_traces: demand at the bus of each run, auxiliaries included, (T,) each [W].
        dt_s: step length of the traces [s].
        soc: least and most SOC it was trained at, 0..1; None: not known, so never outside.

    A time left beyond what was trained is no matter: policies take it as the farthest they know.

    Raises:
        PolicyError: no trace, an empty one, or a value that is not finite.
    """
    traces = [np.asarray(trace, dtype=float) for trace in demand_traces]
    if not traces or not all(trace.size and np.isfinite(trace).all() for trace in traces):
        raise PolicyError("envelope: demand traces must be finite, and not empty")
    # All runs side by side, the shorter ones with NaN behind: the filters are slow one by one.
    longest = max(trace.size for trace in traces)
    demand_w = np.full((len(traces), longest), np.nan)
    for row, trace in zip(demand_w, traces, strict=True):
        row[: trace.size] = trace
    least = np.full((len(traces), 1 + len(spec.filters)), np.inf)
    most = -least
    state = init_filters(spec, len(traces))
    for k in range(longest):
        state = update_filters(spec, state, demand_w[:, k], dt_s)
        now = np.column_stack((demand_w[:, k], state.values_w))
        least, most = np.fmin(least, now), np.fmax(most, now)
    names = ("power_demand_w", *(f"feature{column}" for column in range(len(spec.filters))))
    ranges = zip(least.min(axis=0).tolist(), most.max(axis=0).tolist(), strict=True)
    found = {name: list(pair) for name, pair in zip(names, ranges, strict=True)}
    return found if soc is None else {**found, "soc": [float(soc[0]), float(soc[1])]}


def stored_envelope(metadata: Mapping[str, Any]) -> dict[str, tuple[float, float]] | None:
    """The envelope in a policy's metadata; None where the file is too old to have one.

    Raises:
        PolicyError: it is damaged.
    """
    stored = metadata.get("envelope")
    if stored is None:
        return None
    try:
        envelope = {
            str(name): (float(least), float(most)) for name, (least, most) in stored.items()
        }
    except (AttributeError, TypeError, ValueError):
        raise PolicyError("envelope: expected the least and most of each signal") from None
    for name, (least, most) in envelope.items():
        if not (math.isfinite(least) and math.isfinite(most) and least <= most):
            raise PolicyError(f"envelope: {name}: {least}..{most}, expected finite and ascending")
    return envelope


def outside(envelope: Envelope, observation: Observation) -> tuple[str, ...]:
    """What of an observation lies outside, for a batch in any of its runs.

    Returns:
        One text per signal: name, value, and the range seen in training. The name ends at the
        first colon. Empty where everything lies inside.
    """
    found = []
    for name, (least, most) in envelope.items():
        values = _values(observation, name)
        margin = MARGIN * (most - least)
        within = (values >= least - margin) & (values <= most + margin)  # False for NaN
        if not within.all():
            value = float(values[~within][0])
            found.append(f"{name}: {value:.6g}, training saw {least:.6g}..{most:.6g}")
    return tuple(found)


def _values(observation: Observation, name: str) -> FloatArray:
    """A signal of the envelope, (B,); empty where this observation has none of that name."""
    if name == "power_demand_w":
        return observation.power_demand_w
    if name == "soc":
        return observation.soc
    column = name.removeprefix("feature")
    if column.isdigit() and int(column) < observation.features.shape[1]:
        values: FloatArray = observation.features[:, int(column)]
        return values
    return np.empty(0)
