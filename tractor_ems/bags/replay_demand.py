"""When a player publishes which step of a duty cycle, and how the plant took it.

A pure state machine: time comes in as a steady clock's seconds, samples to publish come out.
In lockstep step k + 1 follows tick k. In real time step k is due a little before its tick, on a
schedule that begins with the plant's first tick and is never shifted, so nothing drifts.
"""

from tractor_msgs_py import topics
from tractor_msgs_py.errors import RunAborted
from tractor_msgs_py.trajectory import FloatArray
from tractor_msgs_py.types import DutyCycleDemand, DutyCycleInfo, PowerDemand, RunInfo

RESEND_S = 0.2
"""A demand that a waiting plant has not driven is published again after this long [s]."""

LEAD_PERIODS, LEAD_S = 0.5, 0.25
"""How far ahead of its tick a demand is published in real time, whichever is more: the plant keeps
it, so that a machine that makes the player wait for a moment costs nothing [-], [s]."""


class DemandReplay:
    """The player's side of a replay.

    Args:
        info: what was announced.
        power_demand_w: (T,), without auxiliaries [W].
        period_s: wall time of one step in real time; 0 is lockstep [s].
        match_timeout_s: how long a plant may take to subscribe, 0 for ever [s].
        plant_timeout_s: how long the plant may take over one tick, beside the step itself [s].

    Attributes:
        seen: latest tick that the plant has published; -1 before the first.
        late: demands published more than a period behind their schedule.
        worst_late_s: how far behind schedule the latest was [s].
        resent: demands published again.
        restarts: plants that began anew while the replay was under way.
    """

    def __init__(
        self,
        info: DutyCycleInfo,
        power_demand_w: FloatArray,
        period_s: float = 0.0,
        match_timeout_s: float = 0.0,
        plant_timeout_s: float = 20.0,
    ) -> None:
        self.late, self.worst_late_s, self.resent, self.restarts = 0, 0.0, 0, 0
        self._info = info
        self._power_w = power_demand_w.tolist()
        self._period_s = period_s
        self._lead_s = max(LEAD_PERIODS * period_s, LEAD_S)
        self._match_timeout_s = match_timeout_s
        self._plant_timeout_s = plant_timeout_s + max(period_s, info.dt_s)
        self._since_s: float | None = None
        self._run: RunInfo | None = None
        self._reset()

    def _reset(self) -> None:
        self.seen = -1
        self._driven, self._old, self._next = 0, 0, 0
        self._start_s: float | None = None
        self._sent_s = self._progress_s = 0.0

    @property
    def done(self) -> bool:
        """The plant has published its last tick with demand."""
        return self.seen == self._info.steps - 1

    @property
    def counters(self) -> dict[str, int | float]:
        """What people want to see.

        ``driven_old``: ticks whose demand was not that of their step. ``not_driven``: demands
        published or passed over that no tick has shown.
        """
        return {
            "published": self._next,
            "late": self.late,
            "worst_late_ms": round(1e3 * self.worst_late_s, 1),
            "resent": self.resent,
            "driven": self._driven - self._old,
            "driven_old": self._old,
            "not_driven": max(self._next, self.seen + 1) - self._driven,
            "restarts": self.restarts,
        }

    def begin(self, run: RunInfo) -> None:
        """A plant announced a run: the replay begins with each that drives this cycle."""
        info = self._info
        mine = (info.cycle_hash, info.steps, info.t0_ns, info.dt_ns)
        if (run.cycle_hash, run.steps, run.t0_ns, run.dt_ns) != mine:
            return
        if self._run is not None and run.run_id != self._run.run_id:
            self.restarts += 1
            self._reset()
        self._run = run

    def observe(self, demand: PowerDemand, now_s: float) -> None:
        """The plant published a tick; repetitions and other stamps say nothing."""
        info, run = self._info, self._run
        k, rest = divmod(demand.stamp_ns - info.t0_ns, info.dt_ns)
        if run is None or rest or not self.seen < k < info.steps:
            return
        self.seen, self._progress_s = k, now_s
        if self._start_s is None:
            self._start_s = now_s - k * self._period_s
        self._driven += 1
        self._old += demand.power_w != self._power_w[k] + run.p_aux_w

    def poll(self, subscribers: int, now_s: float) -> tuple[DutyCycleDemand, ...]:
        """Demands to publish now; ``subscribers`` are those of the demand.

        Raises:
            RunAborted: no plant within the timeout, or one that shows no new tick.
        """
        if self.done:
            return ()
        if self._start_s is None:
            return self._first(subscribers, now_s)
        if now_s - self._progress_s > self._plant_timeout_s:
            raise RunAborted(
                f"no tick {self.seen + 1} of {self._info.steps} from the plant within "
                f"{self._plant_timeout_s:g} s, {subscribers} subscribers of "
                f"{topics.DUTY_CYCLE_DEMAND.name}"
            )
        first, due = self._next, self._due(now_s)
        if due > first:
            self._sent_s, self._next = now_s, due
            self._account(first, due, now_s)
            return tuple(map(self._sample, range(first, due)))
        waiting = self._run is not None and self._run.lockstep and self.seen + 1 < self._next
        if not waiting or now_s - self._sent_s < RESEND_S:
            return ()
        return self._again(self.seen + 1, now_s)

    def _first(self, subscribers: int, now_s: float) -> tuple[DutyCycleDemand, ...]:
        """Until the first tick: step 0, again and again while somebody listens."""
        if subscribers == 0:
            self._since_s = now_s if self._since_s is None else self._since_s
            if 0.0 < self._match_timeout_s < now_s - self._since_s:
                raise RunAborted(
                    f"no subscriber of {topics.DUTY_CYCLE_DEMAND.name} within "
                    f"{self._match_timeout_s:g} s; plant_sim needs demand:=topic"
                )
            return ()
        self._since_s = None
        if self._next == 0:
            self._next, self._sent_s = 1, now_s
            return (self._sample(0),)
        return self._again(0, now_s) if now_s - self._sent_s >= RESEND_S else ()

    def _again(self, k: int, now_s: float) -> tuple[DutyCycleDemand, ...]:
        self.resent += 1
        self._sent_s = now_s
        return (self._sample(k),)

    def _sample(self, k: int) -> DutyCycleDemand:
        return DutyCycleDemand(self._info.stamp_ns(k), self._power_w[k])

    def _due(self, now_s: float) -> int:
        """How many steps should have been published by now."""
        if not self._period_s:
            return min(self.seen + 2, self._info.steps)
        assert self._start_s is not None
        passed = (now_s - self._start_s + self._lead_s) / self._period_s
        return max(self._next, min(int(passed) + 1, self._info.steps))

    def _account(self, first: int, end: int, now_s: float) -> None:
        if not self._period_s or self._start_s is None:
            return
        for k in range(first, end):
            behind_s = now_s - max(
                self._start_s, self._start_s + k * self._period_s - self._lead_s
            )
            self.late += behind_s > self._period_s
            self.worst_late_s = max(self.worst_late_s, behind_s)
