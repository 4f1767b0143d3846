"""A recorded demand at any rate, with holes and slips, to a duty cycle at equal steps.

A sample is held until the next one, as a duty cycle holds its own; a step's demand is the mean
over the step. So energy is kept whichever way the rate changes, and what had to be dropped or
filled is counted.
"""

from bisect import bisect_left
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from tractor_msgs_py.errors import CycleError
from tractor_msgs_py.trajectory import BoolArray, FloatArray, IntArray
from tractor_sim.duty_cycle.cycle import DEMAND_LIMIT_W
from tractor_sim.duty_cycle.cycle_csv import quoted

GAP = 1.5
"""An interval longer than this many usual ones is a gap: at least one sample is missing."""

MAX_STEPS = 10_000_000
"""Of one imported cycle; more is a wrong clock or a wrong unit of time."""


@dataclass(frozen=True)
class ImportSettings:
    """How a recording is cleaned.

    Attributes:
        dt_s: step of the result, 0 < dt_s <= 60 [s].
        max_gap_s: longest gap that is filled by a straight line [s].
        max_power_w: larger demand, either way, is absurd and dropped; at most what a cycle file
            may hold [W].
        max_dropped: greatest share of rows that may be dropped, 0..1.
        split: cut at longer gaps instead of refusing them.
        aux_w: auxiliary power that is known to be in the demand; None: what the recording
            announces, if it does [W].
    """

    dt_s: float = 1.0
    max_gap_s: float = 10.0
    max_power_w: float = DEMAND_LIMIT_W
    max_dropped: float = 0.1
    split: bool = False
    aux_w: float | None = None

    def __post_init__(self) -> None:
        ranges = {
            "dt_s": (0 < self.dt_s <= 60, "0 < dt_s <= 60"),
            "max_gap_s": (0 <= self.max_gap_s <= 3600, "0..3600"),
            "max_power_w": (
                0 < self.max_power_w <= DEMAND_LIMIT_W,
                f"above 0, at most {DEMAND_LIMIT_W:.0f}",
            ),
            "max_dropped": (0 <= self.max_dropped <= 1, "0..1"),
            "aux_w": (
                self.aux_w is None or 0 <= self.aux_w <= DEMAND_LIMIT_W,
                f"0..{DEMAND_LIMIT_W:.0f}",
            ),
        }
        for name, (fits, allowed) in ranges.items():
            if not fits:  # not so for NaN either
                raise CycleError(f"{name}: {getattr(self, name)}, allowed {allowed}")


@dataclass(frozen=True)
class Samples:
    """What a file holds, before any judgement.

    Attributes:
        source: file or bag, for messages.
        place: what a row is called in messages and which it is, shape (N,): a line of a CSV file,
            a message of a bag.
        time_s: NaN where it is no number, shape (N,) [s].
        power_demand_w: NaN where it is no number, less what of auxiliaries was removed, shape
            (N,) [W].
        place_name: "line" or "message".
        cells: both columns as the file has them, for messages; empty where it is no text.
        refused: per row why its reader refuses it, empty where it does not; empty: refuses none.
        auxiliaries: what is known of the auxiliaries in the demand, and what was done.
        auxiliaries_removed_w: constant that was subtracted [W].
    """

    source: str
    place: IntArray
    time_s: FloatArray
    power_demand_w: FloatArray
    place_name: str = "line"
    cells: Sequence[tuple[str, str]] = ()
    refused: Sequence[str] = ()
    auxiliaries: str = ""
    auxiliaries_removed_w: float = 0.0


@dataclass(frozen=True)
class Account:
    """What an import did with the rows.

    Attributes:
        rows_read: all of them: kept, dropped and refused.
        rows_kept: those the result is made of.
        dropped_not_a_number, dropped_absurd_power, dropped_duplicate_time,
        dropped_time_backwards: rows left out, each under its first fault.
        first_dropped: place and fault of the first of them; empty if none.
        refused: rows that the reader of a bag refuses for anything else, by reason.
        usual_step_s: median interval of the kept rows [s].
        gaps_filled, gap_filled_s, longest_gap_s: gaps up to the limit, the time added in them, and
            the longest gap that was filled [s].
        gaps_cut: longer gaps, at which the recording was cut into pieces.
        tail_dropped_s: less than a step at the ends of the pieces, and pieces of less than two
            steps, which make no cycle [s].
        energy_before_j: of the kept rows, each held for its step [J].
        energy_filled_j: of what was put into gaps [J].
        energy_after_j: of the result; the sum of both less the tails [J].
        duration_s, steps: of the result, all pieces together.
        auxiliaries, auxiliaries_removed_w: as in ``Samples``.
    """

    rows_read: int
    rows_kept: int
    dropped_not_a_number: int
    dropped_absurd_power: int
    dropped_duplicate_time: int
    dropped_time_backwards: int
    first_dropped: str
    refused: dict[str, int]
    usual_step_s: float
    gaps_filled: int
    gap_filled_s: float
    longest_gap_s: float
    gaps_cut: int
    tail_dropped_s: float
    energy_before_j: float
    energy_filled_j: float
    energy_after_j: float
    duration_s: float
    steps: int
    auxiliaries: str
    auxiliaries_removed_w: float

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)


def resample(samples: Samples, settings: ImportSettings) -> tuple[list[FloatArray], Account]:
    """Demand at equal steps, one array per piece, and the account of what was done.

    Raises:
        CycleError: fewer than two usable rows, too many unusable ones, a gap longer than allowed,
            less than two steps of time, or more steps than any work has; the message names the
            file, the row and the value.
    """
    fault, kept = _usable(samples, settings)
    time_s = samples.time_s[kept] - samples.time_s[kept[0]]
    power_w = samples.power_demand_w[kept]
    usual_s, gap, too_long = _gaps(samples, settings, kept, time_s)
    pieces, tails_s, longest_s = [], 0.0, 0.0
    before_j, filled_j, filled_s = 0.0, 0.0, 0.0
    edges = [0, *(np.flatnonzero(too_long) + 1).tolist(), len(time_s)]
    for start, stop in pairwise(edges):
        t, p, made = _filled(time_s[start:stop], power_w[start:stop], usual_s)
        hold_s = np.append(np.diff(t), usual_s)
        before_j += float(np.sum((p * hold_s)[~made]))
        filled_j += float(np.sum((p * hold_s)[made]))
        filled_s += float(np.sum(hold_s[made]))
        demand_w, tail_s = _means(t - t[0], p, hold_s, settings.dt_s)
        longest_s = max(longest_s, float(hold_s.sum()))
        if len(demand_w) >= 2:
            pieces.append(demand_w)
            tails_s += tail_s
        else:
            tails_s += tail_s + len(demand_w) * settings.dt_s
    if not pieces:
        raise CycleError(
            f"{samples.source}: {samples.place_name} {samples.place[kept[-1]]}: ends after "
            f"{longest_s:.6g} s, less than the two steps of {settings.dt_s:g} s that a cycle needs"
        )
    steps = sum(map(len, pieces))
    short = gap & ~too_long
    return pieces, Account(
        rows_read=len(samples.time_s),
        rows_kept=len(kept),
        dropped_not_a_number=int(np.sum(fault == 1)),
        dropped_absurd_power=int(np.sum(fault == 2)),
        dropped_duplicate_time=int(np.sum(fault == 3)),
        dropped_time_backwards=int(np.sum(fault == 4)),
        first_dropped=_first_dropped(samples, fault),
        refused=dict(sorted(Counter(filter(None, samples.refused)).items())),
        usual_step_s=usual_s,
        gaps_filled=int(short.sum()),
        gap_filled_s=filled_s,
        longest_gap_s=float(np.diff(time_s)[short].max(initial=0.0)),
        gaps_cut=int(too_long.sum()),
        tail_dropped_s=tails_s,
        energy_before_j=before_j,
        energy_filled_j=filled_j,
        energy_after_j=float(sum(piece.sum() for piece in pieces) * settings.dt_s),
        duration_s=steps * settings.dt_s,
        steps=steps,
        auxiliaries=samples.auxiliaries,
        auxiliaries_removed_w=samples.auxiliaries_removed_w,
    )


def _usable(samples: Samples, settings: ImportSettings) -> tuple[IntArray, IntArray]:
    """Per row 0 or its fault, and the rows without one; refuses what is mostly faults."""
    fault = _faults(samples, settings)
    kept = np.flatnonzero(fault == 0)
    first = _first_dropped(samples, fault)
    total = len(samples.time_s)
    if len(kept) < 2:
        raise CycleError(
            f"{_where(samples, kept)}: {len(kept)} usable rows of {total}, at least 2 are needed "
            f"to know the step{f' ({first})' if first else ''}"
        )
    # A row said twice, as a plant does that waits for its answer, takes nothing away.
    again = np.flatnonzero(fault == 3)
    same = kept[np.searchsorted(samples.time_s[kept], samples.time_s[again])]
    repeats = int(np.sum(samples.power_demand_w[again] == samples.power_demand_w[same]))
    lost = total - len(kept) - repeats
    if lost > settings.max_dropped * total:
        raise CycleError(
            f"{samples.source}: {lost} of {total} rows are unusable, allowed "
            f"{settings.max_dropped:.0%} (--max-dropped; first: {first})"
        )
    return fault, kept


def _where(samples: Samples, kept: IntArray) -> str:
    """The file, and of a single usable row its place."""
    if len(kept) != 1:
        return samples.source
    return f"{samples.source}: {samples.place_name} {samples.place[kept[0]]}"


def _gaps(
    samples: Samples, settings: ImportSettings, kept: IntArray, time_s: FloatArray
) -> tuple[float, BoolArray, BoolArray]:
    """The usual interval, which intervals are gaps, and which of these too long to fill."""
    interval_s = np.diff(time_s)
    usual_s = float(np.median(interval_s))
    gap = interval_s > GAP * usual_s
    too_long = gap & (interval_s > settings.max_gap_s)
    if too_long.any() and not settings.split:
        k = int(np.flatnonzero(too_long)[0])
        raise CycleError(
            f"{samples.source}: {samples.place_name} {samples.place[kept[k + 1]]}: gap of "
            f"{interval_s[k]:.6g} s at {time_s[k]:.6g} s, filled are gaps up to "
            f"{settings.max_gap_s:g} s (--max-gap-s; --split-gaps cuts the recording there)"
        )
    lasts_s = float(interval_s[~too_long].sum())
    if lasts_s > MAX_STEPS * min(settings.dt_s, usual_s):
        raise CycleError(
            f"{samples.source}: lasts {lasts_s:.6g} s, allowed are {MAX_STEPS} steps of "
            f"{settings.dt_s:g} s, and as many of its own {usual_s:.3g} s"
        )
    return usual_s, gap, too_long


_FAULTS = ("", "not a number", "absurd power", "time given before", "time runs backwards")
_REFUSED = len(_FAULTS)
"""Fault of a row that its reader refuses for a reason of its own."""


def _faults(samples: Samples, settings: ImportSettings) -> IntArray:
    """Per row 0, which of ``_FAULTS`` it has, or ``_REFUSED``.

    Of times that do not all rise, the most rows that do are kept: one wild stamp costs one row,
    not all that follow it.
    """
    time_s, power_w = samples.time_s, samples.power_demand_w
    fault = np.zeros(len(time_s), dtype=np.int64)
    if samples.refused:
        fault[[bool(reason) for reason in samples.refused]] = _REFUSED
    fault[(fault == 0) & ~(np.isfinite(time_s) & np.isfinite(power_w))] = 1
    fault[(fault == 0) & (np.abs(power_w) > settings.max_power_w)] = 2
    usable = np.flatnonzero(fault == 0)
    rising = _longest_rising(time_s[usable])
    left_out = usable[~rising]
    known = np.isin(time_s[left_out], time_s[usable[rising]])
    fault[left_out] = np.where(known, 3, 4)
    return fault


def _longest_rising(values: FloatArray) -> BoolArray:
    """Mask of a longest strictly rising subsequence.

    Where it is as long, the one of values above all before them: what comes late is dropped.
    """
    greedy = np.ones(len(values), dtype=bool)
    greedy[1:] = values[1:] > np.maximum.accumulate(values)[:-1]
    if greedy.all():
        return greedy
    lowest_end: list[float] = []
    row_of_end: list[int] = []
    before = np.full(len(values), -1, dtype=np.int64)
    for row, value in enumerate(values.tolist()):
        length = bisect_left(lowest_end, value)
        before[row] = row_of_end[length - 1] if length else -1
        lowest_end[length : length + 1] = [value]
        row_of_end[length : length + 1] = [row]
    if len(lowest_end) == greedy.sum():
        return greedy
    mask = np.zeros(len(values), dtype=bool)
    row = row_of_end[-1]
    while row >= 0:
        mask[row] = True
        row = int(before[row])
    return mask


def _first_dropped(samples: Samples, fault: IntArray) -> str:
    dropped = np.flatnonzero(fault)
    if not len(dropped):
        return ""
    k = dropped[0]
    why = samples.refused[k] if fault[k] == _REFUSED else _FAULTS[fault[k]]
    shown = [f"{samples.time_s[k]:.9g}", f"{samples.power_demand_w[k]:.6g}"]
    if samples.cells and fault[k] == 1:
        values = (samples.time_s[k], samples.power_demand_w[k])
        for column, value in enumerate(values):
            if not np.isfinite(value):
                shown[column] = quoted(samples.cells[k][column])
    return (
        f"{samples.place_name} {samples.place[k]}: {why}, "
        f"time_s {shown[0]}, power_demand_w {shown[1]}"
    )


def _filled(
    time_s: FloatArray, power_w: FloatArray, usual_s: float
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Samples with those that gaps lack put in, on straight lines, and which these are."""
    interval_s = np.diff(time_s)
    gaps = np.flatnonzero(interval_s > GAP * usual_s)
    counts = np.rint(interval_s[gaps] / usual_s).astype(np.int64) - 1
    at = np.repeat(gaps, counts)
    which = np.concatenate([np.arange(1, n + 1) for n in counts] or [np.zeros(0, np.int64)])
    share = which / np.repeat(counts + 1, counts)
    new_s = time_s[at] + share * interval_s[at]
    new_w = power_w[at] + share * (power_w[at + 1] - power_w[at])
    made = np.zeros(len(time_s), dtype=bool)
    return (
        np.insert(time_s, at + 1, new_s),
        np.insert(power_w, at + 1, new_w),
        np.insert(made, at + 1, True),
    )


def _means(
    time_s: FloatArray, power_w: FloatArray, hold_s: FloatArray, dt_s: float
) -> tuple[FloatArray, float]:
    """Mean of the held samples over whole steps, shape (steps,), and the time left over."""
    end_s = np.append(time_s, time_s[-1] + hold_s[-1])
    energy_j = np.concatenate(([0.0], np.cumsum(power_w * hold_s)))
    steps = int(end_s[-1] / dt_s + 1e-6)
    if steps == len(power_w) and np.allclose(time_s, dt_s * np.arange(steps), rtol=0, atol=1e-6):
        return power_w.copy(), 0.0  # already at the step: the same to the bit
    edge_s = np.minimum(dt_s * np.arange(steps + 1), end_s[-1])
    # To the milliwatt: what is below it is rounding of the sum.
    demand_w = np.round(np.diff(np.interp(edge_s, end_s, energy_j)) / dt_s, 3) + 0.0
    return demand_w, max(0.0, float(end_s[-1]) - steps * dt_s)
