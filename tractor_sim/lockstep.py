"""When the plant steps in lockstep: one tick in flight, exactly the command that echoes it.

A pure state machine: time comes in as a steady clock's seconds, samples to publish come out, and
a run that cannot go on raises :class:`RunAborted` with its reason. ``real_time`` is its sibling.
"""

import math
from collections import Counter
from dataclasses import dataclass

from tractor_msgs_py import topics
from tractor_msgs_py.errors import RunAborted
from tractor_msgs_py.types import BatteryPowerCommand, CommandMode, Sample
from tractor_sim.plant_run import PlantRun

RESEND_S = 0.2
"""The present tick is published again after this long without an answer [s]."""

RANGE_TOLERANCE_W = 1e-3
"""A command that is further than this outside the feasible set is counted [W]."""


@dataclass(frozen=True)
class Peers:
    """Who is connected, as the plant's own publishers and subscription see it.

    Attributes:
        command_publishers: policies on the command topic.
        observation_subscribers: subscribers of the observation topic that has the fewest.
        run_info_delivered: every expected subscriber has acknowledged run_info, so no tick can
            overtake it.
    """

    command_publishers: int
    observation_subscribers: int
    run_info_delivered: bool


class StartGate:
    """Holds the first tick until one policy and the expected recorders are connected.

    ``match_timeout_s`` of 0 waits for ever. ``missing`` says for whom it waits.
    """

    def __init__(self, expected_recorders: int, match_timeout_s: float) -> None:
        self.missing = ""
        self._needed = 1 + expected_recorders
        self._timeout_s = match_timeout_s
        self._since_s: float | None = None

    def open(self, peers: Peers, now_s: float) -> bool:
        """True once the run may start.

        Raises:
            RunAborted: nobody came within the timeout, or more than one policy did.
        """
        refuse_second_policy(peers.command_publishers)
        enough = peers.observation_subscribers >= self._needed
        if peers.command_publishers == 1 and enough and peers.run_info_delivered:
            self.missing = ""
            return True
        self.missing = (
            f"{peers.command_publishers} of 1 publishers on {topics.COMMAND.name}, "
            f"{peers.observation_subscribers} of {self._needed} subscribers of the observation, "
            f"{topics.RUN_INFO.name} {'' if peers.run_info_delivered else 'not '}delivered"
        )
        self._since_s = now_s if self._since_s is None else self._since_s
        if 0.0 < self._timeout_s < now_s - self._since_s:
            raise RunAborted(f"not started within {self._timeout_s:g} s: {self.missing}")
        return False


def refuse_second_policy(command_publishers: int) -> None:
    """Raise RunAborted where more than one policy could answer."""
    if command_publishers > 1:
        raise RunAborted(f"{command_publishers} publishers on {topics.COMMAND.name}, allowed 1")


class Lockstep:
    """The plant's side of the lockstep protocol.

    A nominal answer to the present tick is applied whatever it holds, because the policy would
    only repeat it: battery power that is not finite is replaced by the fallback law, power out
    of the feasible set is projected, as in an in-process run, and both are counted. Every other
    command is refused and counted.

    Attributes:
        gate: holds the start.
        refusals: commands by what was wrong with them.
        resends: ticks published again.
    """

    def __init__(
        self, run: PlantRun, answer_timeout_s: float, match_timeout_s: float = 0.0
    ) -> None:
        self.run = run
        self.refusals: Counter[str] = Counter()
        self.resends = 0
        self.started = False
        self.gate = StartGate(run.info.expected_recorders, match_timeout_s)
        self._answer_timeout_s = answer_timeout_s
        self._tick_since_s = 0.0
        self._sent_s = 0.0

    @property
    def done(self) -> bool:
        """True after the last step."""
        return self.run.done

    @property
    def counters(self) -> dict[str, int]:
        """What people want to see: resends and refusals by reason."""
        return {"resends": self.resends, **named(self.refusals)}

    def start(self, peers: Peers, now_s: float) -> tuple[Sample, ...]:
        """The first tick once everyone is connected, nothing before.

        Raises:
            RunAborted: nobody came within the timeout, or more than one policy did.
        """
        if not self.gate.open(peers, now_s):
            return ()
        self.started = True
        return self._send(now_s)

    def poll(self, command_publishers: int, now_s: float) -> tuple[Sample, ...]:
        """The present tick again when it has waited for long enough, else nothing.

        Raises:
            RunAborted: no answer within the timeout, or more than one policy is connected.
        """
        refuse_second_policy(command_publishers)
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
            RunAborted: more than one policy is connected.
        """
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

    def _send(self, now_s: float) -> tuple[Sample, ...]:
        self._tick_since_s = self._sent_s = now_s
        return self.run.samples()

    def _refusal(self, command: BatteryPowerCommand) -> str | None:
        if not self.started:
            return "no_tick_in_flight"
        if command.mode is not CommandMode.NOMINAL:
            return f"{command.mode.name.lower()}_mode"
        if command.stamp_ns == self.run.stamp_ns and not self.done:
            return None
        ticks, rest = divmod(command.stamp_ns - self.run.info.t0_ns, self.run.info.dt_ns)
        return "repeated_answer" if not rest and 0 <= ticks < self.run.k else "other_stamp"


def named(refusals: Counter[str]) -> dict[str, int]:
    """Refusals by reason, as counters for people."""
    return {f"refused_{reason}": count for reason, count in sorted(refusals.items())}
