"""Says in the log what changes in a policy's trust in what it observes, each once."""

from collections.abc import Mapping

from rclpy.node import Node

from tractor_ems.decide import Decider
from tractor_msgs_py import supervisor
from tractor_msgs_py.supervisor import Condition
from tractor_msgs_py.types import Reason


class TrustLog:
    """Remembers what was said."""

    def __init__(self, node: Node) -> None:
        self._logger = node.get_logger()
        self._trouble, self._condition = "", Condition.INIT
        self._complained: set[str] = set()
        self._away = False

    def tell(self, decider: Decider, complaints: Mapping[str, str]) -> None:
        """What the policy raised, every change of condition but the first, and the first
        complaint about each signal; leaving and entering what the policy was trained on."""
        for signal in complaints.keys() - self._complained:
            self._complained.add(signal)
            self._logger.error(f"not used: {complaints[signal]}")
        if decider.trouble and decider.trouble != self._trouble:
            self._logger.error(f"the policy failed, fallback law: {decider.trouble}")
        self._trouble = decider.trouble
        self._tell_envelope(decider)
        condition = decider.trust.condition
        if condition is not self._condition and Condition.INIT not in (condition, self._condition):
            text = supervisor.describe(decider.trust)
            because = decider.trust.reason is Reason.OBSERVATION_IMPLAUSIBLE and decider.complaint
            self._logger.warning(f"{text}; {decider.complaint}" if because else text)
        self._condition = condition

    def _tell_envelope(self, decider: Decider) -> None:
        away = decider.envelope.away
        if away and not self._away:
            doing = "fallback law" if decider.away else "the policy goes on"
            self._logger.warning(
                f"outside what the policy was trained on, {doing}: {decider.envelope.text}"
            )
        elif self._away and not away:
            self._logger.info("inside what the policy was trained on again")
        self._away = away
