"""What the two paces of the plant share: who must be connected, and the first tick.

Pure; ``lockstep`` and ``real_time`` add when a step is taken and with which command.
"""

import math
from abc import ABC, abstractmethod
from collections import Counter
from dataclasses import dataclass

from tractor_msgs_py import topics
from tractor_msgs_py.errors import RunAborted
from tractor_msgs_py.types import BatteryPowerCommand, Sample
from tractor_sim.plant_run import PlantRun

PARTIAL_S = 3.0
"""How long a policy that hears the demand may take to subscribe the rest, if it wants it [s]."""


@dataclass(frozen=True)
class Peers:
    """Who is connected, as the plant's own publishers and subscription see it.

    Attributes:
        command_publishers: policies on the command topic.
        observation_subscribers: subscribers of the observation topic that has the fewest.
        run_info_delivered: every expected subscriber has acknowledged run_info, so no tick can
            overtake it.
        demand_subscribers: subscribers of the power demand alone; 0 while run_info is on its way
            to all.
        demand_ready: the demand of the first tick is there; False while a player is awaited.
    """

    command_publishers: int
    observation_subscribers: int
    run_info_delivered: bool
    demand_subscribers: int = 0
    demand_ready: bool = True


class StartGate:
    """Holds the first tick until one policy and the expected recorders are connected.

    A policy may do without some topics: when only the demand is subscribed by all for
    :data:`PARTIAL_S`, the run starts, and unanswered ticks are repeated anyway.

    ``match_timeout_s`` of 0 waits for ever. ``missing`` says for whom it waits.
    """

    def __init__(self, expected_recorders: int, match_timeout_s: float) -> None:
        self.missing = ""
        self._needed = 1 + expected_recorders
        self._timeout_s = match_timeout_s
        self._since_s: float | None = None
        self._partial_since_s: float | None = None

    def open(self, peers: Peers, now_s: float) -> bool:
        """True once the run may start.

        Raises:
            RunAborted: nobody came within the timeout, or more than one policy did.
        """
        refuse_second_policy(peers.command_publishers)
        enough = peers.observation_subscribers >= self._needed and peers.run_info_delivered
        matched = peers.command_publishers == 1 and (enough or self._partial(peers, now_s))
        if matched and peers.demand_ready:
            self.missing = ""
            return True
        self.missing = (
            f"{peers.command_publishers} of 1 publishers on {topics.COMMAND.name}, "
            f"{peers.observation_subscribers} of {self._needed} subscribers of the observation, "
            f"{topics.RUN_INFO.name} {'' if peers.run_info_delivered else 'not '}delivered"
            f"{'' if peers.demand_ready else f', no {topics.DUTY_CYCLE_DEMAND.name}'}"
        )
        self._since_s = now_s if self._since_s is None else self._since_s
        if 0.0 < self._timeout_s < now_s - self._since_s:
            raise RunAborted(f"not started within {self._timeout_s:g} s: {self.missing}")
        return False

    def _partial(self, peers: Peers, now_s: float) -> bool:
        if peers.demand_subscribers < self._needed:
            self._partial_since_s = None
            return False
        if self._partial_since_s is None:
            self._partial_since_s = now_s
        return now_s - self._partial_since_s >= PARTIAL_S


def refuse_second_policy(command_publishers: int) -> None:
    """Raise RunAborted where more than one policy could answer."""
    if command_publishers > 1:
        raise RunAborted(f"{command_publishers} publishers on {topics.COMMAND.name}, allowed 1")


class Pace(ABC):
    """The plant's side of a run: samples to publish come out of every call.

    Attributes:
        run: the run that is driven.
        gate: holds the start.
        started: True once the first tick is out.
        refusals: commands by what was wrong with them.
    """

    def __init__(self, run: PlantRun, match_timeout_s: float) -> None:
        self.run = run
        self.gate = StartGate(run.info.expected_recorders, match_timeout_s)
        self.started = False
        self.refusals: Counter[str] = Counter()

    @property
    def done(self) -> bool:
        """True after the last step."""
        return self.run.done

    @property
    def state(self) -> str:
        """What it is doing, for people."""
        return f"waiting: {self.gate.missing}" if self.gate.missing else "driving"

    @property
    def counters(self) -> dict[str, int | str]:
        """What people want to see: the pace's own count and refusals by reason."""
        refused = {f"refused_{reason}": count for reason, count in sorted(self.refusals.items())}
        return {
            **self._own_counters(),
            **dict(sorted(self.run.demand_counters.items())),
            **refused,
        }

    def start(self, peers: Peers, now_s: float) -> tuple[Sample, ...]:
        """The first tick once everyone is connected, nothing before.

        Raises:
            RunAborted: nobody came within the timeout, or more than one policy did.
        """
        if not self.gate.open(peers, now_s):
            return ()
        self.started = True
        return self._first_tick(now_s)

    def wait_s(self, now_s: float) -> float:
        """How long until :meth:`poll` has something to do for sure; inf where nobody knows [s]."""
        return math.inf

    @abstractmethod
    def poll(self, command_publishers: int, now_s: float) -> tuple[Sample, ...]:
        """Samples that the passing of time calls for."""

    @abstractmethod
    def offer(
        self, command: BatteryPowerCommand, command_publishers: int, now_s: float
    ) -> tuple[Sample, ...]:
        """Samples that an arriving command calls for."""

    @abstractmethod
    def _first_tick(self, now_s: float) -> tuple[Sample, ...]:
        """Samples of the first tick, published at ``now_s``."""

    @abstractmethod
    def _own_counters(self) -> dict[str, int | str]:
        """Counters beside the refusals."""
