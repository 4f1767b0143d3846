"""When the plant steps in lockstep: one tick in flight, exactly the command that echoes it.

A pure state machine: time comes in as a steady clock's seconds, samples to publish come out, and
a run that cannot go on raises :class:`RunAborted` with its reason. ``real_time`` is its sibling.
"""

import math

from tractor_msgs_py import topics
from tractor_msgs_py.errors import RunAborted
from tractor_msgs_py.types import BatteryPowerCommand, CommandMode, Sample
from tractor_sim.pace import Pace, refuse_second_policy
from tractor_sim.plant_run import PlantRun

RESEND_S = 0.2
"""The present tick is published again after this long without an answer [s]."""

RANGE_TOLERANCE_W = 1e-3
"""A command that is further than this outside the feasible set is counted [W]."""


class Lockstep(Pace):
    """The plant's side of the lockstep protocol.

    A nominal answer to the present tick is applied whatever it holds, because the policy would
    only repeat it: battery power that is not finite is replaced by the fallback law, power out
    of the feasible set is projected, as in an in-process run, and both are counted. Every other
    command is refused and counted.

    A tick whose demand has still to come from a topic is published as soon as it is there; how
    long that may take is not judged here.

    Attributes:
        resends: ticks published again.
    """

    def __init__(
        self, run: PlantRun, answer_timeout_s: float, match_timeout_s: float = 0.0
    ) -> None:
        super().__init__(run, match_timeout_s)
        self.resends = 0
        self._answer_timeout_s = answer_timeout_s
        self._tick_since_s = 0.0
        self._sent_s: float | None = 0.0

    def _own_counters(self) -> dict[str, int | str]:
        return {"resends": self.resends}

    def poll(self, command_publishers: int, now_s: float) -> tuple[Sample, ...]:
        """The present tick again when it has waited for long enough, else nothing.

        Raises:
            RunAborted: no answer within the timeout, or more than one policy is connected.
        """
        refuse_second_policy(command_publishers)
        if self._sent_s is None:
            return self._send(now_s)
        if now_s - self._tick_since_s > self._answer_timeout_s:
            raise RunAborted(
                f"no answer to tick {self.run.k} (stamp {self.run.stamp_ns} ns) within "
                f"{self._answer_timeout_s:g} s: the policy died or hangs, "
                f"{command_publishers} publishers on {topics.COMMAND.name}"
            )
        if now_s - self._sent_s < RESEND_S:
            return ()
        self.resends += 1
        self._sent_s = now_s
        return self.run.samples()

    def offer(
        self, command: BatteryPowerCommand, command_publishers: int, now_s: float
    ) -> tuple[Sample, ...]:
        """A command arrived; samples of the next tick if it answered the present one.

        Raises:
            RunAborted: more than one policy is connected while the run goes on.
        """
        if self.done:  # a resent tick is answered twice, and the last one too
            return ()
        refuse_second_policy(command_publishers)
        reason = self._refusal(command)
        if reason is not None:
            self.refusals[reason] += 1
            return ()
        lb, ub = self.run.feasible_w()
        result = self.run.apply(command)
        if bool(result.refused[0]) or math.isinf(command.engine_power_w):
            self.refusals["not_finite"] += 1
        elif (
            not lb - RANGE_TOLERANCE_W
            <= command.battery_power_w
            <= max(lb, ub) + (RANGE_TOLERANCE_W)
        ):
            self.refusals["out_of_range"] += 1
        return self._send(now_s)

    def _first_tick(self, now_s: float) -> tuple[Sample, ...]:
        return self._send(now_s)

    def _send(self, now_s: float) -> tuple[Sample, ...]:
        if not self.run.ready:
            self._sent_s = None
            return ()
        self._tick_since_s = self._sent_s = now_s
        return self.run.samples()

    def _refusal(self, command: BatteryPowerCommand) -> str | None:
        if not self.started:
            return "no_tick_in_flight"
        if command.mode is not CommandMode.NOMINAL:
            return f"{command.mode.name.lower()}_mode"
        if command.stamp_ns == self.run.stamp_ns:
            return "no_tick_in_flight" if self._sent_s is None else None
        ticks, rest = divmod(command.stamp_ns - self.run.info.t0_ns, self.run.info.dt_ns)
        return "repeated_answer" if not rest and 0 <= ticks < self.run.k else "other_stamp"
