"""Demand that reaches the plant over a topic while it runs: what is taken, and when it fails.

Pure; the run keeps the demand, ``lockstep`` waits for it, in real time the newest is held. Either
way a run whose demand stays away ends: its result would be that of no cycle at all.
"""

import math

from tractor_msgs_py import topics
from tractor_msgs_py.errors import RunAborted
from tractor_msgs_py.types import DutyCycleDemand, DutyCycleInfo
from tractor_sim.duty_cycle.cycle import POWER_LIMIT_W
from tractor_sim.plant_run import PlantRun

GONE_S = 5.0
"""A player that announced a cycle is looked for at least this long until it counts as gone [s]."""


class TopicDemand:
    """Hands a player's demand to a run and watches that it goes on.

    Args:
        run: prepared from ``announced``.
        announced: what the player is about to publish.
        timeout_s: how long the demand of one tick may be missing, wall clock [s].
    """

    def __init__(self, run: PlantRun, announced: DutyCycleInfo, timeout_s: float) -> None:
        self._run = run
        self._announced = announced
        self._timeout_s = timeout_s
        self._there_s: float | None = None

    def announce(self, info: DutyCycleInfo) -> None:
        """Another announcement arrived; a repetition says nothing new.

        Raises:
            RunAborted: it is of another replay, and the run under way has lost its own.
        """
        if info != self._announced and not self._run.done:
            raise RunAborted(
                f"{topics.DUTY_CYCLE_INFO.name}: another replay was announced, of {info.cycle} "
                f"(at tick {self._run.k} of {self._announced.cycle}); start the plant again"
            )

    def offer(self, demand: DutyCycleDemand) -> None:
        """Demand arrived; what is of no step of this cycle, or no power, is counted alone."""
        info = self._announced
        k, rest = divmod(demand.stamp_ns - info.t0_ns, info.dt_ns)
        if rest or not 0 <= k < info.steps:
            self._run.demand_counters["demand_other_stamp"] += 1
        elif not math.isfinite(demand.power_w) or abs(demand.power_w) > POWER_LIMIT_W:
            self._run.demand_counters["demand_out_of_range"] += 1
        else:
            self._run.take_demand(k, demand.power_w)

    def check(self, publishers: int, driving: bool, now_s: float) -> None:
        """Look whether the run can go on; ``driving``: its first tick is out.

        Raises:
            RunAborted: more than one player is connected, the demand of the present tick is
                missing for longer than the timeout, or the player went before the first.
        """
        name = topics.DUTY_CYCLE_DEMAND.name
        run = self._run
        if run.done:
            return
        if publishers > 1:
            raise RunAborted(f"{publishers} publishers on {name}, allowed 1")
        missing = run.held or not run.ready
        timeout_s = self._timeout_s
        if not driving:  # a policy is waited for, together with the player
            missing, timeout_s = missing and publishers == 0, max(timeout_s, GONE_S)
        if not missing or self._there_s is None:
            self._there_s = now_s
        elif now_s - self._there_s > timeout_s:
            raise RunAborted(
                f"no {name} of tick {run.k} (stamp {run.stamp_ns} ns), none in time for "
                f"{timeout_s:g} s: the player ended, hangs or lags, "
                f"{publishers} publishers on {name}"
            )
